"""Placement of a component by its camera: machine, plan, pose of the nozzle in each frame, loop, error budget."""
