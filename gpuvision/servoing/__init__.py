"""Visual servoing: frames and calibration of a machine, delay, observer, control, and the placement of parts."""
