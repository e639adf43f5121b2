"""Inspection of solder paste and of component leads in height maps."""
