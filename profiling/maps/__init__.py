"""Stability maps: the region of inputs in which single precision stays close to float64.

One module for each operation has a function ``problem()``. It describes two axes of the inputs (light level, distance,
distortion, size, condition), the relative error against float64 at places in their plane, and the error that the error
model predicts there. `stability` measures the error over a grid of places; `picture` draws it. The tests search for
larger errors between the places of the grid, and keep the worst ones.
"""
