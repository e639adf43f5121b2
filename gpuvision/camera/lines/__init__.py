"""What the lens calibration from straight lines is made of."""
