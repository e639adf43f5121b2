"""
Choose a mask against interreflection
=====================================

Light that falls on a PSD strip far from the laser line pulls the reading most. If the part is known, a mask with one
window per strip keeps much of it out. The window must still pass the valid light at every height that the strip will
see.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np
import trimesh

from gpuvision import Lambert, Material, Scene
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.simulating import prepare_simulation, simulate

# %%
# A V-groove of 90 degrees, 20 mm deep: its walls light each other. The surface is a profile (x, z), drawn out along
# y.
outline = np.array([(-24, 0), (-20, 0), (0, -20), (20, 0), (24, 0)]) * 1e-3
edge = np.repeat(outline, 2, axis=0)
corners = np.stack([edge[:, 0], np.tile([-40e-3, 40e-3], len(outline)), edge[:, 1]], axis=-1)
pairs = range(0, len(edge) - 2, 2)
triangles = [each for n in pairs for each in ((n, n + 2, n + 1), (n + 1, n + 2, n + 3))]
scene = Scene.of(trimesh.Trimesh(corners, triangles))
material = Material(diffuse=Lambert(albedo=0.7), name="white paint")

# %%
# Simulate twice from the same light: without a mask, and with the mask that is optimised for this part.
task = prepare_simulation(scene, [material], Sensor.load("psd_line"), paths=("direct", "diffuse-diffuse"), profiles=4)
with tempfile.TemporaryDirectory() as folder:
    without = simulate(task, folder)
    masked = simulate(task, folder, mask="best")
print(masked.summary())

# %%
# The errors of a profile, and the windows of the mask.
figure, (top, bottom) = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
strips = np.arange(96)
top.plot(strips, 1e6 * without.attribution.error[1], "r.", label="without a mask")
top.plot(strips, 1e6 * masked.attribution.error[1], "g.", label="with the mask")
top.set(ylabel="error [µm]", title="A V-groove: interreflection, and a mask against it")
top.set_yscale("symlog", linthresh=10.0)
top.legend()
low, high = 1e3 * np.asarray(masked.mask.mask.windows).T
bottom.vlines(strips, low, high, color="g")
bottom.set(xlabel="strip", ylabel="window on the strip [mm]")
plt.show()
