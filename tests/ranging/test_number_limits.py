"""Numbers at both sides of each limit: the last one that is taken, and the first one that is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import gpuvision as gv
from gpuvision.ranging.focus import DepthFromFocus
from gpuvision.ranging.height_map import Grid
from gpuvision.ranging.line_launch import LONGEST_PROFILE
from gpuvision.ranging.line_parameters import WIDEST_WINDOW
from gpuvision.ranging.polygon import PolygonMirror, shear_profile
from gpuvision.ranging.psd import clipping_bias
from gpuvision.ranging.sheet_motion import RotatingSheet

PSD = gv.PsdReadout(strip_length=6e-3)
PAIR = gv.PsdReadout(strip_length=6e-3, interelectrode_resistance=1e4)
LINE = gv.LineReadout(threshold=5.0)
SHEET = RotatingSheet(
    axis_point=(0.0, 0.0, 0.3),
    axis_direction=(0.0, 1.0, 0.0),
    sheet_normal=(1.0, 0.0, 0.0),
    focal_length_px=500.0,
    principal_point_px=(3.0, 4.0),
)
PLANE = gv.Triangulation.from_stand_off(
    baseline=0.1, stand_off=0.2, focal_distance=0.016, region=((-3e-3, 3e-3), (-3e-3, 3e-3))
)
COVARIANCE = np.diag([1.0, 2.0, 3.0])


def covariance(change: float, at: tuple[int, int] = (0, 1)) -> Any:
    """Return a covariance with 4.0 beside the diagonal, and another number in one place."""
    matrix = COVARIANCE.copy()
    matrix[0, 1] = matrix[1, 0] = 4.0
    matrix[at] += change
    return matrix


# What is made of a number; numbers that are taken; numbers that are refused, each with the beginning of its message.
CASES: dict[str, tuple[Callable[[Any], Any], tuple[Any, ...], dict[Any, str]]] = {
    "strip": (lambda x: replace(PSD, strip_length=x, margin=0.0), (1e-300,), {0.0: "strip_length is 0.0, expected"}),
    "ampere": (lambda x: replace(PSD, ampere=x), (1e-300,), {0.0: "ampere is 0.0", -1e-12: "ampere is -1e-12"}),
    "right gain": (lambda x: replace(PSD, right_gain=x), (1e-300,), {0.0: "right_gain is 0.0"}),
    "least total": (lambda x: replace(PSD, minimum_total=x), (0.0,), {-1e-12: "minimum_total is -1e-12"}),
    "load": (lambda x: replace(PAIR, load_resistance=x), (0.0, 1e9), {-1e-9: "load_resistance is -1e-09"}),
    "load alone": (lambda x: replace(PSD, load_resistance=x), (0.0,), {1e-9: "load_resistance needs interelectrode"}),
    "electrodes": (lambda x: replace(PSD, interelectrode_resistance=x), (1e-9,), {0.0: "interelectrode_resistance is"}),
    "saturation": (lambda x: replace(PSD, saturation=x), (1e-12,), {0.0: "saturation is 0.0, expected a number > 0"}),
    "margin": (
        lambda x: replace(PSD, margin=x),
        (0.0, 2.999999e-3),
        {-1e-12: "margin is -1e-12 m; expected", 3e-3: "margin is 0.003 m; expected 0 or more, and below half"},
    ),
    "spots at the ends": (
        lambda x: replace(PSD, noise=gv.PsdNoise(spot=x)),
        (0.999e-3,),
        {1e-3: r"margin is 0\.003 m, 3 times noise\.spot; expected"},
    ),
    "knots": (
        lambda x: replace(PSD, linearity=[[0.0] * n for n in x]),
        ((2, 2), (3,)),
        {(1, 1): "linearity: expected a row", (2, 3): "all of one length", (): "at least 2 knots"},
    ),
    "spot of a bias": (
        lambda x: clipping_bias(0.0, spot=x, strip_length=6e-3),
        (1e-9,),
        {0.0: "clipping_bias: spot is 0.0"},
    ),
    "strip of a bias": (
        lambda x: clipping_bias(0.0, spot=1e-3, strip_length=x),
        (1e-9,),
        {0.0: "clipping_bias: strip_length is 0.0"},
    ),
    "window": (
        lambda x: replace(LINE, window=x),
        (1, WIDEST_WINDOW),
        {0: f"window is 0, expected a whole number from 1 to {WIDEST_WINDOW}", WIDEST_WINDOW + 1: "window is "},
    ),
    "window of ml": (
        lambda x: replace(LINE, window=x, method="ml", read_noise=1.0),
        (3,),
        {2: "window is 2, expected a whole number from 3"},
    ),
    "noise of ml": (
        lambda x: replace(LINE, method="ml", read_noise=x[0], gain=x[1]),
        ((1e-9, 0.0), (0.0, 1e-9)),
        {(0.0, 0.0): "method 'ml' weighs"},
    ),
    "widths": (
        lambda x: replace(LINE, minimum_width=x[0], maximum_width=x[1]),
        ((1, 1), (1, None), (4, 4), (4, 5)),
        {(0, 3): "widths from 0 to 3, expected 1 <= min", (0, None): "widths from 0 to None", (4, 3): "widths from 4"},
    ),
    "ambiguity": (
        lambda x: replace(LINE, ambiguity=x),
        (1e-9, 1.0),
        {0.0: "ambiguity is 0.0, expected a share", 1.0 + 1e-9: "ambiguity is 1.000000001"},
    ),
    "peak": (lambda x: replace(LINE, minimum_peak=x), (5.0, 6.0), {5.0 - 1e-9: "expected the threshold 5.0 or more"}),
    "level of saturation": (lambda x: replace(LINE, saturation=x), (1e-9,), {0.0: "saturation is 0.0, expected"}),
    "horizon of a plane": (
        lambda x: replace(PLANE, horizon=x),
        (1e-9, 1.0 - 1e-9),
        {0.0: "horizon is 0.0, expected a number between 0 and 1", 1.0: "horizon is 1.0"},
    ),
    "sigma": (
        lambda x: replace(PLANE, sigma=x),
        ((0.0, 0.0), (2.0, 0.0)),
        {(-1e-12, 1.0): r"sigma is \(-1e-12, 1.0\)", (1.0, -1e-12): "neither negative"},
    ),
    "region": (
        lambda x: replace(PLANE, region=x),
        (((0.0, 1e-3), (2e-3, 2e-3)),),
        {((1e-3, 1e-3), (0.0, 1e-3)): "region is", ((0.0, 1e-3), (2e-3, 1e-3)): "region is"},
    ),
    "horizon": (lambda x: replace(SHEET, horizon=x), (1e-300,), {0.0: "horizon is 0.0, expected a number above 0"}),
    "focal length": (
        lambda x: replace(SHEET, focal_length_px=x),
        (1e-300,),
        {0.0: "focal_length_px is 0.0, expected a number above 0", -1e-9: "focal_length_px is -1e-09"},
    ),
    "jitter of an angle": (lambda x: replace(SHEET, jitter=x), (0.0,), {-1e-12: "RotatingSheet.jitter is -1e-12"}),
    "axis of the sheet": (
        lambda x: replace(SHEET, sheet_normal=(x, 1.0, 0.0)),
        (1.1e-9,),
        {0.9e-9: "the sheet's normal lies along the axis"},
    ),
    "jitter": (
        lambda x: gv.StraightTransport(jitter=x),
        (0.0,),
        {-1e-12: "StraightTransport.jitter is -1e-12, expected"},
    ),
    "step": (lambda x: gv.StraightTransport(step=x), (1e-300, -1e-300, None), {0.0: "step is 0, expected metres"}),
    "volume": (
        lambda x: gv.StraightTransport(g_axis=(2.0, 0.0, 0.0), h_axis=(0.0, 5.0 * x, 5.0), direction=(0.0, 0.0, -1.0)),
        (1.1e-9, -1.1e-9),
        {0.9e-9: "lie in one plane", -0.9e-9: "expected a volume", 0.0: "lie in one plane"},
    ),
    "symmetry": (
        lambda x: gv.StraightTransport(covariance=covariance(x)),
        (0.0, 3.9e-6, -3.9e-6),
        {4.1e-6: "expected a symmetric matrix", -4.1e-6: "expected a symmetric matrix"},
    ),
    "variance": (
        lambda x: gv.StraightTransport(covariance=covariance(x, (1, 1))),
        (-2.0,),
        {-2.0 - 1e-9: "variances of 0 or more"},
    ),
    "pitch": (lambda x: gv.SampleAxes(sample_pitch=x), (-1e-300, 1e-300), {0.0: "SampleAxes: a pitch is 0"}),
    "position pitch": (lambda x: gv.SampleAxes(position_pitch=x), (-1e-300,), {0.0: "SampleAxes: a pitch is 0"}),
    "cell": (lambda x: Grid.covering([0.0], [0.0], x), (1e-300,), {0.0: "the cell of a grid is 0.0"}),
    "cells": (
        lambda x: Grid(left=0.0, top=0.0, cell_x=x[0], cell_y=x[1], columns=x[2], rows=x[3]),
        ((1e-300, 1e-300, 1, 1),),
        {
            (0.0, 1.0, 1, 1): "cell_x is 0.0, expected a number above 0",
            (1.0, 0.0, 1, 1): "cell_y is 0.0",
            (1.0, 1.0, 0, 1): "columns is 0",
            (1.0, 1.0, 1, 0): "rows is 0",
        },
    ),
    "gap": (
        lambda x: gv.Regrid(
            grid=Grid(left=0.0, top=0.0, cell_x=1.0, cell_y=1.0, columns=1, rows=1),
            max_gap=x[0],
            max_step=x[1],
            fold_tolerance=x[2],
        ),
        ((0.0, 0.0, 0.0),),
        {
            (-1e-12, 0.0, 0.0): "max_gap is -1e-12, expected metres, 0 or more",
            (0.0, -1e-12, 0.0): "max_step is -1e-12",
            (0.0, 0.0, -1e-12): "fold_tolerance is -1e-12",
        },
    ),
    "merge": (
        lambda x: gv.MergeHeights(max_sigmas=x[0], tolerance=x[1]),
        ((0.0, 0.0),),
        {(-1e-12, 0.0): "max_sigmas is -1e-12", (0.0, -1e-12): "tolerance is -1e-12"},
    ),
    "facets": (
        lambda x: PolygonMirror(apothem=0.02, facets=x, height=0.1),
        (3,),
        {2: "facets is 2, expected at least 3"},
    ),
    "apothem": (lambda x: PolygonMirror(apothem=x, facets=8, height=0.1), (1e-300,), {0.0: "apothem is 0.0, expected"}),
    "height": (
        lambda x: PolygonMirror(apothem=0.02, facets=8, height=x),
        (0.02 * math.sqrt(0.5) + 1e-9,),
        {
            0.02 * math.sqrt(0.5): r"expected more than apothem/sqrt\(2\) = 0\.01414",
            0.0: "height is 0.0, expected a pos",
        },
    ),
    "height over the hit": (
        lambda x: PolygonMirror(apothem=0.02, facets=8, height=x, height_from="hit"),
        (1e-300,),
        {0.0: "height is 0.0, expected a positive length"},
    ),
    "speed": (
        lambda x: PolygonMirror(apothem=0.02, facets=8, height=0.1).times([0.0], x),
        (1e-300,),
        {0.0: "angular_speed is 0.0, expected a positive one", -1e-9: "angular_speed is -1e-09"},
    ),
    "angle": (
        lambda x: shear_profile([0.0, 1.0], [0.0, 0.0], x),
        (0.5 * math.pi - 1e-9, 1e-9 - 0.5 * math.pi),
        {0.5 * math.pi: "angle is 1.57.* rad, expected less than a right angle", -0.5 * math.pi: "angle is -1.57"},
    ),
    "pinholes": (
        lambda x: DepthFromFocus(first=x, spacing=1e-3, focal_length=0.05),
        (0.05 + 1e-9,),
        {
            0.05: r"first is 0\.05 m, expected beyond the focal length, 0\.05 m",
            0.0: "first is 0.0, expected a positive",
        },
    ),
    "least light": (
        lambda x: DepthFromFocus(first=0.06, spacing=1e-3, focal_length=0.05, minimum=x),
        (0.0,),
        {-1e-12: "minimum is -1e-12, expected 0 or more"},
    ),
    "noise of light": (
        lambda x: DepthFromFocus(first=0.06, spacing=1e-3, focal_length=0.05, sigma_intensity=x),
        (1e-12,),
        {0.0: "sigma_intensity is 0.0, expected a positive number"},
    ),
    "baseline": (
        lambda x: gv.Triangulation.from_stand_off(
            baseline=x[0], stand_off=x[1], focal_distance=x[2], region=((-1e-3, 1e-3), (-1e-3, 1e-3))
        ),
        ((0.1, 0.2, 0.016),),
        {(0.0, 0.2, 0.016): "baseline", (0.1, 0.0, 0.016): "stand_off", (0.1, 0.2, 0.0): "focal_distance"},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_numbers_at_their_limits(case: str) -> None:
    make, taken, refused = CASES[case]
    for value in taken:
        make(value)
    for value, message in refused.items():
        with pytest.raises((TypeError, ValueError), match=message):
            make(value)


@pytest.mark.parametrize("name", ["independent", "opposed", "spot", "bandwidth", "background", "dark_current"])
def test_noise_of_a_psd_is_not_negative(name: str) -> None:
    gv.PsdNoise(**{name: 0.0})
    with pytest.raises(ValueError, match=rf"PsdNoise\.{name} is -1e-15, expected a number >= 0"):
        gv.PsdNoise(**{"bandwidth": 1.0, name: -1e-15})
    if name in ("background", "dark_current"):
        gv.PsdNoise(**{"bandwidth": 1e-300, name: 1e-12})
        with pytest.raises(ValueError, match=f"{name}.*bandwidth|bandwidth.*{name}"):
            gv.PsdNoise(**{name: 1e-300})


def test_levels_of_frames_are_codes() -> None:
    """Of integer frames the threshold is a whole code; saturation and least peak are rounded up to a code."""
    device = gv.Device.best()
    for readout, dtype, message in (
        (replace(LINE, threshold=255.0), np.uint8, ""),
        (
            replace(LINE, threshold=256.0),
            np.uint8,
            "threshold is 256.0, expected a whole number from 0 to 255 for uint8",
        ),
        (replace(LINE, threshold=256.0), np.uint16, ""),
        (replace(LINE, threshold=5.5), np.uint8, "threshold is 5.5, expected a whole number"),
        (replace(LINE, threshold=5.5), np.float32, ""),
        (replace(LINE, saturation=254.5), np.uint8, ""),
        (replace(LINE, saturation=255.5), np.uint8, "saturation is 256, expected 0 to 255 for uint8 frames"),
        (replace(LINE, minimum_peak=254.5), np.uint8, ""),
        (replace(LINE, minimum_peak=255.5), np.uint8, "minimum_peak is 256, expected 0 to 255 for uint8 frames"),
    ):
        if message:
            with pytest.raises(ValueError, match=message):
                readout.launch(device, (8, 8), np.dtype(dtype))
        else:
            readout.launch(device, (8, 8), np.dtype(dtype))


def test_sizes_of_frames_that_a_readout_takes() -> None:
    """Profiles up to the longest one along the chosen axis, in frames below 2^31 pixels, for one profile or more."""
    device = gv.Device.best()
    codes = np.dtype(np.uint8)
    rows = replace(LINE, along="rows")
    LINE.launch(device, (LONGEST_PROFILE, 2), codes)
    rows.launch(device, (2, LONGEST_PROFILE), codes)
    LINE.launch(device, (2, LONGEST_PROFILE + 1), codes)
    columns = 2**31 // LONGEST_PROFILE
    LINE.launch(device, (LONGEST_PROFILE, columns - 1), codes)
    for readout, shape in (
        (LINE, (LONGEST_PROFILE + 1, 2)),
        (rows, (2, LONGEST_PROFILE + 1)),
        (LINE, (LONGEST_PROFILE, columns + 1)),
    ):
        with pytest.raises(ValueError, match=f"profiles of up to {LONGEST_PROFILE} samples in frames below 2"):
            readout.launch(device, shape, codes)
    for shape in ((0, 4), (4, 0), (5,)):
        with pytest.raises(ValueError, match="of one pixel at least"):
            LINE.launch(device, shape, codes)
    LINE.launch(device, (0, 4, 4), codes)


def test_a_unit_vector_is_kept_as_it_is() -> None:
    """A vector whose length is 1 to two roundings reads back unchanged; any other one is scaled."""
    for given in ((0.6, 0.0, 0.8), (0.36, 0.48, 0.8), (1.0 / 3.0, 2.0 / 3.0, -2.0 / 3.0)):
        assert gv.StraightTransport(h_axis=(0.0, 1e3, 1e3), direction=given).direction == given
    long = (0.6 + 1e-14, 0.0, 0.8)
    scaled = gv.StraightTransport(direction=long, h_axis=(0.0, 1.0, 0.0)).direction
    assert scaled != long
    assert math.hypot(*scaled) == pytest.approx(1.0, abs=4e-16)
    np.testing.assert_allclose(gv.StraightTransport(direction=(3.0, 12.0, -4.0)).direction, [3 / 13, 12 / 13, -4 / 13])
