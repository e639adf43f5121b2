"""A sensor as its description file gives it: readout, light source, simulated twin."""
