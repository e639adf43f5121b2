"""Speed against accuracy: error against known truth, and time, for the settings that a user chooses.

One module for each operation has a function ``settings(device)``. It yields the settings of the operation on noisy data
with known truth: light with shot noise, images with noise and rounding, lines with outliers. `curve` measures them and
marks the best ones (the Pareto front of time, error and lost samples).
"""
