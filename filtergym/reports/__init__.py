"""Reports over environments: benchmark, comparison, room for improvement, training seeds, and their tables."""
