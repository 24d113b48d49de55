"""Tasks, their scenarios, and the Gymnasium classes over them, in layers.

A layer imports only the layers before it: ``contract`` (declarations of an author), ``data`` (recordings and files),
``drawing``, ``engine`` (runs a task), ``interface`` (Gymnasium's classes), ``linear`` (users' state-space models); then
the five environments, each in a folder that is found by the ``ID`` that it defines. A new environment adds a folder and
changes nothing else here.
"""
