"""Measurement of a board in an image: edges along rulers, fiducials, the located board."""
