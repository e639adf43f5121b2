"""Simulated sensors: what they see, how they collect light, and what they read."""
