"""Gymnasium environments for adaptive-filter benchmarking."""
