"""Parameters and sizes of arrays at their limits are taken, beyond them refused; numbers that kernels get."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from field_maps import small
from gpuvision.host import Device
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.matching.features.ruler import RulerEdges, RulerTable
from gpuvision.matching.field.field_pose import FieldPoseRefinement, FieldPoseSearch
from gpuvision.matching.pose.edge_search import CellMeans, EdgeCostMap, EdgeSearch, cell_offsets
from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.matching.robust import TUNING_CONSTANTS, efficiency, resolve_tuning_constant

SINGLE, BYTE, WORD = np.dtype(np.float32), np.dtype(np.uint8), np.dtype(np.uint16)


@pytest.mark.parametrize(
    ("operation", "dtype", "taken", "refused"),
    [
        (FitLines(), SINGLE, [(2, 2), (1024, 2), (3, 5, 2, 2)], [(1, 2), (1025, 2), (2,), (2, 3)]),
        (SolvePose(), SINGLE, [(3, 7), (1024, 7), (4, 3, 7)], [(2, 7), (1025, 7), (7,), (3, 8)]),
        (SolvePose(etch_bias_sigma=1e-6), SINGLE, [(4, 8)], [(3, 8), (4, 7)]),
        (SolvePose(transform="affine"), SINGLE, [(6, 7)], [(5, 7)]),
        (CellMeans(cell_px=5), BYTE, [(15, 40), (40, 15)], [(14, 40), (40, 14), (3, 40, 40)]),
        (EdgeCostMap(threshold=1.0), SINGLE, [(3, 9), (9, 3), (2896, 2896)], [(2, 9), (9, 2), (9,)]),
        (FindBlobs(threshold=1.0, count=3), BYTE, [(2, 16)], [(2, 15), (1, 16)]),
        (EdgeSearch(rows=3, columns=2, headings=1, points=1), WORD, [(1, 3, 64), (1, 6, 16), (8, 3, 8)], [(1, 3, 63)]),
        (EdgeSearch(rows=3, columns=9, headings=1, points=1), WORD, [(8, 3, 9)], [(8, 2, 9), (8, 3, 8), (3, 9)]),
        # The kernel reads blocks of 64 positions, also from the last row.
        (EdgeSearch(rows=1, columns=2, headings=1, points=1), WORD, [(1, 4, 16)], [(1, 3, 21)]),
    ],
)
def test_sizes_of_inputs(device: Device, operation: Any, dtype: Any, taken: Any, refused: Any) -> None:
    for shape in taken:
        assert operation.launch(device, shape, dtype).inputs[0][0] == shape
    for shape in refused:
        with pytest.raises(ValueError, match=r"expected|takes|got"):
            operation.launch(device, shape, dtype)


def test_numbers_of_points_of_a_robot(device: Device) -> None:
    field_map = small(device)
    for operation in (FieldPoseSearch(map=field_map, headings=2), FieldPoseRefinement(map=field_map, count=2)):
        for count in (1, 4096):
            assert operation.launch(device, (count, 2), SINGLE).inputs[0][0] == (count, 2)
        for shape in ((0, 2), (4097, 2), (5, 3), (4, 5, 2)):
            with pytest.raises(ValueError, match="points"):
                operation.launch(device, shape, SINGLE)
    with pytest.raises(ValueError, match="max_iterations is 0, expected 1 or more"):
        FieldPoseRefinement(map=field_map, max_iterations=0)
    assert FieldPoseRefinement(map=field_map, max_iterations=1).max_iterations == 1
    np.testing.assert_allclose(FieldPoseSearch(map=field_map, headings=8).angles, np.arange(8) * math.pi / 4)


def test_a_map_of_costs_has_at_most_2_to_the_26_cells(device: Device) -> None:
    """Eight directions; 2896^2 is below 2^23, 2897 x 2896 is above."""
    costs = EdgeCostMap(threshold=1.0, border=400)
    assert costs.launch(device, (2096, 2096), SINGLE).outputs["level"][0] == (8, 2896, 2896)
    with pytest.raises(ValueError, match="2897 x 2896 cells with the border are too many"):
        costs.launch(device, (2097, 2096), SINGLE)
    constants = EdgeCostMap(threshold=6.0, border=2).launch(device, (5, 7), SINGLE).arguments
    # A quarter of the threshold, squared, and the unit normals of the directions.
    assert [float(each) for each in constants[:4]] == [5.0, 7.0, 2.0, 2.25]
    angles = np.arange(8) * math.pi / 8
    np.testing.assert_allclose(constants[4], np.column_stack([np.cos(angles), np.sin(angles)]), atol=1e-7)


@pytest.mark.parametrize(
    ("make", "taken", "refused"),
    [
        (
            lambda **of: RulerEdges(**{"threshold": 1.0, "smoothing_px": 0.3} | of),
            [
                {"length": 5},
                {"length": 512},
                {"width": 255},
                {"max_edges": 64},
                {"ambiguity": 1.0},
                {"pairs": True, "spacing_px": (0.0, 0.0)},
                {"count": 0},
                {"noise": 0.0},
                {"length": 9, "smoothing_px": 1.0},
                {"length": 9, "smoothing_px": 2.0, "step_px": 2.0},
            ],
            [
                {"length": 4},
                {"width": 256},
                {"max_edges": 65},
                {"ambiguity": 0.0},
                {"length": 8, "smoothing_px": 1.0},
                {"length": 9, "smoothing_px": 1.01},
                {"saturation": 0.0},
                {"per_ruler": True, "polarity": "rising"},
                {"per_ruler": True, "edge_selection": "first"},
            ],
        ),
        (
            lambda **of: FindBlobs(**{"threshold": 1.0} | of),
            [{"spokes": 8}, {"spokes": 256}, {"passes": 1}, {"passes": 10}, {"search_px": 199.9}, {"ratio": 0.01}],
            [{"spokes": 4}, {"spokes": 260}, {"passes": 11}, {"search_px": 200.0}, {"ratio": 0.0}, {"search_px": 0.0}],
        ),
        (
            lambda **of: SolvePose(**of),
            [
                {"min_inlier_fraction": 0.0},
                {"min_inlier_fraction": 1.0},
                {"max_leverage": 1.0},
                {"search_range": (0.0, 0.0)},
                {"max_trials": 16},
                {"max_iterations": 1},
                {"loss": "ransac"},
            ],
            [
                {"min_inlier_fraction": -0.01},
                {"max_leverage": 1.01},
                {"search_range": (-1e-9, 0.0)},
                {"max_trials": 0},
                {"scale": 0.0},
                {"min_scale": 0.0},
                {"tuning_constant": 0.0},
            ],
        ),
        (
            lambda **of: FitLines(**of),
            [{"max_trials": 1}, {"max_iterations": 1}, {"min_scale": 0.0}, {"loss": "ransac", "scale": 1e-9}],
            [{"max_iterations": 0}, {"scale": -1.0}, {"tuning_constant": 0.0}],
        ),
        (
            lambda **of: EdgeSearch(**{"rows": 1, "columns": 1, "headings": 1, "points": 1} | of),
            [{"rows": 4096}, {"columns": 4096}, {"headings": 4096}, {"points": 4096}],
            [{name: value} for name in ("rows", "columns", "headings", "points") for value in (0, 4097)],
        ),
        (lambda **of: CellMeans(**of), [{"cell_px": 1}, {"cell_px": 64}], [{"cell_px": 0}, {"cell_px": 65}]),
        (
            lambda **of: EdgeCostMap(**{"threshold": 1e-9} | of),
            [{"border": 0}],
            [{"border": -1}, {"threshold": 0.0}],
        ),
    ],
    ids=["rulers", "blobs", "poses", "lines", "searches", "cells", "costs"],
)
def test_parameters_at_their_limits(make: Any, taken: Any, refused: Any) -> None:
    for given in taken:
        make(**given)
    for given in refused:
        with pytest.raises(ValueError, match=r"expected|goes with|takes|\[0, 1\)"):
            make(**given)


def overlap(away: float) -> float:
    """Return the mean product of two bilinear samples of white noise at a distance, over their phase."""
    phases = (np.arange(400) + 0.5) / 400
    pixels = np.arange(-4.0, 300.0)
    one = np.maximum(1.0 - np.abs(pixels - phases[:, None]), 0.0)
    other = np.maximum(1.0 - np.abs(pixels - phases[:, None] - away), 0.0)
    return float(np.mean(np.sum(one * other, axis=1)))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda **of: FindBlobs(**{"threshold": 1.0} | of), "ratio"),
        (lambda **of: FindBlobs(**{"threshold": 1.0} | of), "min_inlier_fraction"),
        (lambda **of: FindBlobs(**{"threshold": 1.0} | of), "search_px"),
        (lambda **of: RulerEdges(**{"threshold": 1.0, "length": 41} | of), "ambiguity"),
        (lambda **of: SolvePose(**of), "min_inlier_fraction"),
        (lambda **of: SolvePose(**of), "max_leverage"),
    ],
)
def test_shares_and_lengths_are_not_negative(make: Any, name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name} is -0\.5, expected"):
        make(**{name: -0.5})


@pytest.mark.parametrize(("smoothing", "step", "width"), [(1.0, 1.0, 1), (2.3, 1.0, 5), (1.5, 0.5, 3), (4.0, 2.0, 2)])
def test_table_of_a_ruler(device: Device, smoothing: float, step: float, width: int) -> None:
    """The filter cuts the derivative of a Gaussian at three sigmas; the gradient of a ramp is its slope."""
    ruler = RulerEdges(
        threshold=20.0,
        length=64,
        width=width,
        smoothing_px=smoothing,
        step_px=step,
        noise=3.0,
        polarity="falling",
        pairs=True,
        spacing_px=(4.2, 19.9),
        radius_px=-25.0,
        saturation=250.0,
        count=1,
    )
    table = np.asarray(ruler.launch(device, (40, 40), SINGLE).arguments[0], np.float64)
    found = RulerTable(*table[: len(RulerTable._fields)])
    k = np.arange(1, math.ceil(3.0 * smoothing / step) + 1)
    taps = k * np.exp(-0.5 * (k * step / smoothing) ** 2)
    taps /= 2.0 * np.sum(k * taps)
    np.testing.assert_allclose(table[len(found) :], taps, rtol=1e-6)
    # The filter is the derivative of a kernel with this variance [samples^2]: its third moment over 3.
    variance = 2.0 * np.sum(k**3 * taps) / 3.0
    assert found.smoothing == pytest.approx(variance, rel=1e-6)
    # A sharp step of the threshold, on `width` lines, has the maximum of a Gaussian of this variance.
    assert found.threshold == pytest.approx(width * 20.0 / math.sqrt(2.0 * math.pi * variance), rel=1e-6)
    weights = {0: 0.0} | {int(each): float(tap) for each, tap in zip(k, taps, strict=True)}
    weights |= {-each: -tap for each, tap in weights.items()}
    reach = len(k) + 1
    # Half the difference of the gradients one sample before and after.
    half = [0.5 * (weights.get(n - 1, 0.0) - weights.get(n + 1, 0.0)) for n in range(-reach, reach + 1)]
    along = [overlap(step * n) for n in range(2 * reach + 1)]
    across = [overlap(float(n)) for n in range(width)]
    variance_of_half = sum(a * b * along[abs(i - j)] for i, a in enumerate(half) for j, b in enumerate(half))
    of_lines = sum(across[abs(i - j)] for i in range(width) for j in range(width))
    assert found.noise == pytest.approx(3.0 * math.sqrt(variance_of_half * of_lines), rel=1e-3)
    assert (found.nearest, found.farthest) == (round(4.2 / step), round(19.9 / step))
    assert (found.curvature, found.step, found.length) == (pytest.approx(-0.02), step, 64.0)
    assert found.across == pytest.approx(np.var(np.arange(width)))
    assert (found.per_line, found.polarity) == (pytest.approx(1.0 / width), -1.0)
    assert (found.saturation, found.ambiguity) == (250.0, 0.0)
    plain = replace(ruler, polarity="any", pairs=False, spacing_px=None, radius_px=None, saturation=None, ambiguity=0.4)
    table = np.asarray(plain.launch(device, (40, 40), SINGLE).arguments[0], np.float64)
    found = RulerTable(*table[: len(RulerTable._fields)])
    assert (found.nearest, found.farthest, found.curvature) == (0.0, math.inf, 0.0)
    assert (found.saturation, found.polarity, found.ambiguity) == (math.inf, 0.0, pytest.approx(0.4))


@pytest.mark.parametrize("loss", ["huber", "tukey", "ransac"])
@pytest.mark.parametrize("constant", [0.7, 2.0, 5.0, 20.0])
def test_efficiency_is_that_of_the_influence_function(loss: str, constant: float) -> None:
    """E[psi']^2 / E[psi^2] by a sum over a fine grid; the derivative of a cut quadratic has no jump counted."""
    r = np.linspace(-9.0, 9.0, 180001)
    weight = np.exp(-0.5 * r**2) / math.sqrt(2.0 * math.pi) * (r[1] - r[0])
    inside, share = np.abs(r) < constant, (r / constant) ** 2
    psi, slope = {
        "huber": (np.clip(r, -constant, constant), inside * 1.0),
        "tukey": (np.where(inside, r * (1.0 - share) ** 2, 0.0), np.where(inside, (1 - share) * (1 - 5 * share), 0.0)),
        "ransac": (np.where(inside, r, 0.0), np.where(inside, r**2, 0.0)),
    }[loss]
    # Of the cut quadratic E[psi'] = E[r psi], by parts: the jump at the constant belongs to it.
    expected = np.sum(slope * weight) ** 2 / np.sum(psi**2 * weight)
    assert efficiency(loss, constant) == pytest.approx(expected, rel=1e-4)
    assert efficiency("least_squares", constant) == 1.0


def test_tuning_constants() -> None:
    assert {loss: resolve_tuning_constant(loss, None, "X") for loss in TUNING_CONSTANTS} == TUNING_CONSTANTS
    assert resolve_tuning_constant("huber", 2, "X") == 2.0
    for wrong in (0.0, -1.0):
        with pytest.raises(ValueError, match=rf"X\.tuning_constant is {wrong}, expected a number > 0"):
            resolve_tuning_constant("huber", wrong, "X")


def test_cells_of_points_by_hand() -> None:
    """Cells of 4 px, of which cell (0, 0) has its centre at pixel 1.5; a border of 3 cells, 5 x 3 positions."""
    shape, positions = (8, 12, 15), (5, 3)
    pixels = np.array([[[1.5, 1.5], [9.5, 5.4], [3.6, 1.5], [-10.0, 1.5], [1.5, 21.0], [37.0, 1.5], [np.nan, 0.0]]])
    angle = np.array([[0.0, 0.5, 3.0, 0.0, 0.0, 0.0, 0.0]])
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    found = cell_offsets(pixels, normals, 4, 3, shape, positions)
    # The middle of 5 rows is row 2, of 3 columns column 1: cell (r, c) begins at row r + 1, column c + 2.
    first = [
        (0 * 12 + 1) * 15 + 2,
        (1 * 12 + 2) * 15 + 4,  # 0.5 is nearest to pi / 8
        (0 * 12 + 1) * 15 + 3,  # 3.0 is nearest to pi, the direction 0; 3.6 px is nearer to cell 1
        -1,  # beyond the border on the left
        (0 * 12 + 6) * 15 + 2,
        (0 * 12 + 1) * 15 + 11,
        -1,
    ]
    np.testing.assert_array_equal(found, [first])
    limits = np.array([[[1.5, 1.5 + 4 * 6], [1.5, 1.5 + 4 * 7], [1.5 + 4 * 10, 1.5], [1.5 + 4 * 11, 1.5]]])
    edges = cell_offsets(limits, np.tile([1.0, 0.0], (1, 4, 1)), 4, 3, shape, positions)
    assert (edges >= 0).tolist() == [[True, False, True, False]]


def test_rows_of_lines_broadcast() -> None:
    """One normal for three points: normal, point, displacement, sigma, and the etch factor where it is given."""
    points = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]])
    seen = points + np.array([0.25, -0.5])
    rows = line_rows([0.6, 0.8], points, seen, [1.0, 2.0, 3.0])
    expected = [[0.6, 0.8, *point, 0.25, -0.5, sigma] for point, sigma in zip(points, (1.0, 2.0, 3.0), strict=True)]
    np.testing.assert_allclose(rows, expected)
    np.testing.assert_allclose(
        line_rows([0.6, 0.8], points, seen, 2.0, [0.0, 1.0, 0.5])[:, 6:], [[2.0, 0.0], [2.0, 1.0], [2.0, 0.5]]
    )
