"""Filters exported as programs that run without this package."""
