"""Results as tables and sentences: who ranks where, by how much and at what time, for terminals and documents.

Knows what is evaluated and no page. Begin with :mod:`.results`, the one table of results that all others read.
"""
