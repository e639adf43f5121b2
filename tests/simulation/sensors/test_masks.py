"""Masks: transmitted light, and optimal windows."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpuvision.camera.lens import Lens
from gpuvision.simulation.sensors.masks import Mask, _widest_cuts, optimise_mask
from gpuvision.simulation.sensors.readings import GroundTruth, height_secant, sheet_point
from gpuvision.simulation.sensors.sensor_view import Exposure
from lights import LENGTH, gaussian, psd, psd_view

# Centroid of the secondary light of a 90 degree corner under a mask of length beta a, in units of a.
CORNER = [(1, 0.594984), (2, 0.993527), (5, 1.656779), (10, 2.224535), (100, 4.341808)]


def corner_glow(edges: np.ndarray, a: float) -> Exposure:
    """Return the light of E = a b / (2 (a^2 + b^2)^1.5) in bins along b, exactly."""
    power = 0.5 * -np.diff(1.0 / np.sqrt(1.0 + (edges / a) ** 2))
    first = 0.5 * a * np.diff(np.arcsinh(edges / a) - edges / a / np.sqrt(1.0 + (edges / a) ** 2))
    return Exposure(power[None], (first - power * 0.5 * (edges[1:] + edges[:-1]))[None])


def centre(light: Exposure, edges: np.ndarray) -> np.ndarray:
    return light.first_moment(edges) / light.total()


@pytest.mark.parametrize(("beta", "expected"), CORNER)
def test_corner_through_a_mask(beta: int, expected: float) -> None:
    """The centroid of a corner's secondary light increases with the mask without limit: 0.594984 a ... 4.341808 a."""
    a = 1e-3
    edges = np.linspace(0.0, 200.0 * a, 4001)
    mask = Mask(windows=[[0.0, edges[20 * beta]]])
    assert centre(mask.apply(corner_glow(edges, a), edges), edges)[0] / a == pytest.approx(expected, abs=1e-6)
    # Light is uniform within a bin: the error is second order in the bin width.
    coarse = np.linspace(0.0, 200.0 * a, 777)
    assert centre(mask.apply(corner_glow(coarse, a), coarse), coarse)[0] / a == pytest.approx(expected, rel=0.01)


def test_windows_within_bins_converge() -> None:
    """The windows end anywhere within bins; the error falls with the square of the bins' width."""
    a = 1e-3
    beta = np.linspace(3.0, 8.0, 40)
    slant = np.sqrt(1.0 + beta**2)
    exact = (np.arcsinh(beta) - beta / slant) / (1.0 - 1.0 / slant)
    errors = []
    for bins in (50, 100, 200):
        edges = np.linspace(0.0, 30.0 * a, bins + 1)
        light = corner_glow(edges, a)
        centres = [centre(Mask(windows=[[0.0, each * a]]).apply(light, edges), edges)[0] / a for each in beta]
        errors.append(np.sqrt(np.mean((centres - exact) ** 2)))
    assert errors[0] < 2e-3
    assert 3.0 < errors[0] / errors[1] < 6.0
    assert 3.0 < errors[1] / errors[2] < 6.0


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    ends=st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)),
    leak=st.floats(0.0, 1.0),
)
def test_light_through_a_window(seed: int, ends: tuple[float, float], leak: float) -> None:
    """Light is conserved and stays in its bin; two adjacent windows pass the same light as one window over both."""
    rng = np.random.default_rng(seed)
    edges = np.sort(rng.uniform(-3.0, 3.0, 8))
    power = rng.uniform(0.0, 1.0, (2, 7)) * (rng.uniform(size=(2, 7)) > 0.3)
    light = Exposure(power, power * rng.uniform(-0.5, 0.5, (2, 7)) * np.diff(edges))
    low, high = sorted(ends)
    passing = Mask(windows=[[low, high]] * 2, leak=leak).apply(light, edges)
    assert np.all(passing.power >= leak * light.power - 1e-15)
    assert np.all(passing.power <= light.power + 1e-15)
    assert np.all(np.abs(passing.moment) <= 0.5 * np.diff(edges) * passing.power + 1e-15)
    middle = 0.5 * (low + high)
    halves = [Mask(windows=[pair] * 2).apply(light, edges) for pair in ([low, middle], [middle, high])]
    wide = Mask(windows=[[low, high]] * 2).apply(light, edges)
    np.testing.assert_allclose((halves[0] + halves[1]).power, wide.power, atol=1e-14)
    np.testing.assert_allclose((halves[0] + halves[1]).moment, wide.moment, atol=1e-14)


