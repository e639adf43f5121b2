"""Feature sets: the operation that they bind, budgets of the selection, and the summary, against numbers by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.magnification import largest_magnification
from gpuvision.matching.features import feature_set
from gpuvision.matching.features.candidates import FeatureCandidates
from gpuvision.matching.features.feature_set import FeatureSet, choose_features, edge_clearance, select_feature_set
from gpuvision.matching.features.fiducials import Fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.selection import Selection
from gpuvision.matching.pose.feature_pose import EstimateFeaturePose
from gpuvision.matching.pose.pose import SolvePose

PLACEMENT = np.array([3e-3, -2e-3])
IMAGING = Imaging(
    pixel=20e-6, blur_px=1.5, width_px=7, etch_bias_sigma=12e-6, smoothing_ratio=1.25, shift=150e-6, angle=8e-3
)
FEATURES = FeatureSet(
    side="bottom",
    placement=PLACEMENT,
    point=PLACEMENT + np.array([[1e-3, 0.0], [0.0, 2e-3], [-1.5e-3, 5e-4], [2e-4, -1e-3]]),
    normal=np.array([[0.6, 0.8], [1.0, 0.0], [0.0, -1.0], [-0.8, 0.6]]),
    spacing=np.array([0.0, 4e-4, 0.0, 6e-5]),
    length=np.array([1.01e-3, 1.4e-3, 9e-4, 1.1e-3]),
    sigma=np.array([1e-6, 2e-6, 3e-6, 4e-6]),
    imaging=IMAGING,
    covariance=np.diag([1.5e-6, 2.5e-6, 0.3e-3]) ** 2,
    condition=7.0,
    region=np.array([[1e-3, -4e-3], [5.01e-3, -1e-3]]),
    fiducials=Fiducials(
        PLACEMENT + np.array([[3e-3, 4e-3], [-1e-3, 0.0], [0.0, -2e-3]]),
        np.array([3e-4, 1e-4, 2e-4]),
        np.array([0.0, 1e-4, 0.0]),
        np.array([1e-7, 2e-7, 3e-7]),
    ),
)


@pytest.fixture
def bind(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that gives the operation that features bind, and the other arguments of the binding."""
    monkeypatch.setattr(feature_set, "BoundFeatures", lambda operation, *rest: (operation, rest))

    def bound(features: FeatureSet = FEATURES, **more: Any) -> tuple[EstimateFeaturePose, Any]:
        device: Any = "device"
        given: dict[str, Any] = {"copper": "bright", "threshold": 12.0, "noise": 1.5, "queue": "queue"} | more
        found: Any = features.bind(device, (300, 400), np.uint8, **given)
        return found

    return bound


def test_features_are_placed_about_the_placement_point(bind: Any) -> None:
    """Rulers: place, normal, polarity, range of the spacing [px], etch factor; spacings of 20 px and 3 px."""
    operation, rest = bind()
    assert rest == ("device", (300, 400), np.uint8, "queue")
    rulers = np.array(operation.features.rulers)
    np.testing.assert_allclose(rulers[:, :2], FEATURES.point - PLACEMENT, atol=1e-15)
    np.testing.assert_array_equal(rulers[:, 2:4], FEATURES.normal)
    expected = [[-1.0, 0.0, 0.0, 1.0], [1.0, 10.0, 30.0, 0.0], [-1.0, 0.0, 0.0, 1.0], [1.0, 1.0, 6.2, 0.0]]
    np.testing.assert_allclose(rulers[:, 4:], expected, rtol=1e-12)
    np.testing.assert_allclose(operation.features.matched, [(3e-3, 4e-3, 3e-4), (0.0, -2e-3, 2e-4)], atol=1e-15)
    np.testing.assert_allclose(operation.features.drilled, [(-1e-3, 0.0, 1e-4)], atol=1e-15)
    camera = operation.features
    assert (camera.placement, camera.pixel_size, camera.frame_shape) == ((3e-3, -2e-3), 20e-6, (300, 400))
    assert (camera.mirrored, camera.model) == (True, None)
    dark = bind(copper="dark", pixel_size=40e-6, frame_shape=(900, 800))[0].features
    np.testing.assert_array_equal(np.array(dark.rulers)[:, 4], [1.0, -1.0, 1.0, -1.0])
    np.testing.assert_allclose(np.array(dark.rulers)[1, 5:7], [4.0, 16.0])
    assert (dark.pixel_size, dark.frame_shape) == (40e-6, (900, 800))
    assert not bind(replace(FEATURES, side="top"))[0].features.mirrored


