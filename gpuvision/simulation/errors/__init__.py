"""Range errors of simulated readings: size, causes, remedies."""