def test_a_leak_adds_its_share_of_the_light_outside(rng: np.random.Generator) -> None:
    """Windows at edges of bins are exact: inside all light passes, outside the leak; transmission comes before."""
    edges = np.array([0.0, 1.0, 2.5, 3.0, 5.0])
    light = Exposure(rng.uniform(1.0, 2.0, (2, 3, 4)), rng.uniform(-0.2, 0.2, (2, 3, 4)))
    windows = [[1.0, 3.0], [0.0, 2.5], [5.0, 5.0]]
    inside = np.array([[0, 1, 1, 0], [1, 1, 0, 0], [0, 0, 0, 0]])
    shares = rng.uniform(0.0, 1.0, (3, 4))
    for leak in (0.0, 0.25, 1.0):
        for transmission in (None, shares):
            passing = Mask(windows=windows, leak=leak, transmission=transmission).apply(light, edges)
            share = (inside + leak * (1 - inside)) * (1.0 if transmission is None else shares)
            np.testing.assert_allclose(passing.power, share * light.power, rtol=1e-14)
            np.testing.assert_allclose(passing.moment, share * light.moment, rtol=1e-13)


def test_a_window_within_a_bin_divides_its_light() -> None:
    """A bin from 2 to 4 with its centroid at 3.5: the light is even from 3 to 4, with any window."""
    edges = np.array([2.0, 4.0])
    light = Exposure(np.array([[8.0]]), np.array([[4.0]]))
    for window, power, place in (
        ((3.25, 3.75), 4.0, 3.5),
        ((0.0, 3.25), 2.0, 3.125),
        ((3.75, 9.0), 2.0, 3.875),
        ((2.0, 3.0), 0.0, 3.0),
        ((2.0, 4.0), 8.0, 3.5),
        ((2.5, 3.5), 4.0, 3.25),
    ):
        passing = Mask(windows=[window]).apply(light, edges)
        assert passing.power[0, 0] == pytest.approx(power, abs=1e-15)
        assert passing.moment[0, 0] == pytest.approx(power * (place - 3.0), abs=1e-15)


def test_masks_that_are_no_windows_are_not_written(tmp_path: Path) -> None:
    windows = [[0.0, 1.0], [1.0, 2.0]]
    for mask in (
        Mask(),
        Mask(windows=[windows]),
        Mask(windows=windows, transmission=[[1.0]]),
        Mask(windows=windows, leak=1e-9),
    ):
        with pytest.raises(ValueError, match="only a mask of one window per sample"):
            mask.save(tmp_path / "mask.txt")
    for text in ("1, 2\n3\n", "1\n2\n", "a, b\n"):
        (tmp_path / "wrong.txt").write_text(text)
        with pytest.raises(ValueError, match="two numbers a line"):
            Mask.load(tmp_path / "wrong.txt")
    (tmp_path / "one.txt").write_text("1, 2\n")
    np.testing.assert_array_equal(Mask.load(tmp_path / "one.txt").windows, [[1.0, 2.0]])


def test_a_point_of_light_passes_or_does_not() -> None:
    """All light at one end of its bin: no width to divide."""
    edges = np.array([0.0, 1.0, 2.0])
    light = Exposure(np.array([[1.0, 1.0]]), np.array([[0.5, -0.5]]))
    for window, expected in (([0.5, 1.5], [1.0, 1.0]), ([0.2, 0.9], [0.0, 0.0]), ([1.0, 1.0], [0.0, 0.0])):
        assert Mask(windows=[window]).apply(light, edges).power.sum() == np.sum(expected)


def test_transmission() -> None:
    view = psd_view(6)
    light = gaussian(view, [0.3e-3], 1e-6, 1e-3)
    shares = np.linspace(0.0, 1.0, 30).reshape(5, 6)
    passing = Mask(transmission=shares).apply(light, view.u_edges)
    np.testing.assert_allclose(passing.power, shares * light.power, rtol=1e-15)
    np.testing.assert_allclose(passing.moment, shares * light.moment, rtol=1e-15)


def test_files(tmp_path: Path) -> None:
    mask = Mask(windows=[[-1e-3, 1 / 3e3], [0.0, 0.0]])
    mask.save(tmp_path / "mask.txt")
    np.testing.assert_array_equal(Mask.load(tmp_path / "mask.txt").windows, mask.windows)
    with pytest.raises(ValueError, match="without leak"):
        Mask(windows=[[0.0, 1.0]], leak=0.1).save(tmp_path / "other.txt")
    (tmp_path / "three.txt").write_text("1, 2, 3\n")
    with pytest.raises(ValueError, match="two numbers a line"):
        Mask.load(tmp_path / "three.txt")


