"""Filters written out for other programs: what runs without this package."""
