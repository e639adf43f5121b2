"""
Place a component
=================

A camera beside the nozzle looks at the board while the head moves. Calipers (rulers) measure the pose of the board in
every frame, 1000 times a second, and the controller steers the nozzle to its target. A Smith predictor knows the motion
that was commanded during the delay.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from gpuvision.formats.machine_file import read_machine
from gpuvision.matching.artwork.artwork import read_artwork
from gpuvision.matching.features.feature_set import edge_clearance
from gpuvision.servoing.placement.control import Control
from gpuvision.servoing.placement.plan import placement_imaging
from gpuvision.workflows.placement_cell import measure_repeatability
from gpuvision.workflows.placing import simulate_placements

# %%
# A board of 20 x 16 mm with two rows of pads and three traces, in Gerber files.
pads = [(8.6 + 0.5 * column, 7.5 + row) for column in range(6) for row in range(2)]  # centres [mm]
traces = [(6.0, 6.5, 6.0, 10.0), (12.5, 6.5, 14.0, 6.5), (7.0, 6.5, 12.0, 6.5)]
corners = [(0, 0), (20, 0), (20, 16), (0, 16), (0, 0)]


def at(x, y, code):
    return f"X{round(x * 1e6)}Y{round(y * 1e6)}{code}*"


head = ["%FSLAX46Y46*%", "%MOMM*%", "%LPD*%", "G01*"]
flashed = [at(x, y, "D03") for x, y in pads]
drawn = [line for x0, y0, x1, y1 in traces for line in (at(x0, y0, "D02"), at(x1, y1, "D01"))]
copper = [*head, "%ADD10R,0.25X0.6*%", "%ADD11C,0.2*%", "D10*", *flashed, "D11*", *drawn, "M02*", ""]
border = [at(x, y, "D01" if number else "D02") for number, (x, y) in enumerate(corners)]
folder = Path(tempfile.mkdtemp())
(folder / "copper.gbr").write_text("\n".join(copper))
(folder / "outline.gbr").write_text("\n".join([*head, "%ADD10C,0.1*%", "D10*", *border, "M02*", ""]))

# %%
# The machine of the package with a smaller window, and the same machine with a Smith predictor.
machine = read_machine("look_while_place")
machine = replace(machine, camera=replace(machine.camera, window=(384, 384)))
machines = {"latest pose": machine, "Smith predictor": replace(machine, control=Control(observer="smith", gain=0.5))}
layers = {"copper.gbr": "top copper", "outline.gbr": "mechanical outline"}
board = read_artwork(folder, layers=layers, clearance=edge_clearance(placement_imaging(machine)))
target = (10.85e-3, 8.5e-3, 0.0)  # x, y [m], theta [rad]
results = {name: simulate_placements(board, target, each, count=5) for name, each in machines.items()}
for name, result in results.items():
    print(f"{name}\n{result.summary()}\n")

# %%
# Error over time, and the measured pose of a head at rest.
resting = measure_repeatability(board, machine, results["latest pose"].plan, frames=100)
figure, (over_time, at_rest) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
for number, (name, result) in enumerate(results.items()):
    for motion in result.motion:
        distance = 1e6 * np.hypot(*motion[:, :2].T)
        label = name if motion is result.motion[0] else None
        over_time.semilogy(np.arange(len(motion)), distance, color=f"C{number}", alpha=0.7, label=label)
over_time.axhline(1e6 * machine.tolerance.position, color="black", linewidth=0.5)
over_time.set(xlabel="time [ms]", ylabel="distance from the target [µm]", title="five placements each")
over_time.legend()
for axis, name in enumerate("xy"):
    sigma = 1e6 * resting.frame_sigma[axis]
    at_rest.plot(1e6 * resting.error[:, axis], ".", color=f"C{axis}", label=f"{name}, predicted sigma {sigma:.2f} µm")
at_rest.set(xlabel="frame", ylabel="error of the measured position [µm]", title="head at rest")
at_rest.legend()
plt.show()
