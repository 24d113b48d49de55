"""Reproductions of papers: one folder for each paper; the installed package does not contain them."""
