"""Statistics over episodes: reduction by blocks of episodes, bootstrap intervals, innovations, causes.

Begin with :mod:`.statistic`, which declares statistics; :mod:`.bootstrap` computes their intervals.
"""
