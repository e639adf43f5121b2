"""Prediction of the measurements of a sensor, and of their errors."""
