"""Benchmarks against peers, side by side in one run, and fractions of the device's own measured limits."""
