"""Features in a view: rulers and fiducials that stay in the image at every board position, and windows of a view."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.board import view_features
from gpuvision.matching.board.view_features import features_in_view
from gpuvision.matching.features.candidates import FeatureCandidates
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.fiducials import Fiducials
from gpuvision.matching.features.imaging import Imaging

# 200 x 120 px of 20 um about (30, 10) mm, not turned: x from 28.01 to 31.99 mm, y from 8.81 to 11.19 mm.
VIEW = BoardView(scale=20e-6, shape=(120, 200), pose=(30e-3, 10e-3, 0.0))
IMAGING = Imaging(pixel=20e-6, shift=100e-6, angle=0.01, width_px=6)
PLACEMENT = np.array([30.2e-3, 10.1e-3])


def candidates(point: np.ndarray, length: np.ndarray) -> FeatureCandidates:
    count = len(point)
    zero = np.zeros(count)
    return FeatureCandidates(
        point=point,
        normal=np.tile([0.6, 0.8], (count, 1)),
        sigma=np.arange(1.0, count + 1.0),
        pair=np.zeros(count, np.bool_),
        length=length,
        ambiguity=zero,
        source=np.arange(count),
        spacing=zero,
        radius=zero,
        placement=PLACEMENT,
    )


def border_distance_px(point: np.ndarray) -> np.ndarray:
    """Return the distance of points on the board from the nearest border of the image [px]."""
    column = (point[:, 0] - 30e-3) / 20e-6 + 99.5
    row = 59.5 - (point[:, 1] - 10e-3) / 20e-6
    return np.asarray(np.minimum(np.minimum(column, 199.0 - column), np.minimum(row, 119.0 - row)))


def test_features_stay_in_the_image(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """Half a ruler, the shift of the board and the width fit; of a fiducial the radius and the search distance."""
    point = rng.uniform((27.5e-3, 8.5e-3), (32.5e-3, 11.5e-3), (400, 2))
    length = rng.uniform(0.2e-3, 1.6e-3, 400)
    marks = rng.uniform((27.5e-3, 8.5e-3), (32.5e-3, 11.5e-3), (300, 2))
    radius = rng.uniform(0.1e-3, 0.4e-3, 300)
    asked: list[Any] = []

    def find(_: Any, window: Any, placement: Any, imaging: Any) -> FeatureCandidates:
        asked.append((window, placement, imaging))
        half = slice(200 * (len(asked) - 1), 200 * len(asked))
        return candidates(point[half], length[half])

    def select(_: Any, bounds: Any, placement: Any, imaging: Any, count: int) -> Fiducials:
        np.testing.assert_array_equal(bounds, VIEW.bounds)
        assert placement is PLACEMENT
        assert (imaging, count) == (IMAGING, 40)
        return Fiducials(marks, radius, np.zeros(300), np.arange(300.0))

    monkeypatch.setattr(view_features, "find_ruler_candidates", find)
    monkeypatch.setattr(view_features, "select_fiducials", select)
    windows = [VIEW.bounds, VIEW.bounds + 1e-3]
    monkeypatch.setattr(view_features, "_windows", lambda *_: windows)
    artwork: Any = None
    rulers, fiducials = view_features.find_features_in_view(artwork, VIEW, IMAGING, PLACEMENT)
    for given, window in zip(asked, windows, strict=True):
        assert given[0] is window
        assert given[1] is PLACEMENT
        assert given[2] is IMAGING
    fits = border_distance_px(point) >= 0.5 * length / 20e-6 + 5.0 + 6.0
    assert 20 < fits.sum() < 200
    np.testing.assert_array_equal(rulers.point, point[fits])
    np.testing.assert_array_equal(rulers.length, length[fits])
    assert rulers.placement is PLACEMENT
    # The board shifts along both axes and turns about the placement point.
    away = np.sqrt(2.0) * 100e-6 + 0.01 * np.hypot(*(marks - PLACEMENT).T)
    fits = border_distance_px(marks) >= (radius + away) / 20e-6
    assert 20 < fits.sum() < 200
    np.testing.assert_array_equal(fiducials.point, marks[fits])
    np.testing.assert_array_equal(fiducials.sigma, np.flatnonzero(fits))


def test_a_ruler_has_fewer_samples_than_the_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    """512 samples: a length below 510 px, in a view with room for all."""
    view = BoardView(scale=20e-6, shape=(2000, 2000), pose=(30e-3, 10e-3, 0.0))
    length = np.array([400.0, 509.99, 510.01, 600.0]) * 20e-6
    found = candidates(np.tile([30e-3, 10e-3], (4, 1)), length)
    monkeypatch.setattr(view_features, "find_ruler_candidates", lambda *_: found)
    monkeypatch.setattr(view_features, "select_fiducials", lambda *_: Fiducials.empty())
    monkeypatch.setattr(view_features, "_windows", lambda *_: [view.bounds])
    artwork: Any = None
    rulers, fiducials = view_features.find_features_in_view(artwork, view, IMAGING, PLACEMENT)
    assert len(fiducials.radius) == 0
    np.testing.assert_array_equal(rulers.length, length[:2])


@pytest.mark.parametrize("turn", [0.0, np.pi / 2])
def test_features_in_view_have_all_their_samples_in_the_image(turn: float) -> None:
    """Rulers of 16 samples and 5 lines, and fiducials of 4 px with a search of 14.1 px, at the border of the image."""
    pixel = 20e-6
    imaging = Imaging(pixel=pixel, blur_px=0.5, smoothing_ratio=1.0, width_px=5, shift=10 * pixel, angle=0.0)
    # The image spans -49.5 to 49.5 px about its centre.
    along = [(41.99, 0.0), (42.01, 0.0), (0.0, 47.49), (0.0, 47.51), (-42.01, 0.0), (0.0, 0.0)]
    marks = [(31.35, 0.0), (31.37, 0.0)]
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, s], [-s, c]])
    here = np.array([1e-3, 2e-3])
    count = len(along)
    found = FeatureSet(
        side="top",
        placement=here,
        point=here + pixel * np.array(along) @ turned,
        normal=np.tile(turned[0], (count, 1)),
        spacing=np.zeros(count),
        length=pixel * np.array([9.0, 9.0, 9.0, 9.0, 9.0, 15.9]),
        sigma=np.arange(count) * 1e-6,
        imaging=imaging,
        covariance=np.eye(3),
        condition=2.0,
        region=np.zeros((2, 2)),
        fiducials=Fiducials(
            here + pixel * np.array(marks) @ turned, np.full(2, 4 * pixel), np.zeros(2), np.array([1e-6, 2e-6])
        ),
    )
    view = BoardView(scale=pixel, shape=(100, 100), pose=(*here.tolist(), 0.0))
    seen = features_in_view(found, view)
    np.testing.assert_array_equal(seen.sigma, np.array([0.0, 2.0, 5.0]) * 1e-6)
    np.testing.assert_array_equal(seen.point, found.point[[0, 2, 5]])
    np.testing.assert_array_equal(seen.fiducials.sigma, [1e-6])
    assert features_in_view(seen, view).point.shape == (3, 2)


def test_many_edges_are_looked_for_in_five_windows() -> None:
    """The five windows together have as many edges as a usual view: the corners of the view, and its middle."""
    low, high = VIEW.bounds
    usual = view_features._USUAL_CANDIDATES
    # A ruler takes a width of 6 px of an edge; about 1.5 rulers for each such length.
    length = usual * 6 * 20e-6 / 1.5
    start = np.array([[30e-3, 10e-3], [40e-3, 10e-3]])
    for share, count in ((0.999, 1), (8.0, 5)):
        edges = SimpleNamespace(start=start, end=start, length=np.array([share * length, 1e3]))
        artwork: Any = SimpleNamespace(edges=edges)
        windows = view_features._windows(artwork, VIEW, IMAGING)
        assert len(windows) == count
        if count == 1:
            np.testing.assert_array_equal(windows[0], [low, high])
            continue
        size = (high - low) / np.sqrt(5 * share)
        for window in windows:
            np.testing.assert_allclose(window[1] - window[0], size)
        first = [window[0] for window in windows]
        right = high - size
        expected = [low, [low[0], right[1]], [right[0], low[1]], right, (low + right) / 2]
        np.testing.assert_allclose(first, expected)


@pytest.mark.parametrize(
    ("counts", "ratio", "used"),
    [
        ([(2, 1)], 1.25, 1.25),  # three together suffice
        ([(1, 1), (3, 0)], 1.25, 1.0),
        ([(1, 1), (2, 0)], 1.001, None),
        ([(0, 2)], 1.0, None),  # no less smoothing is left
    ],
)
@pytest.mark.parametrize("with_hint", [True, False])
def test_rulers_smooth_less_where_few_features_have_room(
    monkeypatch: pytest.MonkeyPatch, counts: list[tuple[int, int]], ratio: float, used: float | None, with_hint: bool
) -> None:
    """Numbers of rulers and fiducials of each attempt; the error counts those of the last one."""
    tried: list[Imaging] = []
    artwork: Any = SimpleNamespace(side="bottom")
    found: Any = None

    def find(given: Any, view: Any, imaging: Imaging, placement: Any) -> Any:
        nonlocal found
        assert (given, view) == (artwork, VIEW)
        np.testing.assert_array_equal(placement, (30e-3, 10e-3))
        tried.append(imaging)
        rulers, marks = counts[len(tried) - 1]
        found = SimpleNamespace(sigma=np.ones(rulers)), SimpleNamespace(sigma=np.ones(marks))
        return found

    def hint(given: Any, bounds: Any, placement: Any, imaging: Imaging) -> str:
        assert given is artwork
        np.testing.assert_array_equal(bounds, VIEW.bounds)
        np.testing.assert_array_equal(placement, (30e-3, 10e-3))
        assert imaging is tried[-1]
        return "pixels of 7 um"

    monkeypatch.setattr(view_features, "find_features_in_view", find)
    monkeypatch.setattr(view_features, "pixel_hint", hint)
    monkeypatch.setattr(view_features, "select_feature_set", lambda *values, **more: (values, more))
    imaging = replace(IMAGING, smoothing_ratio=ratio)
    if used is None:
        rulers, marks = counts[-1]
        end = "pixels of 7 um" if with_hint else "see the pixel size"
        expected = (
            rf"^{rulers} edges of the bottom artwork .*, and {marks} round pads .*, expected 3 or more together; "
            rf"check the initial pose, the scale and the blur: {end}$"
        )
        with pytest.raises(ValueError, match=expected):
            view_features.select_features_in_view(artwork, VIEW, imaging, with_hint=with_hint)
    else:
        result: Any = view_features.select_features_in_view(artwork, VIEW, imaging, 35.0, with_hint=with_hint)
        used_imaging = replace(imaging, smoothing_ratio=used)
        assert result == (
            (found[0], used_imaging, "bottom"),
            {"fiducials": found[1], "are_free": True, "budget": 35.0},
        )
    assert [each.smoothing_ratio for each in tried] == [ratio, 1.0][: len(counts)]
    assert all(replace(each, smoothing_ratio=ratio) == imaging for each in tried)
