"""From files to a pose: artwork, selection, a picture of the board, edges, and what was promised."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.matching.artwork import Artwork, read_artwork
from gpuvision.matching.pose import SolvePose, line_rows
from gpuvision.matching.ruler import RulerEdges, best_smoothing
from gpuvision.matching.selection import Candidates, Imaging, Selection, candidates, select
from reference.board_images import SAMPLES, View, board_image

PIXEL, BLUR, NOISE = 25e-6, 1.0, 2.0
SHAPE = (480, 640)
# Steps of 50 under the mask and of 110 in the open, over the noise.
IMAGING = Imaging(
    pixel=PIXEL, blur_px=BLUR, contrast_bare=110 / NOISE, contrast_masked=50 / NOISE, width_px=5, etch=0.0
)


def placed(artwork: Artwork, middle: np.ndarray) -> tuple[Candidates, Selection, View]:
    half = (np.array(SHAPE[::-1]) / 2 - 30) * PIXEL
    rulers = candidates(artwork, (middle - half, middle + half), middle, IMAGING)
    single = Candidates(*(each[~rulers.pair] for each in rulers[:-1]), rulers.placement)
    corner = middle + (np.array(SHAPE[::-1]) - 1) / 2 * PIXEL * (-1, 1)
    view = View(corner=tuple(corner), pixel=PIXEL, shape=SHAPE, blur_px=BLUR, noise=NOISE)
    return single, select(single, IMAGING, 40), view


def fixed(picture: np.ndarray, rulers: Candidates, chosen: np.ndarray, view: View, device: Device) -> tuple:
    """The pose about the placement point, and its covariance."""
    point, normal = rulers.point[chosen], rulers.normal[chosen]
    pixels = (point - view.corner) / (PIXEL, -PIXEL)
    laid = np.concatenate([pixels, normal * (1, -1)], axis=1).astype(np.float32)
    length = math.ceil(rulers.length[chosen].max() / PIXEL)
    edges = RulerEdges(
        threshold=15.0, length=length, width=5, smoothing_px=best_smoothing(BLUR), polarity="falling", noise=NOISE
    )(picture, laid, device=device)
    seen = point + normal * (edges.position.astype(np.float64) * PIXEL)[:, None]
    rows = line_rows(normal, point - rulers.placement, seen - rulers.placement, rulers.sigma[chosen])
    found = SolvePose(precision="double" if device.has_double else None)(rows[None], device=device)
    return found.pose[0], found.covariance[0], found.status.ravel()[0]


def square(folder: Path) -> Artwork:
    """A pad 2 mm wide at (5, 5) mm, silk 0.5 mm wide on its left border."""
    head = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"
    (folder / "copper.gbr").write_text(head + "%ADD10R,2X2*%\nD10*\nX5000000Y5000000D03*\nM02*\n")
    (folder / "silk.gbr").write_text(head + "%ADD10R,0.5X3*%\nD10*\nX4000000Y5000000D03*\nM02*\n")
    return read_artwork(folder, layers={r"copper\.gbr": "top copper", r"silk\.gbr": "top silk"})


def test_pictures_hold_what_is_on_the_board(tmp_path: Path) -> None:
    artwork = square(tmp_path)
    view = View(corner=(2e-3, 8e-3), pixel=PIXEL, shape=(240, 240), levels=(0, 0, 0, 1, 0, 0))

    def copper_of(view: View, **arguments: Any) -> tuple[float, np.ndarray]:
        picture = board_image(artwork, view, **arguments).astype(np.float64)
        rows, columns = np.indices(picture.shape)
        middle = np.array([np.sum(picture * columns), np.sum(picture * rows)]) / max(picture.sum(), 1e-9)
        return picture.sum() * PIXEL**2, view.corner + middle * (PIXEL, -PIXEL)

    # 2 x 2 mm less 0.25 x 2 mm of silk; an eighth of a pixel all round is what sampling may cost.
    inside, around = 3.5e-6, 7.5e-3 * PIXEL / SAMPLES
    for pose in ((0.0, 0.0, 0.0), (0.13e-3, -0.2e-3, 0.3)):
        seen, middle = copper_of(view, pose=pose, about=(5e-3, 5e-3))
        assert seen == pytest.approx(inside, abs=around / 2)
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        expected = np.array([5e-3, 5e-3]) + 0.125e-3 * np.array([cos, sin]) + pose[:2]
        assert middle == pytest.approx(expected, abs=PIXEL / SAMPLES)
    etched, _ = copper_of(replace(view, growth=-PIXEL))
    assert etched == pytest.approx((2e-3 - 2 * PIXEL) * (1.75e-3 - PIXEL), abs=around)
    assert copper_of(replace(view, silk_shift=(-1e-3, 0)))[0] == pytest.approx(4e-6, abs=around / 2)
    assert copper_of(replace(view, motion_px=5.0))[0] == pytest.approx(inside, abs=around / 2)
    assert copper_of(view, missing={0})[0] == 0.0


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "middle"), [("upverter", (-50e-3, 10e-3)), ("fritzing", (20e-3, 25e-3))])
def test_a_picture_s_pose_lies_where_promised(
    data: Path, name: str, middle: tuple[float, float], device: Device, rng: np.random.Generator
) -> None:
    artwork = read_artwork(data / "gerber" / name)
    rulers, selection, view = placed(artwork, np.array(middle))
    sigmas, scores = selection.sigmas, []
    for _ in range(3):
        pose = (*rng.uniform(-60e-6, 60e-6, 2), rng.uniform(-3e-3, 3e-3))
        picture = board_image(artwork, view, pose, middle, rng=rng)
        found, _, status = fixed(picture, rulers, selection.chosen, view, device)
        assert status == 0
        scores.append((found - pose) / sigmas)
    # Of 9 Gaussian numbers one in 1e4 boards is beyond 4.5. The samples' interpolation (0.01 px) is in it, too.
    assert np.abs(scores).max() < 4.5
