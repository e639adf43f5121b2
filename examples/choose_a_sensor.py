"""
Choose a sensor and an exposure
===============================

How precise are edges of a board for a sensor, an exposure and a speed? gpuvision predicts the standard deviation from
the photons of the sensor's model, and renders the frames that the camera would take.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpuvision as gv
from gpuvision.camera.photons import image_irradiance, irradiance_from_lux
from gpuvision.matching.artwork.board_artwork import Artwork, Holes
from gpuvision.matching.artwork.edges import BoardEdges
from gpuvision.matching.artwork.shapes import Shape, capsule, disk

# %%
# Frame rate and delay of a region of 256 x 256 pixels for the sensors of the package.
sensors = {name: gv.read_cmos_sensor(name) for name in ("pb1024", "lupa300")}
for name, sensor in sensors.items():
    timing = sensor.timing((256, 256), exposure=100e-6)
    print(f"{name}: {timing.rate:.0f} frames/s, delay {timing.delay * 1e6:.0f} us")

# %%
# Light: a flash of 500 000 lx on the board, through a lens of f/2.8 at a magnification of 1.
pixel = 10e-6
irradiance = image_irradiance(irradiance_from_lux(500e3, 550e-9), 2.8, magnification=1.0)


def sigma(sensor, exposure, speed):
    white = float(sensor.electrons(irradiance, exposure))
    blur = (sensor.motion_blur(speed, exposure, pixel), 0.0)
    imaging = gv.sensor_imaging(sensor, pixel=pixel, white_electrons=white, exposure=exposure, motion_px=blur)
    return float(imaging.sigma(False)) / pixel


# %%
# A board of a trace, a pad and a fiducial, given by its shapes: in practice read the Gerber files with `read_artwork`.
shapes = (
    Shape(capsule(np.array([0.2e-3, 0.4e-3]), np.array([1.6e-3, 1.4e-3]), 0.15e-3)),
    Shape(1e-3 * np.array([[1.4, 0.3], [2.1, 0.3], [2.1, 0.8], [1.4, 0.8]])),
    Shape(disk(np.array([0.6e-3, 1.7e-3]), 0.3e-3)),
)
none = np.empty((0, 2))
artwork = Artwork(
    side="top",
    copper=shapes,
    mask=(),
    silk=(),
    holes=Holes(none, none, np.empty(0), np.empty(0, np.int8)),
    pads=(),
    edges=BoardEdges(none, none, none, np.empty(0), np.empty(0, bool), np.empty(0, int), np.empty(0, int)),
    bounds=1e-3 * np.array([[0.0, 0.0], [2.4, 2.2]]),
)
board = gv.ReflectanceMap.of(artwork, pixel=pixel)

# %%
# Frames of the first sensor: a short exposure, a longer one, and the longer one of a board that moves (40 sub-poses).
sensor, centre = sensors["pb1024"], np.array([1.2e-3, 1.1e-3, 0.05])
cases = {"3 us": (3e-6, 0.0), "40 us": (40e-6, 0.0), "40 us at 5 m/s": (40e-6, 5.0)}
frames = {}
for number, (title, (exposure, fast)) in enumerate(cases.items()):
    render = gv.RenderBoard(
        board=board,
        shape=(200, 220),
        sensor=sensor,
        electrons=float(sensor.electrons(irradiance, exposure)),
        exposure=exposure,
    )
    way = np.array([fast * exposure, 0.0, 0.0])
    poses = gv.exposure_poses(centre - way / 2, centre + way / 2, 40)
    frames[title] = render(poses[None], np.array([number], np.uint32)).image[0]

# %%
# Precision over the exposure, at rest and in motion; curves end where bare copper saturates.
figure, axes = plt.subplot_mosaic([["a", "b", "c"], ["d", "d", "d"]], figsize=(9, 7), layout="constrained")
for name, (title, frame) in zip("abc", frames.items(), strict=True):
    axes[name].imshow(frame, cmap="gray")
    axes[name].set(title=title, xticks=[], yticks=[])
for name, sensor in sensors.items():
    per_second = float(sensor.electrons(irradiance, 1.0))
    exposures = np.geomspace(2e-6, 0.99 * sensor.saturation / (gv.BoardReflectance().copper * per_second), 60)
    for speed, style in ((0.0, "-"), (0.5, "--")):
        axes["d"].loglog(
            1e6 * exposures, [sigma(sensor, each, speed) for each in exposures], style, label=f"{name}, {speed} m/s"
        )
axes["d"].set(xlabel="exposure [us]", ylabel="sigma of an edge under the mask [px]")
axes["d"].grid(which="both", alpha=0.3)
axes["d"].legend()
plt.show()
