"""One module for each paper: its experiments run again, and a verdict on each of its claims."""
