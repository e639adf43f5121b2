"""
Simulate a sensor over a part
=============================

A PSD integrates all light on its strip. In a groove, the lit line on one wall lights the other wall, and this
interreflection pulls the reading. The simulation predicts the reading, its error, and the cause of the error, before
the sensor is built.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np
import trimesh

from gpuvision import Lambert, Material, Scene
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.simulating import prepare_simulation, simulate

# %%
# The part has a V-groove of 90 degrees and a step. Its surface is a profile (x, z) in metres, drawn out along y.
outline = np.array([(-24, 0), (-14, 0), (-4, -10), (6, 0), (12, 0), (12.01, 4), (24, 4)]) * 1e-3
edge = np.repeat(outline, 2, axis=0)
corners = np.stack([edge[:, 0], np.tile([-20e-3, 20e-3], len(outline)), edge[:, 1]], axis=-1)
pairs = range(0, len(edge) - 2, 2)
triangles = [each for n in pairs for each in ((n, n + 2, n + 1), (n + 1, n + 2, n + 3))]
scene = Scene.of(trimesh.Trimesh(corners, triangles))
material = Material(diffuse=Lambert(albedo=0.7), name="white paint")

# %%
# Four profiles of the sensor ``psd_line``, a row of 96 PSD strips, with direct light and one diffuse interreflection.
# The light of each profile is kept in the folder, so that other noise or a mask costs little.
task = prepare_simulation(scene, [material], Sensor.load("psd_line"), paths=("direct", "diffuse-diffuse"), profiles=4)
with tempfile.TemporaryDirectory() as folder:
    result = simulate(task, folder)
print(result.summary())

# %%
# The predicted reading over the true height, and the parts of the error, in one profile.
attribution = result.attribution
x, true, error = (1e3 * each[1] for each in (attribution.truth.g, attribution.truth.h, attribution.error))
figure, (top, bottom) = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
top.plot(x, true, "k-", label="true height")
top.plot(x, true + error, "r.", label="as the sensor reads it")
top.set(ylabel="height [mm]", title="A V-groove and a step, as 96 PSD strips see them")
top.legend()
for name, part in attribution.causes.items():
    if np.nanmax(np.abs(part[1])) > 2e-6:
        bottom.plot(x, 1e6 * part[1], ".-", label=name)
bottom.set(xlabel="x [mm]", ylabel="part of the error [µm]")
bottom.set_yscale("symlog", linthresh=10.0)
bottom.legend()
plt.show()
