"""Reproductions of papers, one folder for each; the installed package does not contain them."""
