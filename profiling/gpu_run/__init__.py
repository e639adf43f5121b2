"""Checks and measurements of a GPU on a machine without network: ``python -m gpuvision.profiling.gpu_run --help``."""
