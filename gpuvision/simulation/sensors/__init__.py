"""Simulated sensors: visible surfaces and readings."""
