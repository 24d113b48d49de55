"""Tasks, their scenarios, and the Gymnasium classes over them, in rooms.

A room knows only those before it: ``contract`` (what an author declares), ``data`` (what comes from outside),
``drawing``, ``engine`` (what runs a task), ``interface`` (Gymnasium's classes), ``linear`` (models of one's own); then
the five problems, each a folder of its own, found by the ``ID`` that it defines. A new environment adds a folder and
changes nothing else here.
"""
