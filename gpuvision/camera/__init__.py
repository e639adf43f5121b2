"""Cameras: lenses and sensors."""
