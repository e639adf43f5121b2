"""
Locate a circuit board
======================

A camera looks straight at a board. From the board's Gerber files, gpuvision chooses the edges that fix the pose best,
measures them along calipers (rulers) in the image, and solves for the pose with its covariance.

The board and its image are made here, so that the pose can be compared with the truth. With files at hand,
``gpuvision select`` and ``gpuvision locate`` do the same on the command line.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import gpuvision as gv
from gpuvision.workflows.locating_board import locate_board

# %%
# A board of 20 x 16 mm: copper traces 0.5 mm wide and pads, and its outline, as Gerber files.
traces = [(3, 3, 3, 9), (3, 9, 7, 13), (6, 2.5, 12, 2.5), (14, 3, 17, 6), (17, 6, 17, 12), (8, 13.5, 15, 13.5)]
traces += [(10, 5, 10, 9.5), (12.5, 6, 12.5, 10.7), (5.6, 6.5, 7.4, 7.5)]
pads = [(5, 5), (14.8, 5.9), (10, 11.3), (5, 11.2)]


def gerber(apertures, *lines):
    return "\n".join(["%FSLAX46Y46*%", "%MOMM*%", "%LPD*%", "G01*", *apertures, *lines, "M02*", ""])


def at(x, y, code):
    return f"X{round(x * 1e6)}Y{round(y * 1e6)}{code}*"


drawn = [line for x0, y0, x1, y1 in traces for line in (at(x0, y0, "D02"), at(x1, y1, "D01"))]
flashed = [at(x, y, "D03") for x, y in pads]
corners = [(0, 0), (20, 0), (20, 16), (0, 16), (0, 0)]
border = [at(*corner, "D01" if number else "D02") for number, corner in enumerate(corners)]
with tempfile.TemporaryDirectory() as folder:
    copper = gerber(["%ADD10C,0.5*%", "%ADD11R,1.2X1.2*%"], "D10*", *drawn, "D11*", *flashed)
    Path(folder, "copper.gbr").write_text(copper)
    Path(folder, "outline.gbr").write_text(gerber(["%ADD10C,0.1*%"], "D10*", *border))
    layers = {"copper.gbr": "top copper", "outline.gbr": "mechanical outline"}
    artwork = gv.read_artwork(folder, layers=layers)

# %%
# The image that a camera takes at a known pose: 400 x 300 pixels of 40 µm, blurred, with the noise of a sensor. The
# pose is the point of the board at the image centre, and the direction in which the image columns increase.
pixel, true_pose = 40e-6, (10.05e-3, 7.93e-3, 0.004)
sensor, white = gv.read_cmos_sensor("lupa300"), 12e3
board = gv.ReflectanceMap.of(artwork, pixel=pixel, blur_px=0.95)
render = gv.RenderBoard(board=board, shape=(300, 400), sensor=sensor, electrons=white)
image = render(np.array([[true_pose]]), np.array([0], np.uint32)).image[0]

# %%
# Choose 40 rulers for a camera of this resolution; the board may be 0.2 mm off. The sensor gives the contrast of the
# edges. The choice predicts the standard deviations of the pose before an image is taken.
imaging = gv.sensor_imaging(sensor, pixel=pixel, white_electrons=white, shift=200e-6)
features = gv.choose_features(artwork, ((4e-3, 3e-3), (16e-3, 13e-3)), imaging, budget=40)
print(features.summary())

# %%
# Locate the board, and compare with the true pose.
found = locate_board(image, artwork, scale=pixel, initial_pose=(10e-3, 8e-3, 0.0), features=features)
print(found.summary())
error = np.array(found.pose) - true_pose
print(f"error {1e6 * error[0]:+.2f} µm, {1e6 * error[1]:+.2f} µm, {1e6 * error[2]:+.0f} µrad")

# %%
# In a loop, bind the features once. A call takes a frame and the predicted pose, and returns the pose of the camera
# with its covariance; it builds and allocates nothing.
levels = {"copper": found.copper, "threshold": found.threshold, "noise": found.noise}
bound = features.bind(None, image.shape, image.dtype, pixel_size=pixel, **levels)
measured = bound(image, found.pose)
print("in a loop", measured.pose, "sigmas", np.sqrt(np.diag(measured.covariance)))

# %%
# The image with the rulers: green where the measured edge agrees with the pose.
figure, axes = plt.subplots(figsize=(8, 6), layout="constrained")
axes.imshow(image, cmap="gray")
along = features.normal * features.length[:, None] / 2
for start, end, used in zip(features.point - along, features.point + along, found.rulers.used, strict=True):
    axes.plot(*found.view.to_pixels(np.stack([start, end])).T, color="lime" if used else "red")
axes.plot(*found.view.to_pixels(np.array(true_pose[:2])), "c+", markersize=14)
axes.set(title=f"{np.sum(found.rulers.used)} of {len(along)} rulers agree", xlabel="column [px]", ylabel="row [px]")
plt.show()