def test_what_is_refused() -> None:
    for wrong in ({"windows": [[1.0, 0.0]]}, {"windows": [[0.0, np.nan]]}, {"windows": [0.0, 1.0]}, {"leak": 2.0}):
        with pytest.raises(ValueError, match="expected"):
            Mask(**wrong)
    with pytest.raises(ValueError, match="shares from 0 to 1"):
        Mask(transmission=[[1.5]])
    with pytest.raises(ValueError, match="does not fit"):
        Mask(windows=[[0.0, 1.0]] * 3).apply(psd_view().dark(), psd_view().u_edges)


@pytest.mark.parametrize("lens", [None, Lens(k1=-4000.0)])
def test_mask_about_an_expected_profile(lens: Lens | None) -> None:
    """The window ends are at the requested heights, above and below; it is closed where no line is expected."""
    view = psd_view()
    view = replace(view, triangulation=replace(view.triangulation, lens=lens))
    u = np.array([-2e-3, -1e-3, np.nan, 1e-3, 2.9e-3])
    truth = GroundTruth(*sheet_point(view.triangulation, u, view.v_centres), np.zeros(5, np.uint8))
    windows = Mask.around_profile(view, truth, 2e-3).windows
    assert windows[2, 0] == windows[2, 1]
    assert windows[4, 1] == 0.5 * LENGTH
    seen = [0, 1, 3]
    for end, rise in ((0, -2e-3), (1, 2e-3)):
        _, h = sheet_point(view.triangulation, windows[:, end], view.v_centres)
        np.testing.assert_allclose(h[seen], truth.h[seen] + rise, atol=1e-12)
    with pytest.raises(ValueError, match="half_height is 0"):
        Mask.around_profile(view, truth, 0.0)


# ---- the best mask -------------------------------------------------------------------------------------------


def part(profiles: int = 12) -> tuple:
    """Return a part whose line wanders over the strips, with a glow far from it, and its truth."""
    view = psd_view(120)
    rng = np.random.default_rng(1)
    u = 1.2e-3 * np.sin(np.linspace(0.0, 4.0, profiles))[:, None] + rng.uniform(-2e-4, 2e-4, (profiles, view.samples))
    light = {
        "direct": gaussian(view, u, 1e-6, 4e-5),
        "diffuse-diffuse": gaussian(view, np.full((profiles, view.samples), -2.0e-3), 2e-7, 3e-4),
    }
    g, h = sheet_point(view.triangulation, u, view.v_centres)
    return view, light, GroundTruth(g, h, np.zeros(u.shape, np.uint8)), u


@pytest.mark.parametrize("objective", ["max", "rms"])
def test_fixed_mask(objective: str) -> None:
    """No other window that passes the required light has a smaller error: all windows are tried."""
    view, light, truth, u = part()
    plan = optimise_mask(view, light, truth, objective=objective, min_passed_fraction=0.999)
    assert np.all(plan.passed_fraction >= 0.999)
    assert plan.mask.windows.shape == (view.samples, 2)
    slope = height_secant(view.triangulation, u, u, view.v_centres)
    total = light["direct"] + light["diffuse-diffuse"]
    judge = (lambda e: np.abs(e).max(axis=0)) if objective == "max" else (lambda e: np.sqrt(np.mean(e**2, axis=0)))
    np.testing.assert_allclose(judge(plan.error_before), judge((centre(total, view.u_edges) - u) * slope), rtol=1e-9)
    best = np.full(view.samples, np.inf)
    for low, high in itertools.combinations(range(121), 2):
        allowed = (_tails(light["direct"], low, high) <= 0.0005).all(axis=0)
        if allowed.any():
            mask = Mask(windows=np.broadcast_to(view.u_edges[[low, high]], (view.samples, 2)))
            cost = judge((centre(mask.apply(total, view.u_edges), view.u_edges) - u) * slope)
            best = np.where(allowed, np.minimum(best, cost), best)
    np.testing.assert_allclose(judge(plan.error_after), best, rtol=1e-9)
    assert np.all(judge(plan.error_after) < 0.5 * judge(plan.error_before))


def _tails(direct: Exposure, low: int, high: int) -> np.ndarray:
    """Return the larger share that is cut at either end."""
    total = direct.power.sum(axis=-1)
    return np.maximum(direct.power[..., :low].sum(axis=-1), direct.power[..., high:].sum(axis=-1)) / total


def test_mask_that_follows_the_part() -> None:
    """A window for every profile removes nearly all secondary light that is separate from the line."""
    view, light, truth, u = part()
    fixed = optimise_mask(view, light, truth)
    follows = optimise_mask(view, light, truth, fixed=False)
    assert follows.mask.windows.shape == (*u.shape, 2)
    assert np.all(follows.passed_fraction >= 0.999)
    assert np.abs(follows.error_after).max() < 0.05 * np.abs(fixed.error_after).max()
    assert np.all((follows.mask.windows[..., 0] < u) & (u < follows.mask.windows[..., 1]))


