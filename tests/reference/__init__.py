"""Float64 NumPy oracles, written from the equations and sharing no code with the kernels."""
