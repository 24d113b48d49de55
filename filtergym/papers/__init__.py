"""Reproductions of papers: one folder a paper, in a clone of the repository; the installed package lacks them."""