def test_measurements_of_bound_features(bind: Any) -> None:
    """Rulers as long as the longest, 70 px, in multiples of 16; the smoothing is 1.25 blurs."""
    operation, _ = bind()
    ruler = operation.ruler
    assert (ruler.length, ruler.width, ruler.smoothing_px) == (80, 7, 1.875)
    assert (ruler.threshold, ruler.noise, ruler.per_ruler) == (12.0, 1.5, True)
    assert (operation.ruler_sigma_px, operation.matched_sigma_px, operation.drilled_sigma_px) == (0.02, 0.003, 0.02)
    # A pixel, and four sigmas of the etch bias.
    assert operation.size_tolerance == pytest.approx(20e-6 + 48e-6)
    # The farthest fiducial, 5 mm away, moves by the shift in both directions and the turn; three sigmas, and 1 px.
    reach = (math.sqrt(2.0) * 150e-6 + 8e-3 * 5e-3 + 3.0 * 12e-6) / 20e-6 + 1.0
    for blobs, smoothing in ((operation.matched, 2.25), (operation.drilled, 2.0)):
        assert blobs.search_px == pytest.approx(reach)
        assert blobs.smoothing_px == pytest.approx(smoothing)  # 1.5 blurs, or the smallest radius over 2.5
        assert (blobs.polarity, blobs.spokes, blobs.threshold, blobs.noise) == ("bright", 16, 12.0, 1.5)
    assert (operation.matched.match, operation.drilled.match) == (True, False)
    changed, _ = bind(blur_px=2.4, etch_bias_sigma=0.0, pixel_size=25e-6)
    assert changed.ruler.smoothing_px == pytest.approx(3.0)
    assert changed.ruler.length == 64  # 56 px
    assert changed.size_tolerance == pytest.approx(25e-6)
    assert changed.matched.search_px == pytest.approx((math.sqrt(2.0) * 150e-6 + 40e-6) / 25e-6 + 1.0)
    assert (changed.matched.smoothing_px, changed.drilled.smoothing_px) == pytest.approx((3.2, 1.6))
    wide = replace(FEATURES, imaging=replace(IMAGING, shift=4e-3))
    assert bind(wide)[0].matched.search_px == 190.0


def test_a_short_search_has_short_rulers(bind: Any) -> None:
    """Three smoothings beyond the search range on both sides, three samples, and the spacing of 20 px."""
    for search, length in ((5.0, 48), (6.0, 48), (7.0, 64)):
        operation, _ = bind(search_px=search)  # 2 (5 + 5.625) + 3 + 20 = 44.25
        assert operation.ruler.length == length
        assert operation.matched.search_px == operation.drilled.search_px == search
        assert operation.solver.search_range == pytest.approx((2.0 * search * 20e-6, 16e-3))
    single = replace(FEATURES, spacing=np.zeros(4), length=np.full(4, 1e-5))
    # A ruler is not shorter than its filter: 2 * ceil(3 * 5) + 3 = 33.
    assert bind(single, blur_px=4.0)[0].ruler.length == 48
    long = replace(FEATURES, length=np.full(4, 0.5))
    assert bind(long)[0].ruler.length == 512


def test_rulers_behind_a_lens_are_longer_by_its_magnification(bind: Any) -> None:
    lens = Lens(k1=-2e-6, centre=(210.0, 140.0))
    factor = largest_magnification(lens, (300, 400))
    assert factor > 1.05
    operation, _ = bind(model=lens)
    assert operation.features.model == lens
    assert operation.ruler.length == 16 * math.ceil(70.0 * factor / 16)
    reach = (math.sqrt(2.0) * 150e-6 + 8e-3 * 5e-3 + 3.0 * 12e-6) / 20e-6
    assert operation.matched.search_px == pytest.approx(reach * factor + 1.0)
    short, _ = bind(model=lens, search_px=40.0)
    assert short.ruler.length == 16 * math.ceil((2 * (40.0 + 5.625) + 3 + 20.0 * factor) / 16)
    full, _ = bind(model=lens, frame_shape=(900, 800))
    assert full.matched.search_px == pytest.approx(reach * largest_magnification(lens, (900, 800)) + 1.0)


