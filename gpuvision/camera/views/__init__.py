"""Camera calibration from views of a flat target."""