def test_margin_keeps_away_from_valid_light() -> None:
    view, light, truth, u = part()
    windows = optimise_mask(view, light, truth, min_passed_fraction=0.999, margin=3e-4).mask.windows
    # 99.95 % of a Gaussian on either side correspond to 3.29 sigma; a bin is 50 um wide.
    assert np.all(windows[:, 0] <= u.min(axis=0) - 3e-4 - 3.29 * 4e-5 + 5e-5)
    assert np.all(windows[:, 1] >= u.max(axis=0) + 3e-4 + 3.29 * 4e-5 - 5e-5)


@pytest.mark.parametrize("margin", [0.0, 0.5, 0.75, 1.0, 2.25, 40.0])
def test_widest_cuts_by_their_definition(margin: float, rng: np.random.Generator) -> None:
    """The last edge and the first one that pass the light and keep the margin; all numbers are exact."""
    edges = np.cumsum(np.r_[-3.0, rng.integers(1, 5, 20) * 0.25])
    power = rng.integers(0, 9, (4, 3, 20)) * (rng.random((4, 3, 20)) < 0.5) * 1.0
    power[..., 10] += 64.0
    valid = rng.random((4, 3)) < 0.8
    low, high = _widest_cuts(edges, Exposure(power, 0.0 * power), valid, 0.75, margin)
    for place in np.ndindex(valid.shape):
        light = power[place]
        spare = 0.125 * light.sum()
        one = max(k for k in range(21) if light[:k].sum() <= spare)
        other = min(k for k in range(21) if light[k:].sum() <= spare)
        if margin:
            one = max((k for k in range(21) if edges[k] <= edges[one] - margin), default=0)
            other = min((k for k in range(21) if edges[k] >= edges[other] + margin), default=20)
        assert (low[place], high[place]) == ((one, other) if valid[place] else (20, 0))


def test_a_margin_wider_than_the_strip_opens_all_of_it() -> None:
    view, light, truth, _ = part(4)
    windows = optimise_mask(view, light, truth, margin=2.0 * LENGTH).mask.windows
    np.testing.assert_array_equal(windows, np.broadcast_to(view.u_edges[[0, -1]], windows.shape))


def test_samples_without_valid_light_are_closed() -> None:
    """They would read only secondary light, so no reading is better."""
    view, light, truth, u = part(4)
    dark = np.zeros(u.shape, bool)
    dark[:, 2] = dark[1, 3] = True
    direct = Exposure(*(np.where(dark[..., None], 0.0, each) for each in light["direct"]))
    light = light | {"direct": direct}
    plan = optimise_mask(view, light, GroundTruth(truth.g, np.where(dark, np.nan, truth.h), truth.status))
    assert plan.mask.windows[2, 0] == plan.mask.windows[2, 1]
    assert np.isfinite(plan.error_after).tolist() == (~dark).tolist()
    masked = psd(view, mask=plan.mask).currents(light)
    assert not masked[:, 2].any()
    assert masked[:, [0, 1, 3, 4]].all()


def test_a_camera_of_many_pixels() -> None:
    """The search over several rounds finds the tightest window where it is optimal."""
    edges = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, 1025)
    view = psd_view(1024)
    np.testing.assert_array_equal(edges, view.u_edges)
    u = np.array([[-1e-3, -5e-4, 0.0, 5e-4, 1e-3]])
    glow = np.broadcast_to(np.linspace(0.0, 1e-9, 1024), (1, 5, 1024))
    light = {"direct": gaussian(view, u, 1e-6, 4e-5), "multi-bounce": Exposure(glow, np.zeros_like(glow))}
    g, h = sheet_point(view.triangulation, u, view.v_centres)
    plan = optimise_mask(view, light, GroundTruth(g, h, np.zeros(u.shape, np.uint8)), min_passed_fraction=0.9999)
    assert np.abs(plan.error_after).max() < 0.02 * np.abs(plan.error_before).max()


def test_what_optimising_refuses() -> None:
    view, light, truth, _ = part(2)
    with pytest.raises(ValueError, match="objective is 'best'"):
        optimise_mask(view, light, truth, objective="best")
    with pytest.raises(ValueError, match="0 < min_passed_fraction <= 1"):
        optimise_mask(view, light, truth, min_passed_fraction=0.0)
    with pytest.raises(ValueError, match="profiles, samples, bins"):
        optimise_mask(view, {"direct": view.dark()}, truth)
