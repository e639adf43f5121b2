"""Jobs on files: scan, simulate, calibrate, undistort, locate. The commands call these."""
