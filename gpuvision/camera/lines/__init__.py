"""Lens calibration from straight lines."""
