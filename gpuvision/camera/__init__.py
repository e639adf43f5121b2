"""Camera and lens models, undistortion, target patterns and calibration."""
