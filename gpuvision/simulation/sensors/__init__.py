"""Simulated sensors: visible surfaces, collection of light, and readings."""
