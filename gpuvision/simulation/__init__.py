"""Prediction of what a sensor will measure, and where it will be wrong."""
