"""Compilation of the kernels for GPUs that need not be present: registers, stack, spills and local memory."""
