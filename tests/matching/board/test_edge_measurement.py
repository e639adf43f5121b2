"""View of a board whose artwork is moved, against complex numbers."""

from __future__ import annotations

import cmath
import math
import re
import types
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.board import edge_measurement
from gpuvision.matching.board.edge_measurement import BoardMeasurer, _reason_of, move_view
from gpuvision.matching.board.measurement_result import Copper, MeasurementLimits
from gpuvision.status import Status

LENGTHS = st.floats(-0.2, 0.2)
ANGLES = st.floats(-math.pi, math.pi)
POSES = st.tuples(LENGTHS, LENGTHS, ANGLES)


@given(place=POSES, moved=POSES)
def test_a_moved_board_is_seen_by_the_moved_view(place, moved) -> None:
    """The camera at q = R p + t sees the artwork point p; its angle on the artwork is less by the rotation."""
    seen = move_view(BoardView(scale=20e-6, shape=(400, 600), pose=place), moved)
    point = complex(*seen.pose[:2]) * cmath.exp(1j * moved[2]) + complex(*moved[:2])
    assert point == pytest.approx(complex(*place[:2]), abs=1e-12)
    assert cmath.exp(1j * seen.pose[2]) == pytest.approx(cmath.exp(1j * (place[2] - moved[2])), abs=1e-12)
    assert abs(seen.pose[2]) <= math.pi


def test_pixels_of_a_moved_board_are_those_of_the_board() -> None:
    view = BoardView(scale=20e-6, shape=(400, 600), pose=(0.05, -0.02, 2.9), mirrored=True)
    x, y, theta = 0.01, 0.03, -1.7
    points = np.array([[0.04, 0.01], [-0.02, 0.03], [0.0, 0.0]])
    on_board = np.exp(1j * theta) * (points @ [1.0, 1j]) + complex(x, y)
    pixels = move_view(view, (x, y, theta)).to_pixels(points)
    np.testing.assert_allclose(pixels, view.to_pixels(np.stack([on_board.real, on_board.imag], -1)), atol=1e-6)


@pytest.mark.parametrize(
    ("status", "inlier_fraction", "leverage", "words"),
    [
        (Status.OUT_OF_RANGE | Status.AMBIGUOUS, 0.1, 0.9, "outside the search range"),
        (Status.NO_DATA, 1.0, 0.9, r"^12 edges .* were found, too few for a pose \(NO_DATA\)"),
        (Status.AMBIGUOUS, 0.29, 0.9, r"^5 of the 12 edges found .* 29% of their information, expected 30% or more"),
        (Status.AMBIGUOUS, 0.3, 0.9, "a single edge that no other edge checks"),
        (Status.AMBIGUOUS, np.nan, 0.01, "a single edge that no other edge checks"),
        (Status.AMBIGUOUS, 0.3, 0.0, "do not determine x, y and theta"),
        (Status.AMBIGUOUS, np.nan, np.nan, "do not determine x, y and theta"),
    ],
)
def test_reasons_of_a_refused_pose(status: Status, inlier_fraction: float, leverage: float, words: str) -> None:
    values = {"status": np.uint8(status), "inlier_fraction": inlier_fraction, "leverage": leverage, "inliers": 5}
    fit: Any = types.SimpleNamespace(**{name: np.array(value) for name, value in values.items()})
    assert re.search(words, _reason_of(fit, 12, MeasurementLimits()))


@pytest.mark.parametrize(
    ("distance", "is_first", "search_px"),
    [(3e-4, True, 17.5), (3e-3, True, 152.5), (4e-3, True, 190.0), (3e-4, False, 4)],
)
def test_range_in_which_fiducials_are_searched(
    monkeypatch: pytest.MonkeyPatch, distance: float, is_first: bool, search_px: float
) -> None:
    """Their distance, three sigmas of the etch bias and the slack; at most 190 px, in the second pass 4 px."""
    monkeypatch.setattr(edge_measurement, "search_distance", lambda *_: np.array([0.5, 1.0]) * distance)
    monkeypatch.setattr(edge_measurement, "find_fiducials", lambda *_, **how: how["search_px"])
    device: Any = None
    features: Any = types.SimpleNamespace(fiducials=types.SimpleNamespace(point=None), placement=None, imaging=None)
    measurer = BoardMeasurer(
        np.zeros((2, 2), np.float32),
        features,
        noise=1.0,
        threshold=10.0,
        blur_px=1.0,
        etch_bias_sigma=10e-6,
        device=device,
        limits=MeasurementLimits(),
    )
    view: Any = types.SimpleNamespace(scale=20e-6)
    assert measurer._find_fiducials(view, "bright", is_first=is_first) == pytest.approx(search_px)


@pytest.mark.parametrize(("copper", "polarities"), [("bright", ["falling", "rising"]), ("dark", ["rising", "falling"])])
def test_rulers_of_edges_and_of_traces(monkeypatch: pytest.MonkeyPatch, copper: Copper, polarities: list[str]) -> None:
    """Single edges, then traces of 4 px and of 10 to 11 px: widths are searched from 0.6 w - 2 to 1.4 w + 2 pixels.

    The least width is 1 px.
    """
    rulers: list[dict[str, Any]] = []

    def measure(**how: Any) -> Any:
        rulers.append(how)
        return lambda _, placed, **more: types.SimpleNamespace(
            position=placed[:, 0], sigma=np.full(len(placed), 0.3), status=np.full(len(placed), 2)
        )

    monkeypatch.setattr(edge_measurement, "RulerEdges", measure)
    view = BoardView(scale=1e-4, shape=(40, 60), pose=(0.0, 0.0, 0.0))
    features: Any = types.SimpleNamespace(
        point=np.array([[1e-3, 0.0], [2e-3, 0.0], [-1e-3, 0.0], [3e-4, 0.0]]),
        normal=np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]),
        spacing=np.array([1.1e-3, 0.0, 1e-3, 0.4e-3]),
        imaging=types.SimpleNamespace(width_px=5, smoothing_ratio=1.5),
    )
    device: Any = None
    limits = MeasurementLimits()
    measurer = BoardMeasurer(
        np.zeros((40, 60), np.float32),
        features,
        noise=1.0,
        threshold=10.0,
        blur_px=1.0,
        etch_bias_sigma=10e-6,
        device=device,
        limits=limits,
    )
    found = measurer._measure_rulers(view, copper, np.array([20.0, 33.0, 10.0, 15.0]))
    assert [each["pairs"] for each in rulers] == [False, True, True]
    assert [each["spacing_px"] for each in rulers] == [None, pytest.approx((1.0, 7.6)), pytest.approx((4.0, 17.4))]
    assert [each["polarity"] for each in rulers] == [*polarities, polarities[1]]
    assert [(each["length"], each["smoothing_px"], each["width"]) for each in rulers] == [(48, 1.5, 5)] * 3
    np.testing.assert_allclose(found.position_px, 29.5 + np.array([10.0, 20.0, -10.0, 3.0]))
    np.testing.assert_allclose(found.sigma, np.hypot(0.3, limits.sampling_sigma_px) * 1e-4)
    np.testing.assert_array_equal(found.status, 2)
    np.testing.assert_array_equal(found.weight, 0.0)
    assert np.isnan(found.residual).all()
