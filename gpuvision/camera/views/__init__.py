"""What the calibration from views of a flat target is made of."""
