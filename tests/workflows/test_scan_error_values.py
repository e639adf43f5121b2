"""Values of the predicted errors of a scan, of its scatter and of its budget, by closed forms and by loops."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.ranging.focus_stack import FocusPeak, FocusStack, StageFocus
from gpuvision.ranging.range_image import RangePoints
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.workflows import scan_errors
from gpuvision.workflows.scan_errors import (
    PointSigma,
    ScanErrors,
    budget_line,
    error_budget,
    focus_errors,
    phase_scatter,
    predict_errors,
    scatter_about_plane,
)

G, H, ALONG = np.array([0.8, 0.1, -0.3]), np.array([-0.2, 0.4, 0.9]), np.array([0.48, 0.6, -0.64])
COVARIANCE = np.diag([4e-6, 9e-6, 1e-6])
SIGMA_G = np.array([[1e-6, 2e-6, 3e-6], [4e-6, 5e-6, 7e-6]])
SIGMA_H = np.array([[9e-6, 8e-6, 5e-6], [3e-6, 2e-6, 1e-6]])
FIELDS = {"sigma": np.full((2, 3), 0.05), "sigma_g": SIGMA_G, "sigma_h": SIGMA_H}
SYSTEMATIC = {"systematic_g": 0.5 * SIGMA_H, "systematic_h": 3.0 * SIGMA_G}
LENGTHS = np.array([-0.02, 0.03])
DEVICE: Any = None  # straight transport needs none


def described(**changes: Any) -> Any:
    """Return a sensor with oblique axes of the sheet."""
    axes = {"step": 1e-3, "g_axis": tuple(G), "h_axis": tuple(H), "direction": tuple(ALONG), "jitter": 3e-6}
    axes |= changes.pop("axes", {})
    parts = {"polygon": None, "encoder": None, "readout": None}
    return SimpleNamespace(**(parts | changes), transport=StraightTransport(**axes))


def points(shape: tuple[int, int] = (2, 3)) -> RangePoints:
    """Return points of which the last one is a hole."""
    x, y, z = np.ones((3, *shape), np.float32)
    x[-1, -1] = y[-1, -1] = z[-1, -1] = np.nan
    return RangePoints(x, y, z, np.zeros(shape, np.uint8))


def along(axes: Any, g: Any, h: Any) -> list[Any]:
    """Return the sums of errors of g and h along each coordinate."""
    return [abs(G[k]) * g + abs(H[k]) * h for k in range(3)]


@pytest.mark.parametrize("scale", [None, -2.4e-5])
def test_random_errors_of_a_tilted_sheet(scale: float | None) -> None:
    """An encoder of step q adds q^2 / 12 to the variance of the transport."""
    encoder = None if scale is None else SimpleNamespace(scale=scale)
    found = predict_errors(described(encoder=encoder), FIELDS, points(), LENGTHS, DEVICE)
    readout = along(None, SIGMA_G, SIGMA_H)
    jitter = math.sqrt(9e-12 + (0.0 if scale is None else scale**2 / 12.0))
    for k in range(3):
        np.testing.assert_allclose(found.readout[k], readout[k], rtol=1e-12)
        np.testing.assert_allclose(found.transport[k], np.full((2, 3), abs(ALONG[k]) * jitter), rtol=1e-12)
        np.testing.assert_allclose(found.random[k], np.sqrt(readout[k] ** 2 + (ALONG[k] * jitter) ** 2), rtol=1e-12)
    np.testing.assert_array_equal(found.position, FIELDS["sigma"])
    assert (found.systematic, found.phase, found.phase_scatter) == (None, None, 0.0)


@pytest.mark.parametrize("per_sample", [False, True])
@pytest.mark.parametrize("with_sheet", [False, True])
@pytest.mark.parametrize("with_transport", [False, True])
def test_systematic_errors_of_a_tilted_sheet(with_sheet: bool, with_transport: bool, per_sample: bool) -> None:
    """The error of the transport grows with the distance from L = 0, and is known where the point is."""
    sensor = described(axes={"covariance": COVARIANCE} if with_transport else {})
    lengths = np.outer(LENGTHS, [1.0, 1.5, 2.0]) if per_sample else LENGTHS
    fields = FIELDS | (SYSTEMATIC if with_sheet else {})
    found = predict_errors(sensor, fields, points(), lengths, DEVICE).systematic
    if not (with_sheet or with_transport):
        assert found is None
        return
    assert found is not None
    sheet = along(None, SYSTEMATIC["systematic_g"], SYSTEMATIC["systematic_h"]) if with_sheet else [0.0] * 3
    distance = np.abs(lengths if per_sample else np.repeat(lengths[:, None], 3, axis=1))
    for k in range(3):
        expected = sheet[k] + np.zeros((2, 3))
        if with_transport:
            expected = np.sqrt(expected**2 + (distance * math.sqrt(COVARIANCE[k, k])) ** 2)
            expected[-1, -1] = np.nan
            assert found[k].dtype == np.float32
        np.testing.assert_allclose(found[k], expected, rtol=1e-6)


def test_errors_behind_a_polygon_mirror_lie_along_the_beam() -> None:
    """The beam turns at twice the rotation of the mirror; from the vertical h towards -g."""
    rotation = 0.1 - 0.3 * np.arange(3)
    polygon = SimpleNamespace(rotations=lambda samples: rotation[:samples])
    found = predict_errors(described(polygon=polygon), FIELDS, points(), LENGTHS, DEVICE)
    for sample, phi in enumerate(rotation):
        beam = np.array([[math.cos(2 * phi), -math.sin(2 * phi)], [math.sin(2 * phi), math.cos(2 * phi)]]) @ [0.0, 1.0]
        moved = np.abs(beam[0] * G + beam[1] * H)
        for k in range(3):
            np.testing.assert_allclose(found.readout[k][:, sample], moved[k] * SIGMA_H[:, sample], rtol=1e-12)


def test_errors_of_a_focus_stack_lie_along_the_height() -> None:
    stack = FocusStack(geometry=StageFocus(start=1e-3, step=-5e-5, pixel_size=1e-5), read_noise=1.0)
    sigma = np.array([[0.1, 0.02, 0.03], [0.04, 0.05, 0.06]])
    status = np.zeros((2, 3), np.uint8)
    peak = FocusPeak(np.full((2, 3), 2.25), np.ones((2, 3), np.float32), status, sigma)
    found = focus_errors(described(), stack, peak, points())
    known = np.isfinite(points().z)
    for k in range(3):
        expected = np.where(known, 5e-5 * abs(H[k]) * sigma, np.nan)
        np.testing.assert_allclose(found.readout[k], expected, rtol=1e-5)
        np.testing.assert_array_equal(found.transport[k], np.where(known, 0.0, np.nan))
        assert found.readout[k].dtype == found.transport[k].dtype == np.float32
    assert found.random is found.readout
    assert found.position is sigma
    assert found.systematic is None


# ---- scatter ---------------------------------------------------------------------------------------------------


def robust_scatter(z: Any) -> float:
    """Return the scatter about planes, fitted one by one to 3 x 3 samples."""
    design = np.array([[1.0, i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    residuals = []
    for row in range(1, z.shape[0] - 1):
        for column in range(1, z.shape[1] - 1):
            part = z[row - 1 : row + 2, column - 1 : column + 2]
            if np.isfinite(part).all():
                plane = np.linalg.lstsq(design, part.ravel())[0]
                residuals.append(part[1, 1] - plane[0])
    deviation = np.median(np.abs(np.array(residuals) - np.median(residuals)))
    # Of a normal residual, whose variance is 8/9 of that of a sample, the median deviation is 0.6745 sigmas.
    return float(deviation / 0.6744897501960817 / math.sqrt(8.0 / 9.0))


@pytest.mark.parametrize("shape", [(3, 103), (103, 3), (9, 20)])
def test_scatter_is_that_of_residuals_from_fitted_planes(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    z = 1e-3 * rng.exponential(size=shape) + 0.1 * np.arange(shape[1]) - 0.3 * np.arange(shape[0])[:, None]
    z[0, 0] = np.nan
    assert scatter_about_plane(z) == pytest.approx(robust_scatter(z), rel=1e-9)


@pytest.mark.parametrize("shape", [(3, 102), (102, 3)])
def test_a_hundred_residuals_are_enough(rng: np.random.Generator, shape: tuple[int, int]) -> None:
    z = rng.normal(size=shape)
    assert scatter_about_plane(z) == pytest.approx(robust_scatter(z), rel=1e-9)
    z[0, 0] = np.nan  # one residual less
    assert math.isnan(scatter_about_plane(z))
    for few in (z[:2], z[:, :2], z[:1, :1], z[:0]):
        assert math.isnan(scatter_about_plane(few))


@pytest.mark.parametrize(("profiles", "count"), [(0, 0), (2, 0), (3, 1), (9, 7), (258, 256), (259, 256), (5000, 256)])
def test_profiles_between_two_others_are_spread_evenly(profiles: int, count: int) -> None:
    found = scan_errors._middles(profiles)
    assert len(set(found)) == len(found) == count
    if count:
        assert (found[0], found[-1]) == (1, profiles - 2)
        assert count == 1 or np.ptp(np.diff(found)) <= 1


@pytest.mark.parametrize("shape", [(3, 3), (3, 8), (8, 3), (300, 4)])
@pytest.mark.parametrize(("a", "b"), [(0.05, 0.02), (0.01, 0.07), (-0.03, 0.0), (0.11, -0.02)])
def test_share_of_the_phase_by_its_closed_form(a: float, b: float, shape: tuple[int, int]) -> None:
    """Of a position with slopes a and b; the residual has 8/9 of the variance of a sample."""
    position = 30.0 + a * np.arange(shape[0])[:, None] + b * np.arange(shape[1])
    shares = []
    for k in (1, 2):
        mean = np.mean([np.exp(2j * np.pi * k * (a * i + b * j)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
        shares.append(abs(1.0 - mean) ** 2 / (8.0 / 9.0))
    assert max(shares) < 1.0
    assert phase_scatter(position) == pytest.approx(max(shares), rel=1e-6)
    position[0, 0] = np.nan
    assert phase_scatter(position) == pytest.approx(0.0 if shape == (3, 3) else max(shares), rel=1e-6)
    for profiles, samples in ((2, 9), (9, 2), (1, 1), (0, 3)):
        assert phase_scatter(position[:profiles, :samples]) == 0.0


# ---- budget ----------------------------------------------------------------------------------------------------


def sigma_of(*values: float) -> PointSigma:
    """Return standard deviations whose medians are the values; a part of them is not known."""
    return PointSigma(*(np.array([each, 0.5 * each, 9.0 * each, np.nan]) for each in values))


def errors_of(**changes: Any) -> ScanErrors:
    parts = {
        "position": np.array([0.04, 0.01, 0.9, np.nan]),
        "readout": sigma_of(1e-6, 2e-6, 3e-6),
        "transport": sigma_of(4e-6, 5e-6, 6e-6),
        "random": sigma_of(7e-6, 8e-6, 9e-6),
        "systematic": sigma_of(1.1e-5, 1.2e-5, 1.3e-5),
        "map_systematic": np.array([2e-5, 1e-5, 3e-5]),
        "phase": sigma_of(1.4e-5, 1.5e-5, 4e-6),
        "map_phase": np.array([5e-6, 1e-6, 6e-6]),
        "phase_scatter": 0.25,
    }
    return ScanErrors(**(parts | changes))


def rough(scatter: float) -> Any:
    """Return heights that scatter by a length about local planes."""
    z = np.random.default_rng(5).normal(size=(15, 16))
    return z * (scatter / robust_scatter(z))


def test_budget_of_a_scan() -> None:
    """The phase scatters by 4 um times the root of 0.25: the noise of 3 um and it explain 3.606 um."""
    budget = error_budget(errors_of(), rough(8e-6), np.array([1e-6, 2e-6, np.nan, 9e-6]), camera=True)
    explained = math.sqrt(3e-6**2 + 2e-6**2)
    assert budget == {
        "random": {
            "readout": pytest.approx({"x": 1e-6, "y": 2e-6, "z": 3e-6}),
            "transport": pytest.approx({"x": 4e-6, "y": 5e-6, "z": 6e-6}),
            "total": pytest.approx({"x": 7e-6, "y": 8e-6, "z": 9e-6}),
        },
        "systematic": {"calibration": pytest.approx({"x": 1.1e-5, "y": 1.2e-5, "z": 1.3e-5})},
        "phase": pytest.approx({"x": 1.4e-5, "y": 1.5e-5, "z": 4e-6}),
        "map": {"random": 2e-6, "systematic": 2e-5, "phase": 5e-6},
        "position": 0.04,
        "measured": {
            "scatter": pytest.approx(8e-6),
            "ratio": pytest.approx(8e-6 / explained),
            # The scatter of the positions that adds to the predicted one of 0.04 px, which is 3 um of z.
            "speckle": pytest.approx(0.04 * math.sqrt(8e-6**2 - explained**2) / 3e-6),
        },
    }
    assert budget_line(budget) == (
        "sigma of z 9 um random (readout 3 um, transport 6 um); 13 um systematic; "
        "4 um by the phase of the line in its pixel; z scatters by 8 um about a local plane (2.22 times the predicted)"
    )


@pytest.mark.parametrize(
    ("changes", "scatter", "camera", "ratio", "speckle"),
    [
        ({}, 8e-6, False, 8.0 / math.sqrt(13.0), False),  # metres of a PSD
        # A sine has a median absolute deviation of 1.4826 times its root mean square: up to hypot(3, 1.4826 * 2) um.
        ({}, 4.21e-6, True, 4.21 / math.sqrt(13.0), False),
        ({}, 4.23e-6, True, 4.23 / math.sqrt(13.0), True),
        ({"phase": None}, 3.01e-6, True, 3.01 / 3.0, True),
        ({"phase": None}, 2.99e-6, True, 2.99 / 3.0, False),
        ({"phase": sigma_of(np.nan, np.nan, np.nan)}, 6e-6, True, 2.0, True),
        ({"readout": sigma_of(1e-6, 1e-6, 0.0)}, 6e-6, True, None, False),
        ({"position": np.full(3, np.nan)}, 6e-6, True, None, False),
    ],
)
def test_what_explains_the_scatter(
    changes: dict[str, Any], scatter: float, camera: bool, ratio: float | None, speckle: bool
) -> None:
    measured = error_budget(errors_of(**changes), rough(scatter), None, camera=camera)["measured"]
    assert measured["ratio"] == (None if ratio is None else pytest.approx(ratio))
    assert (measured["speckle"] is not None) == speckle


def test_what_is_not_known_is_said() -> None:
    holes = np.full((5, 5), np.nan)
    unknown = {"systematic": None, "phase": None, "map_systematic": None, "map_phase": None}
    budget = error_budget(errors_of(**unknown), holes, None, camera=True)
    assert (budget["systematic"], budget["phase"]) == (None, None)
    assert budget["map"] == {"random": None, "systematic": None, "phase": None}
    assert budget["measured"] == {"scatter": None, "ratio": None, "speckle": None}
    line = "sigma of z 9 um random (readout 3 um, transport 6 um); systematic unknown: no covariance"
    assert budget_line(budget) == line
    of_readout = error_budget(errors_of(transport=sigma_of(*[np.nan] * 3)), holes, None, camera=True)
    assert "(readout 3 um, transport unknown); 13 um systematic; 4 um by the phase" in budget_line(of_readout)
    blind = error_budget(errors_of(random=sigma_of(1e-6, 1e-6, np.nan)), rough(8e-6), None, camera=True)
    assert budget_line(blind) == "z scatters by 8 um about a local plane (2.22 times the predicted)"
    nothing = error_budget(None, rough(8e-6), None, camera=True)
    assert nothing["measured"] == {"scatter": pytest.approx(8e-6), "ratio": None, "speckle": None}
    assert all(nothing[name] is None for name in ("random", "systematic", "phase", "map", "position"))
    assert budget_line(nothing) == "z scatters by 8 um about a local plane"
