"""Results as tables and sentences for terminals and documents: ranking, differences and times.

It imports evaluations and no pages. Begin with :mod:`.results`, the one table of results that all others read.
"""
