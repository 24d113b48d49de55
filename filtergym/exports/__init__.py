"""Filters that leave the package: as C, as Python, their networks in other forms."""