def test_solver_of_bound_features(bind: Any) -> None:
    """The etch bias is an unknown only where there are single edges; the least limit of the turn is 10 mrad."""
    solver = bind()[0].solver
    assert (solver.scale, solver.min_scale, solver.etch_bias_sigma) == (None, 1.0, 12e-6)
    assert solver.search_range == pytest.approx((300e-6, 16e-3))
    small = replace(FEATURES, imaging=replace(IMAGING, angle=1e-3))
    assert bind(small)[0].solver.search_range == pytest.approx((300e-6, 10e-3))
    assert bind(etch_bias_sigma=3e-6)[0].solver.etch_bias_sigma == 3e-6
    assert bind(etch_bias_sigma=0.0)[0].solver.etch_bias_sigma is None
    assert bind(replace(FEATURES, spacing=np.full(4, 1e-4)))[0].solver.etch_bias_sigma is None
    given = SolvePose(scale=2.0, etch_bias_sigma=1e-6)
    assert bind(solver=given)[0].solver == given


def test_summary_and_region() -> None:
    """Lengths of 51, 70, 45 and 55 px, 7 px wide; a region of 200.5 x 150 px."""
    assert FEATURES.region_px == (201, 150)
    np.testing.assert_allclose(FEATURES.sigmas, [1.5e-6, 2.5e-6, 0.3e-3])
    assert FEATURES.summary().splitlines() == [
        "4 rulers (2 across traces) and 3 fiducials, 1547 px, in a region of 201 x 150 px",
        "predicted at (3.000, -2.000) mm: sigma x 1.50 µm, y 2.50 µm, theta 0.3000 mrad",
    ]
    assert "traces), 1547 px" in replace(FEATURES, fiducials=Fiducials.empty()).summary()
    # The offset of mask and silk, and two blurs.
    assert edge_clearance(IMAGING) == pytest.approx(50e-6 + 60e-6)


