"""
Calibrate a lens
================

One image of a dot grid is enough to calibrate the radial distortion of a lens: the dots of a row and of a column lie
on lines that are straight in the scene (plumb-line method). The dimensions of the target need not be known, and the
camera may view it at an angle.

The image is rendered here with a known lens, so that the result can be compared with the truth.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpuvision as gv

# %%
# Render a dot grid through a lens with 12 px of distortion in the corners. A pixel looks at the undistorted point
# ``lens.undistort(pixel)``; a homography leads from there to the target, which is turned and tilted.
width, height, pitch = 800, 640, 28.0
true_lens = gv.Lens(k1=-12.0 / 512.0**3, centre=(412.0, 309.0))
target_to_image = np.array([[27.6, -3.2, 40.0], [3.4, 27.9, -10.0], [2.0e-4, -1.5e-4, 1.0]])

column, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
ideal = true_lens.undistort(np.stack([column, row], axis=-1))
image_to_target = np.linalg.inv(target_to_image)
lifted = ideal @ image_to_target[:, :2].T + image_to_target[:, 2]
place = lifted[..., :2] / lifted[..., 2:]
distance_px = pitch * (np.hypot(*np.moveaxis(place - np.rint(place), -1, 0)) - 0.25)
on_target = np.all((np.rint(place) >= 2) & (np.rint(place) <= (25, 20)), axis=-1)
covered = np.where(on_target, np.clip(0.5 - distance_px, 0.0, 1.0), 0.0)
rng = np.random.default_rng(3)
image = np.clip(np.rint(210.0 - 170.0 * covered + rng.normal(0.0, 1.5, covered.shape)), 0, 255).astype(np.uint8)

# %%
# Find the dots, group them into rows and columns, and fit the lens. The model is the smallest that the data do not
# reject; every parameter has an uncertainty.
grid = gv.find_dots(image)
fit = gv.fit_lens(gv.grid_lines(grid.points))
print(f"{np.count_nonzero(np.isfinite(grid.points[..., 0]))} dots, model {fit.model}, residual {fit.rms_px:.4f} px rms")
for name, true in (("k1", true_lens.k1), ("C_c", true_lens.centre[0]), ("R_c", true_lens.centre[1])):
    value = fit.values[fit.names.index(name)]
    print(f"{name:4} {value:12.5g} +- {fit.uncertainties[name]:.2g} (true {true:.5g})")

# %%
# Remove the distortion from the image. Pixels that the camera did not see are 0, and flagged in ``mask``.
straight = gv.UndistortImage(model=fit.lens, interpolation="bicubic")(image).image

# %%
# The image, the corrected image, and the distances of the dots from straight lines before and after.
before = gv.straightness_px(gv.grid_lines(grid.points))
after = gv.straightness_px(gv.grid_lines(grid.points), fit.lens)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
left.imshow(image, cmap="gray")
left.plot(*grid.points[0].T, "r-", *grid.points[-1].T, "r-", *grid.points[:, 0].T, "r-", *grid.points[:, -1].T, "r-")
left.set(title=f"As taken: lines bent by {before:.2f} px rms", xlabel="column [px]", ylabel="row [px]")
right.imshow(straight, cmap="gray")
ideal_points = fit.lens.undistort(grid.points)
edges = (ideal_points[0], ideal_points[-1], ideal_points[:, 0], ideal_points[:, -1])
for edge in edges:
    right.plot(*edge.T, "r-")
right.set(title=f"Corrected: straight to {after:.3f} px rms", xlabel="column [px]")
plt.show()
