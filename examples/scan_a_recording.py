"""
Scan a recording
================

A camera looks at a laser line (sheet of light) on a moving part. The recording is one grey frame per position of the
part. The scan reads the line in every column, triangulates, and resamples the points into a height map.

The recording is made here from a known surface, so that the result can be compared with the truth. A real recording
is a video, a TIFF stack, a folder of images or an NPY file; ``gpuvision scan`` does the same on the command line.
"""

import matplotlib.pyplot as plt
import numpy as np

from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.scanning import scan

# %%
# The sensor is described in a TOML file. ``camera_line`` is installed with gpuvision: frames of 64 x 480 pixels, one
# frame every 0.25 mm of transport.
sensor = Sensor.load("camera_line")
readout = sensor.readout
rows, columns = sensor.frame
step = 0.25e-3  # m of transport per frame


# %%
# A surface to scan: a ramp, and a spherical cap of 1.8 mm on it. x lies along the laser line, y along the transport;
# all lengths in metres.
def height(x, y):
    ramp = np.clip(0.12 * (y - 4e-3), 0.0, 2e-3)
    cap = np.sqrt(np.maximum(6e-3**2 - x**2 - (y - 12e-3) ** 2, 0.0)) - 4.2e-3
    return ramp + np.maximum(cap, 0.0)


# %%
# The row of the line in every column. Triangulation gives (x, z) for a sensor position; here the inverse is needed. The
# place x at which a column looks depends on the height z there, so a few fixed-point steps find both.
axes, triangulation = readout.axes, readout.triangulation
sample_v = axes.sample_origin + axes.sample_pitch * np.arange(columns)
y = step * np.arange(96)[:, None]
metres_per_pixel = 0.15 / 1600.0  # stand-off over focal distance
x = np.broadcast_to(metres_per_pixel * sample_v, (len(y), columns)).copy()
for _ in range(20):
    seen = triangulation.to_sensor(np.stack([x, height(x, y)], axis=-1))
    x += metres_per_pixel * (sample_v - seen[..., 1])
line_rows = (seen[..., 0] - axes.position_origin) / axes.position_pitch

distance = np.arange(rows)[None, :, None] - line_rows[:, None, :]
rng = np.random.default_rng(1)
frames = 180.0 * np.exp(-0.5 * (distance / 1.2) ** 2) + rng.normal(4.0, 2.0, distance.shape)
recording = np.clip(np.rint(frames), 0, 255).astype(np.uint8)

# %%
# Scan. The result holds the organised points, the height map, status flags and a report of the stream.
result = scan(recording, sensor)
print(result.summary())
error = result.points.z - height(result.points.x, result.points.y)
print(f"rms error {1e6 * np.sqrt(np.nanmean(error**2)):.1f} µm")

# %%
# A frame of the recording, and the height map.
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
left.imshow(recording[48], cmap="gray", aspect="auto")
left.set(title="Frame 48: the laser line", xlabel="column [px]", ylabel="row [px]")
grid = result.grid
extent = (1e3 * grid.x[0], 1e3 * grid.x[-1], 1e3 * grid.y[0], 1e3 * grid.y[-1])
shown = right.imshow(1e3 * result.heights.z, extent=extent, origin="lower", cmap="viridis")
right.set(title="Height map", xlabel="x [mm]", ylabel="y [mm]")
figure.colorbar(shown, ax=right, label="z [mm]")
plt.show()
