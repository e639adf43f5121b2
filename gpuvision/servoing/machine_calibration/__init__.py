"""Calibration of a placement machine: camera frame, nozzle axis and motion frame, each with its covariance."""
