"""Speed against accuracy: error against known truth, and time, for the settings that a user chooses.

One module for each operation has a function ``settings(device)``. It yields the settings of the operation on data with
known truth: light with shot noise, images with noise and rounding, lines with outliers. The data of triangulation,
undistort_points and occluded_irradiance have no noise. Their errors come from the model, the method and the precision
alone. `curve` measures the settings and marks the best ones (the Pareto front of time, error and lost samples).
"""