def rulers_of(sources: list[int], length: float = 1e-3) -> FeatureCandidates:
    count = len(sources)
    zero = np.zeros(count)
    return FeatureCandidates(
        point=np.random.default_rng(3).uniform(-5e-3, 5e-3, (count, 2)),
        normal=np.tile([[1.0, 0.0], [0.0, 1.0]], (count, 1))[:count],
        sigma=np.full(count, 1e-6),
        pair=np.ones(count, np.bool_),
        length=np.full(count, length),
        ambiguity=zero,
        source=np.array(sources),
        spacing=zero,
        radius=zero,
        placement=PLACEMENT,
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the arguments of all selections; they take every candidate."""
    found: list[Any] = []

    def select(both: FeatureCandidates, imaging: Imaging, budget: float, **how: Any) -> Selection:
        found.append((both, budget, how))
        which = np.arange(len(both.sigma))
        return Selection(which, np.eye(3), 0.0, 2.0, np.zeros((2, 2)))

    monkeypatch.setattr(feature_set, "select_rulers", select)
    return found


def test_a_fiducial_costs_as_many_rulers_as_it_has_spokes(asked: list[Any]) -> None:
    found = select_feature_set(
        rulers_of([4, 4, 5, 6]), IMAGING, "top", budget=30, fiducials=FEATURES.fiducials, missing=0.1
    )
    both, budget, how = asked[0]
    assert budget == 30
    assert how["costs"].tolist() == [1.0] * 4 + [16.0] * 3
    # 30 rulers on three sources: twice ten on each.
    assert (how["per_source"], how["missing"]) == (20, 0.1)
    np.testing.assert_array_equal(found.fiducials.point, FEATURES.fiducials.point)
    np.testing.assert_array_equal(found.fiducials.hole, FEATURES.fiducials.hole)
    np.testing.assert_array_equal(found.point, both.point[:4])
    assert (found.side, found.condition) == ("top", 2.0)
    select_feature_set(rulers_of([4, 4, 5, 6]), IMAGING, "top", budget=5)
    assert asked[1][2]["per_source"] == 4  # 3.3 at least 4
    select_feature_set(rulers_of([4, 4, 5, 6]), IMAGING, "top", budget=7)
    assert asked[2][2]["per_source"] == 5  # 14 / 3


def test_free_fiducials_cost_next_to_nothing(asked: list[Any]) -> None:
    select_feature_set(rulers_of([1, 2]), IMAGING, "top", budget=30, fiducials=FEATURES.fiducials, are_free=True)
    _, budget, how = asked[0]
    assert how["costs"][:2].tolist() == [1.0, 1.0]
    np.testing.assert_allclose(how["costs"][2:], 30e-9)
    # All fiducials and 30 rulers fit the budget, 31 rulers do not.
    assert 30 + 3 * 30e-9 <= budget < 31
    assert how["per_source"] == 30
    select_feature_set(rulers_of([1, 2]), IMAGING, "top", budget=5000, fiducials=FEATURES.fiducials, are_free=True)
    assert asked[1][1] == pytest.approx(994, rel=1e-6)  # 1000 rows, of which the fiducials have six
    select_feature_set(rulers_of([1, 2]), IMAGING, "top", budget=5000)
    assert asked[2][1] == 1000


def test_budget_in_pixels_and_in_time(asked: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """A ruler of 50 x 7 px; of a fiducial the square of its window."""
    monkeypatch.setattr(feature_set, "_microseconds", lambda *_: (20.0, 0.5))
    for unit, factor, budget in (("px", 1.0, 9000.0), ("us", 0.5, 8980.0)):
        asked.clear()
        unit_of: Any = unit
        select_feature_set(
            rulers_of([1, 2, 2]), IMAGING, "top", budget=9000, fiducials=FEATURES.fiducials, unit=unit_of
        )
        both, left, how = asked[0]
        assert left == budget
        assert how["costs"][:3].tolist() == [350.0 * factor] * 3
        np.testing.assert_allclose(how["costs"][3:], factor * np.ceil(both.length[3:] / 20e-6) ** 2)
        assert how["per_source"] == math.ceil(2 * budget / (350.0 * factor) / 2)
    with pytest.raises(ValueError, match="the budget is used up before the first ruler"):
        select_feature_set(rulers_of([1]), IMAGING, "top", budget=20, unit="us")
    select_feature_set(rulers_of([1]), IMAGING, "top", budget=20.1, unit="us")
    wrong: Any = "ms"
    with pytest.raises(ValueError, match="the budget's unit is 'ms', expected one of rulers, px, us"):
        select_feature_set(rulers_of([1]), IMAGING, "top", budget=20, unit=wrong)


def test_a_pose_takes_1000_rows(asked: list[Any]) -> None:
    for count, is_refused in ((994, False), (995, True)):
        rulers = rulers_of(list(range(count)))
        if is_refused:
            with pytest.raises(ValueError, match=r"1001 rows \(a fiducial has two\) fit the budget"):
                select_feature_set(rulers, IMAGING, "top", budget=1e6, unit="px", fiducials=FEATURES.fiducials)
        else:
            select_feature_set(rulers, IMAGING, "top", budget=1e6, unit="px", fiducials=FEATURES.fiducials)


def test_a_region_needs_three_coordinates(asked: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """A ruler measures one coordinate, a fiducial two; the placement point is the middle of the region."""
    artwork: Any = SimpleNamespace(side="top")
    places: list[Any] = []
    for rulers, fiducials, is_refused in ((2, 0, True), (0, 1, True), (3, 0, False), (1, 1, False), (0, 2, False)):
        monkeypatch.setattr(
            feature_set,
            "find_ruler_candidates",
            lambda a, box, place, imaging, rulers=rulers: (places.append((box, place)), rulers_of([1] * rulers))[1],
        )
        some = FEATURES.fiducials.subset(np.arange(fiducials))
        monkeypatch.setattr(feature_set, "select_fiducials", lambda *_, some=some: some)
        if is_refused:
            with pytest.raises(ValueError, match=f"^{rulers} edges of the region have room for a ruler, expected 3"):
                choose_features(artwork, ((0.0, 1.0), (4.0, 2.0)), IMAGING)
        else:
            choose_features(artwork, ((0.0, 1.0), (4.0, 2.0)), IMAGING)
    np.testing.assert_array_equal(places[0][1], [2.0, 1.5])
    choose_features(artwork, ((0.0, 1.0), (4.0, 2.0)), IMAGING, placement=(5.0, 6.0))
    np.testing.assert_array_equal(places[-1][1], [5.0, 6.0])
