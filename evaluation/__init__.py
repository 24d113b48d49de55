"""Rollouts, metrics, intervals, seeds and figures: takes objects and knows no names."""
