"""What many episodes come to: statistics by blocks of episodes, bootstrap intervals, innovations, causes.

Knows ``storage``. Begin with :mod:`.statistic`, which declares what is reduced; :mod:`.bootstrap` gives its interval.
"""
