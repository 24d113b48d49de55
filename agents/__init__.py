"""Reinforcement learning on top of the environments."""
