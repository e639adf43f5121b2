"""Robots on fields: located with their twins, with clutter and occluding robots; images without a field are refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from conftest import Draws
from fakes import list_gpu
from floors import GREEN, WHITE, detected_fraction, floor_image
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.lens import Lens
from gpuvision.cli import main as cli
from gpuvision.formats.field_file import read_field
from gpuvision.host import Device, StepDevices, device_choice
from gpuvision.matching.field.distance_map import Arc, Field
from gpuvision.matching.field.evidence import (
    Evidence,
    distances_to_lines,
    expected_crossings,
    robot_to_field,
)
from gpuvision.matching.field.field_pose import PoseCandidate
from gpuvision.matching.field.line_detection import FloorScan
from gpuvision.status import Status
from gpuvision.workflows import locating_robot
from gpuvision.workflows.locating_robot import (
    RobotLimits,
    _doubt,
    _order,
    _usable,
    default_line_width,
    locate_robot,
    scan_floor,
)

SCALE, SHAPE, WIDE = 0.03, (400, 440), 0.125
Image = np.ndarray[Any, np.dtype[np.uint8]]


def seen_from(field: Field, pose: tuple[float, float, float], rng: np.random.Generator) -> Image:
    return floor_image(field, pose, scale=SCALE, shape=SHAPE, line_width=WIDE, noise=rng.uniform(2.0, 12.0), rng=rng)


def anywhere(rng: np.random.Generator) -> tuple[float, float, float]:
    x, y, heading = rng.uniform([-9.0, -6.0, -math.pi], [9.0, 6.0, math.pi])
    return float(x), float(y), float(heading)


def carpet(rng: np.random.Generator) -> Image:
    return np.clip(rng.normal(GREEN, 5.0, (*SHAPE, 3)), 0, 255).astype(np.uint8)


def spotted(image: Image, count: int, rng: np.random.Generator) -> Image:
    """Return an image with white objects of 5 to 30 cm on the floor."""
    image = image.copy()
    for _ in range(count):
        (x, y), size = rng.uniform(0, SHAPE[::-1]), rng.uniform(1.5, 3.5)
        axes = (int(size * rng.uniform(1.0, 3.0)), int(size))
        cv2.ellipse(image, (int(x), int(y)), axes, rng.uniform(0, 180), 0, 360, WHITE, -1, cv2.LINE_AA)
    return image


def hidden(image: Image, share: float, rng: np.random.Generator) -> Image:
    """Return an image in which five robots occlude a share of all directions."""
    image, middle = image.copy(), np.array(SHAPE[::-1]) / 2
    for first in rng.uniform(0.0, 2.0 * math.pi, 5):
        turn = first + np.linspace(0.0, 2.0 * math.pi * share / 5.0, 6)
        far = np.array([rng.uniform(20.0, 60.0), *[400.0] * 6])
        turn = np.append(turn.mean(), turn)
        corners = middle + far[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], (15, 15, 15))
    return image


def tiles(spacing: float) -> Field:
    at = np.arange(-12.0, 12.0, spacing)
    lines = [(-12.0, y, 12.0, y) for y in at] + [(x, -12.0, x, 12.0) for x in at]
    return Field(length=24.0, width=24.0, lines=tuple(lines))


def grown(field: Field, by: float) -> Field:
    lines = tuple((by * a, by * b, by * c, by * d) for a, b, c, d in field.lines)
    arcs = tuple(Arc(by * each.x, by * each.y, by * each.radius, each.start, each.end) for each in field.arcs)
    return Field(length=by * field.length, width=by * field.width, lines=lines, arcs=arcs)


def mottled(rng: np.random.Generator) -> Image:
    rough = cv2.GaussianBlur(rng.normal(size=SHAPE).astype(np.float32), (0, 0), rng.uniform(1.0, 4.0))
    return cv2.normalize(rough, np.empty_like(rough), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def random_lines(rng: np.random.Generator) -> Field:
    start, turn, size = rng.uniform(-12, 12, (30, 2)), rng.uniform(0, 2 * np.pi, 30), rng.uniform(1, 8, 30)
    ends = start + size[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return Field(length=24.0, width=24.0, lines=tuple(map(tuple, np.hstack([start, ends]).tolist())))


NO_FIELDS: dict[str, Callable[[np.random.Generator], Image]] = {
    "noise": lambda rng: rng.integers(0, 256, (*SHAPE, 3)).astype(np.uint8),
    "carpet": carpet,
    "spots": lambda rng: spotted(carpet(rng), int(rng.integers(5, 300)), rng),
    "mottled": mottled,
    "tiles": lambda rng: seen_from(tiles(rng.uniform(0.8, 3.0)), anywhere(rng), rng),
    "lines": lambda rng: seen_from(random_lines(rng), anywhere(rng), rng),
}


def is_correct(found: np.ndarray, pose: tuple[float, float, float]) -> bool:
    """Return whether a pose or its twin is within 10 cm of the true pose."""
    return bool(min(np.hypot(found[0] - s * pose[0], found[1] - s * pose[1]) for s in (1, -1)) < 0.1)


@pytest.mark.parametrize(
    ("evidence", "doubt"),
    [
        (Evidence(-7.0, 0.9, 20, 0.9, 0.9), ""),
        (Evidence(math.log(1e-3) + 1e-9, 0.9, 20, 0.9, 0.9), "31 points fit the field no better than random points"),
        (Evidence(math.log(1e-3), 0.75, 20, 0.75, 0.0), ""),  # a third is missing
        (Evidence(-7.0, 0.75, 20, 0.74, 0.24), "74% of the expected lines are seen, and 75% of the points are on"),
        (Evidence(-7.0, 0.75, 20, 0.74, 0.25), ""),  # thinned out
        (Evidence(-7.0, 0.9, 20, 0.55, 0.25), ""),
        (Evidence(-7.0, 0.9, 20, 0.54, 0.25), "54% of the expected lines are seen, and 90% of"),
        (Evidence(-7.0, 0.54, 20, 0.8, 0.9), "80% of the expected lines are seen, and 54% of"),
        (Evidence(-7.0, 0.55, 20, 0.62, 0.9), ""),
        (Evidence(-7.0, 0.56, 20, 0.6, 0.9), "60% of the expected lines are seen, and 56% of"),  # 0.4 / 0.56 > 0.7
        (Evidence(-7.0, 0.6, 20, -0.1, -0.2), "at the best pose 0% of the expected lines are seen, and 60% of"),
        (Evidence(-7.0, 0.1, 0, math.nan, math.nan), ""),  # scan lines are not known
        (None, "no pose on the field fits the points"),
    ],
)
def test_doubts_about_the_best_pose(evidence: Evidence | None, doubt: str) -> None:
    found = _doubt(evidence, 31, RobotLimits())
    assert doubt in found
    assert bool(doubt) == bool(found)


def test_candidates_are_ordered_by_what_is_missing() -> None:
    """In steps of a tenth, then as they were; twins that are left out are no longer named."""

    class Candidate(NamedTuple):
        name: str
        symmetric_twin: int | None

    names: Any = tuple(Candidate(*each) for each in (("a", 3), ("b", None), ("c", 0), ("d", 1), ("e", 2)))
    seen = (0.7, 0.98, 0.72, 1.3, 0.4)
    weights = [Evidence(-9.0, 1.0, 10, each, each) for each in seen]
    found, kept = _order(names, weights, 4)
    # Missing are 0.3, 0.02, 0.28, -0.3 and 0.6: the steps 0.3, 0, 0.3, 0 and 0.6.
    assert [(each[0], each.symmetric_twin) for each in found] == [("b", None), ("d", 0), ("a", 1), ("c", 2)]
    assert [each.seen for each in kept] == [0.98, 1.3, 0.7, 0.72]
    few, _ = _order(names, weights, 2)
    assert [(each[0], each.symmetric_twin) for each in few] == [("b", None), ("d", 0)]
    assert _order(names[2:3], weights[:1], 3)[0][0].symmetric_twin == 0


def test_points_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locating_robot, "_MAX_POINTS", 10)
    for count, step in ((1, 1), (10, 1), (11, 2), (20, 2), (21, 3)):
        points = np.arange(2.0 * count).reshape(count, 2).astype(np.float32)
        both = np.concatenate([np.full((2, 2), np.nan, np.float32), points, [[np.inf, 0.0]]]).astype(np.float32)
        found = _usable(both)
        np.testing.assert_array_equal(found, points[::step])
        assert found.flags.c_contiguous
    assert _usable(np.full((3, 2), np.nan, np.float32)).shape == (0, 2)


@pytest.mark.parametrize(
    "kind",
    [pytest.param(each, marks=[] if each in ("lines", "mottled") else pytest.mark.slow) for each in sorted(NO_FIELDS)],
)
def test_what_is_no_field_is_refused(kind: str, rng: np.random.Generator, draws: Draws) -> None:
    field = read_field("robocup_msl")
    for _ in range(draws(2, 6)):
        found = locate_robot(scan_floor(NO_FIELDS[kind](rng), scale=SCALE, line_width=WIDE), field)
        assert found.reason
        assert found.candidates == ()
        assert found.report()["status"] == "refused"


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(NO_FIELDS))
def test_of_many_that_are_no_field_all_are_refused(kind: str, rng: np.random.Generator, draws: Draws) -> None:
    """All images without lines are refused; views of few tiles or random lines may fit the field."""
    count = draws(10, 10, 35)
    field = read_field("robocup_msl")
    scans = (scan_floor(NO_FIELDS[kind](rng), scale=SCALE, line_width=WIDE) for _ in range(count))
    refused = sum(bool(locate_robot(scan, field).reason) for scan in scans)
    assert refused >= (0.9 if kind in ("lines", "tiles") else 1.0) * count


@pytest.mark.slow
def test_of_many_fields_nearly_all_are_found(rng: np.random.Generator, draws: Draws) -> None:
    """With up to 80 objects on the floor; if the image shows few lines, another place may match."""
    field = read_field("robocup_msl")
    found = []
    for number in range(draws(50, 50, 150)):
        pose = anywhere(rng)
        image = spotted(seen_from(field, pose, rng), number % 3 * 40, rng)
        located = locate_robot(scan_floor(image, scale=SCALE, line_width=WIDE), field)
        found.append(not located.reason and is_correct(located.candidates[0].pose, pose))
    assert np.mean(found) > 0.9


@pytest.mark.parametrize(
    ("spots", "share"),
    [(0, 0.0), (20, 0.1), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((60, 0.0), (0, 0.2)))],
)
def test_fields_are_found(spots: int, share: float, device: Device, rng: np.random.Generator) -> None:
    """With objects on the floor, and occluding robots."""
    field = read_field("robocup_msl")
    for pose in ((-6.0, 2.0, 0.7), (3.0, -1.5, -2.0), (0.5, 4.0, 1.2)):
        image = hidden(spotted(seen_from(field, pose, rng), spots, rng), share, rng)
        located = locate_robot(scan_floor(image, scale=SCALE, line_width=WIDE, device=device), field, device=device)
        assert located.reason == ""
        assert is_correct(located.candidates[0].pose, pose)
        assert located.evidence is not None
        assert located.evidence.seen > 0.55
        evidence = located.report()["evidence"]
        assert evidence["log10_nfa"] < -3.0
        assert evidence["expected"] > 20


def test_the_search_runs_on_its_fastest_device(
    device: Device, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    field = read_field("robocup_msl")
    scan = scan_floor(seen_from(field, (-6.0, 2.0, 0.7), rng), scale=SCALE, line_width=WIDE, device=device)
    gpu = list_gpu(device, {("search", "gpu"): 1e-3, ("search", device.label): 2e-3}, monkeypatch)
    located = locate_robot(scan, field)
    assert located.device is gpu
    seconds = {"gpu": 1e-3, device.label: 2e-3}
    assert located.report()["steps"] == {"search": {"device": "gpu", "seconds": seconds, "unusable": {}}}
    assert set(located.seconds) == {"map", "choose device", "search"}


@pytest.mark.parametrize("mounted", [False, True])
def test_the_floor_scan_runs_on_its_fastest_device(
    mounted: bool, device: Device, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The choices of the scan and of the search are in one report."""
    field = read_field("robocup_msl")
    image = seen_from(field, (-6.0, 2.0, 0.7), rng)
    seconds = {"gpu": 3e-3, device.label: 2e-3}
    times = {("scan", "gpu"): 3e-3, ("scan", device.label): 2e-3}
    gpu = list_gpu(device, times | {("search", "gpu"): 1e-3, ("search", device.label): 2e-3}, monkeypatch)
    ran: list[Device | None] = []
    name = "scan_tilted_view" if mounted else "scan_top_view"
    found = scan_floor(image, scale=SCALE, line_width=WIDE, device=device)
    monkeypatch.setattr(locating_robot, name, lambda *_, device, **__: ran.append(device) or found)
    how: dict[str, Any] = (
        {"model": MountedCamera(height=0.8, tilt=0.4, focal_px=500.0, centre_px=(319.5, 239.5))}
        if mounted
        else {"scale": SCALE}
    )
    devices = StepDevices(None)
    scan = scan_floor(image, line_width=WIDE, device=devices, **how)
    assert ran[-1] is device
    assert devices.first is gpu
    steps = locate_robot(scan, field, device=devices).report()["steps"]
    assert steps["scan"] == {"device": device.label, "seconds": seconds, "unusable": {}}
    assert steps["search"]["device"] == "gpu"
    scan_floor(image, line_width=WIDE, **how)
    assert ran[-1] is device
    scan_floor(image, line_width=WIDE, device=gpu, **how)
    assert ran[-1] is gpu


def key_of_scan(device: Device, monkeypatch: pytest.MonkeyPatch, **how: Any) -> str:
    """Return the key under which the time of a scan on a device is kept."""
    keys: list[str] = []

    def choose(self: StepDevices, step: str, run: Any, *size: object) -> Device:
        keys.append(repr(device_choice._key_of(step, size, device)))
        return device

    empty = FloorScan(np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 4), np.float32), WIDE)
    monkeypatch.setattr(StepDevices, "choose", choose)
    for name in ("scan_tilted_view", "scan_top_view"):
        monkeypatch.setattr(locating_robot, name, lambda *_, **__: empty)
    scan_floor(np.zeros((96, 128), np.uint8), **{"line_width": WIDE, "device": device, **how})
    return keys[0]


def mounted_camera(**changes: Any) -> MountedCamera:
    """Return a camera on a robot, with changes."""
    usual = {"height": 0.8, "tilt": 0.4, "focal_px": 500.0, "centre_px": (63.5, 47.5)}
    return MountedCamera(**{**usual, **changes})


def test_scans_of_other_geometry_do_not_share_their_times(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """What changes count or length of the rulers is in the key: a scan of 3 m says nothing about a scan of 12 m."""
    lens = Lens(centre=(63.5, 47.5), k1=1e-7)
    scans: list[dict[str, Any]] = [
        {"scale": SCALE},
        {"scale": 4 * SCALE},
        {"scale": SCALE, "line_width": 4 * WIDE},
        {"scale": SCALE, "blind": 1.0},
        {"scale": SCALE, "rays": 30},
        {"scale": SCALE, "model": lens},
        {"model": mounted_camera()},
        {"model": mounted_camera(), "line_width": 4 * WIDE},
        {"model": mounted_camera(), "max_range": 3.0},
        {"model": mounted_camera(), "rays": 30},
        *(
            {"model": mounted_camera(**each)}
            for each in ({"height": 3.2}, {"tilt": 0.8}, {"tilt": -0.4}, {"roll": 0.7}, {"focal_px": 2e3})
        ),
        {"model": mounted_camera(model=lens)},
    ]
    keys = [key_of_scan(device, monkeypatch, **each) for each in scans]
    assert len(set(keys)) == len(keys)
    # What does not, is not: the next image of a robot whose camera is calibrated a little differently.
    assert key_of_scan(device, monkeypatch, model=mounted_camera(tilt=0.401, focal_px=503.0)) == keys[6]
    assert key_of_scan(device, monkeypatch, scale=1.01 * SCALE) == keys[0]


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"line_width": 0.0}, "line_width is 0.0, expected a number > 0"),
        ({"scale": -1.0}, "scale is -1.0, expected a number > 0"),
        ({"rays": 0}, "rays is 0, expected .*1"),
        ({"blind": math.nan}, "blind must be finite, got nan"),
        ({"max_range": 0.0}, "max_range is 0.0, expected a number > 0"),
    ],
)
def test_numbers_of_a_scan_out_of_range_are_refused(how: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        scan_floor(np.zeros((96, 128), np.uint8), **{"scale": SCALE, "line_width": WIDE, **how})


@pytest.mark.parametrize(
    ("length", "width", "far", "margin", "scale", "most"),
    [
        (20.0, 12.0, 6.0, None, 0.25, 6.006 + 0.25),
        (20.0, 12.0, 40.0, None, 0.25, 30.0),  # at most 1.5 lengths
        (3.0, 5.0, 2.0, None, 0.1, 2.002 + 0.1),  # a fiftieth of the longer side
        (12.5, 5.0, 2.0, None, 0.25, 2.002 + 0.25),
        (20.0, 12.0, 6.0, 0.0, 0.25, 6.006 + 0.25),
    ],
)
def test_map_of_a_search(
    length: float,
    width: float,
    far: float,
    margin: float | None,
    scale: float,
    most: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Cells of 0.4 scales, a border of a twentieth of the field, a range that holds the farthest point."""
    monkeypatch.setattr(locating_robot, "DistanceMap", lambda **how: how)
    field: Any = SimpleNamespace(length=length, width=width)
    device: Any = "a device"
    points = np.array([[0.1, 0.2], [-0.6 * far, 0.8 * far]], np.float32)
    found: Any = locating_robot._search_map(field, points, margin, device)
    assert found == {
        "field": field,
        "cell": pytest.approx(0.4 * scale),
        "scale": pytest.approx(scale),
        "max_range": pytest.approx(most, rel=1e-6),
        "margin": pytest.approx(0.05 * max(length, width) if margin is None else margin),
        "device": device,
    }


@pytest.mark.parametrize(
    ("length", "width", "expected"), [(4.99, 3.0, 0.02), (5.0, 3.0, 0.125), (3.0, 5.0, 0.125), (18.0, 12.0, 0.125)]
)
def test_small_fields_have_thin_lines(length: float, width: float, expected: float) -> None:
    field: Any = SimpleNamespace(length=length, width=width)
    assert locating_robot.default_line_width(field) == expected


@pytest.mark.parametrize("is_scan", [False, True])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("refused", [False, True])
def test_a_search_and_its_evidence(is_scan: bool, known: bool, refused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At least 24 poses are refined; the evidence is that of the lines' width; a doubtful pose is no candidate."""
    points = np.arange(8, dtype=np.float32).reshape(4, 2)
    given: Any = FloorScan(points, np.zeros(4, np.float32), np.ones((2, 4), np.float32), 0.05) if is_scan else points
    field: Any = SimpleNamespace(length=3.0, width=2.0)
    level = SimpleNamespace(shape=(7, 9))
    field_map = SimpleNamespace(cells=SimpleNamespace(level=level), field=field, scale=0.06, max_range=4.0, margin=0.15)
    pose = (0.1, 0.2, 0.3) if known else None
    asked: list[Any] = []

    def search(searched: Any, used: Any, **how: Any) -> Any:
        assert searched is field_map
        np.testing.assert_array_equal(used, points)
        asked.append(how)
        one = np.eye(3)
        return tuple(PoseCandidate(np.full(3, float(k)), one, one, 0.1, 0.2, 0.9, None, Status.OK) for k in range(3))

    def weigh(used: Any, paths: Any, on: Any, pose: Any, **how: Any) -> Evidence:
        asked.append((None if paths is None else paths.shape, on is field, float(pose[0]), how))
        return Evidence(-20.0 if not refused else 0.0, 0.9, 20, 0.9, 0.8)

    monkeypatch.setattr(locating_robot, "_search_map", lambda *_: field_map)
    monkeypatch.setattr(locating_robot, "find_pose_candidates", search)
    monkeypatch.setattr(locating_robot, "evidence", weigh)
    monkeypatch.setattr(locating_robot, "point_scale", lambda *_, **__: None)
    sizes: list[Any] = []

    class Devices(StepDevices):
        def __init__(self) -> None:
            self.choices = {}

        first: Any = "first"

        def choose(self, step: str, run: Any, *size: object) -> Any:
            sizes.append((step, size))
            return "chosen"

    found = locate_robot(given, field, initial_pose=pose, scale=0.04, max_candidates=2, device=Devices())
    assert sizes == [("search", ((7, 9), 4.0, not known, 24))]
    searched, *weighed = asked
    assert searched == {"initial_pose": pose, "max_candidates": 24, "device": "chosen"}
    half = 0.025 if is_scan else 0.01
    margin = None if known else 0.15
    how = {"half_line_width": pytest.approx(half), "scale": 0.06, "max_range": 4.0, "margin": margin}
    assert weighed == [((2, 4) if is_scan else None, True, float(k), how) for k in range(3)]
    assert [float(each.pose[0]) for each in found.candidates] == ([] if refused else [0.0, 1.0])
    assert [float(each.pose[0]) for each in found.doubtful] == ([0.0] if refused else [])
    assert (found.device, found.scale, bool(found.reason)) == ("chosen", 0.04, refused)
    assert set(found.seconds) == {"map", "choose device", "search"}
    # One point less than unknowns and one.
    few = locate_robot(points[:3], field, device=Devices())
    assert few.reason == "3 points on lines, expected 4 or more"
    assert (few.candidates, few.doubtful, few.evidence, few.seconds) == ((), (), None, {})
    assert few.device == "first"


def replaced(scan: FloorScan, share: float, rng: np.random.Generator) -> FloorScan:
    """Return a scan with a share of its points moved to random places on the scan lines."""
    hit = np.flatnonzero(rng.uniform(size=len(scan.points)) < share)
    start, end = np.split(scan.paths[rng.integers(0, len(scan.paths), len(hit))], 2, axis=1)
    points = scan.points.copy()
    points[hit] = start + rng.uniform(size=(len(hit), 1)) * (end - start)
    return scan._replace(points=points)


def test_clutter_instead_of_lines_is_no_other_field(rng: np.random.Generator, draws: Draws) -> None:
    """Of fields with 30 % of the points replaced by clutter more than half were refused, with the right pose."""
    field = read_field("robocup_msl")
    for pose in ((-6.0, 2.0, 0.7), (3.0, -1.5, -2.0), (0.5, 4.0, 1.2))[: draws(2, 3)]:
        scan = scan_floor(seen_from(field, pose, rng), scale=SCALE, line_width=WIDE)
        for _ in range(3):
            located = locate_robot(replaced(scan, 0.3, rng), field)
            assert located.reason == ""
            assert is_correct(located.candidates[0].pose, pose)
        # Of another field whole lines are missing.
        larger = scan_floor(seen_from(grown(field, 1.33), pose, rng), scale=SCALE, line_width=WIDE)
        assert locate_robot(larger, field).reason


def test_another_field_is_refused(device: Device, rng: np.random.Generator) -> None:
    """Another field is refused, because lines do not fit or are missing; also the same field, a third larger."""
    field, pose = read_field("robocup_msl"), (-6.0, 2.0, 0.7)
    image = seen_from(grown(field, 1.33), pose, rng)
    located = locate_robot(scan_floor(image, scale=SCALE, line_width=WIDE, device=device), field, device=device)
    assert "the image does not match this field" in located.reason
    assert len(located.doubtful) == 1
    # At a scale that compensates the size it is the same field.
    scan = scan_floor(image, scale=SCALE / 1.33, line_width=WIDE / 1.33, device=device)
    assert is_correct(locate_robot(scan, field, device=device).candidates[0].pose, (-6.0 / 1.33, 2.0 / 1.33, 0.7))


def test_every_stripe_along_a_ray_is_found(rng: np.random.Generator) -> None:
    """From the position of the robot to the image border, no line is lost."""
    field = read_field("robocup_msl")
    for pose in ((2.08, -0.31, -0.83), (-8.95, -2.24, 1.98), (-4.59, -0.4, -1.32)):
        scan = scan_floor(seen_from(field, pose, rng), scale=SCALE, line_width=WIDE)
        crossings = expected_crossings(field, pose, scan.paths, line_width=WIDE)
        assert len(crossings.places) > 60
        assert detected_fraction(crossings, scan.points, 0.02) > 0.97
        assert np.abs(distances_to_lines(field, robot_to_field(scan.points, pose))).max() < 0.05
        assert np.median(scan.sigmas) < 0.2 * SCALE


def test_one_line_tells_a_part(device: Device, rng: np.random.Generator) -> None:
    """With a single line in view, the result is flagged candidates along the line, not a refusal."""
    field = Field(length=22.0, width=14.0, lines=((-11.0, 0.0, 11.0, 0.0),))
    image = seen_from(field, (1.0, 2.0, 0.4), rng)
    located = locate_robot(scan_floor(image, scale=SCALE, line_width=WIDE, device=device), field, device=device)
    assert located.reason == ""
    assert Status.AMBIGUOUS in located.candidates[0].status
    assert np.isnan(located.candidates[0].covariance).all()
    assert "fix a part of it only" in located.summary()


def seen_points(field: Field, pose: tuple[float, float, float], rng: np.random.Generator) -> np.ndarray:
    """Return 128 points (128, 2) within 6 m, evenly along the straight lines, with 1 cm of noise."""
    ends = np.array(field.lines).reshape(-1, 2, 2)
    size = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    line = rng.choice(len(ends), 4000, p=size / size.sum())
    away = ends[line, 0] + rng.uniform(size=(4000, 1)) * (ends[line, 1] - ends[line, 0]) - pose[:2]
    near = away[np.hypot(*away.T) < 6.0][:128]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return (near @ np.array([[c, -s], [s, c]]) + rng.normal(0.0, 0.01, near.shape)).astype(np.float32)


@pytest.mark.parametrize("error", [0.0, 0.01, -0.04])
def test_a_wrong_scale_of_points_is_named(error: float, device: Device, rng: np.random.Generator) -> None:
    """An error of 1 % is a warning, one of 4 % refuses the pose; both are measured right."""
    field = read_field("robocup_msl")
    for pose in ((-6.0, 2.0, 0.7), (3.0, -1.5, -2.0)):
        points = ((1.0 + error) * seen_points(field, pose, rng)).astype(np.float32)
        located = locate_robot(points, field, scale=SCALE, device=device)
        assert located.point_scale is not None
        assert located.point_scale.error == pytest.approx(error, abs=5.0 * located.point_scale.sigma)
        assert located.point_scale.sigma < 2e-3
        messages = (*located.warnings, *filter(None, [located.reason]))
        assert len(messages) == (error != 0.0)
        assert bool(located.reason) == (abs(error) > 0.02)
        assert bool(located.candidates) != bool(located.doubtful)
        for message in messages:
            assert f"{'farther from' if error > 0 else 'nearer to'} the robot than the lines of the field" in message
            assert f", not {1e3 * SCALE:.4g} mm?" in message


def poses_on(field: Field, count: int, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    half = 0.4 * np.array([field.length, field.width])
    return [(*rng.uniform(-half, half).tolist(), float(rng.uniform(-3.0, 3.0))) for _ in range(count)]


def test_clutter_feigns_no_error_of_the_scale(device: Device) -> None:
    """A third of the points anywhere within 6 m: without a limit of the gain, views at the right scale are refused."""
    field, rng, refused = read_field("robocup_msl"), np.random.default_rng(7), {0.5: 0, -1e3: 0}
    for pose in poses_on(field, 30, rng):
        points = seen_points(field, pose, rng)
        hit = rng.uniform(size=len(points)) < 0.3
        far, turn = 6.0 * np.sqrt(rng.uniform(size=hit.sum())), rng.uniform(0.0, 2.0 * math.pi, hit.sum())
        points[hit] = np.stack([far * np.cos(turn), far * np.sin(turn)], axis=-1)
        for gain in refused:
            located = locate_robot(points, field, device=device, limits=RobotLimits(min_scale_gain=gain))
            refused[gain] += "than the lines of the field" in located.reason
    assert refused[-1e3] >= 2
    assert refused[0.5] == 0


def test_the_covariance_contains_a_significant_error_of_the_scale(device: Device) -> None:
    """At points 1 % too far; without the error, the poses are 20 standard deviations off."""
    field, rng, warned = read_field("robocup_msl"), np.random.default_rng(7), 0
    for pose in poses_on(field, 12, rng):
        points = (1.01 * seen_points(field, pose, rng)).astype(np.float32)
        located = locate_robot(points, field, device=device)
        ignored = locate_robot(points, field, device=device, limits=RobotLimits(scale_significance=1e6))
        assert (located.reason, ignored.reason, ignored.warnings) == ("", "", ())
        if not located.warnings:
            continue
        warned += 1
        off = [_squared_error(each.candidates, pose) for each in (located, ignored)]
        assert off[0] < 16.27  # exceeded with a probability of 0.001
        assert off[1] > 10.0 * off[0]
    assert warned >= 6


def _squared_error(candidates: Any, pose: tuple[float, float, float]) -> float:
    """Return the squared Mahalanobis distance of the candidate that is nearest to the pose."""
    best = min(candidates, key=lambda each: float(np.hypot(*(each.pose - pose)[:2])))
    error = best.pose - pose
    error[2] = math.remainder(error[2], 2.0 * math.pi)
    return float(error @ np.linalg.solve(best.covariance, error))


def test_the_limit_of_the_scale_is_larger_for_scans(device: Device, rng: np.random.Generator) -> None:
    field = read_field("robocup_msl")
    points = (1.03 * seen_points(field, (-6.0, 2.0, 0.7), rng)).astype(np.float32)
    scan = FloorScan(points, np.full(len(points), 0.01, np.float32), np.empty((0, 4), np.float32), WIDE)
    found = locate_robot(scan, field, device=device)
    assert (found.reason, len(found.warnings)) == ("", 1)
    assert "height and tilt of the camera" in found.warnings[0]
    assert found.warnings[0] == locate_robot(points, field, device=device).reason
    # The significance is a limit, too.
    limits = RobotLimits(scale_significance=1e6)
    kept = locate_robot(points, field, device=device, limits=limits)
    assert (kept.reason, kept.warnings) == ("", ())


@pytest.mark.slow
def test_random_points_are_refused(rng: np.random.Generator) -> None:
    """Points from another camera have no scan lines: only the test against chance applies."""
    field = read_field("robocup_msl")
    for count in (4, 8, 30, 200, 1000):
        for _ in range(6):
            turn, far = rng.uniform(0, 2 * np.pi, count), 6.0 * np.sqrt(rng.uniform(0, 1, count))
            points = (far * np.stack([np.cos(turn), np.sin(turn)])).T.astype(np.float32)
            located = locate_robot(points, field)
            assert located.candidates == ()
            if located.evidence is None:  # four points may fit no pose at all
                assert "no pose on the field fits" in located.reason
            else:
                assert "no better than random points" in located.reason
                assert located.report()["evidence"]["seen"] is None


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_point_whose_distance_overflows_changes_nothing(rng: np.random.Generator) -> None:
    """There is no warning, and the range of the map is 1.5 lengths of the field in both searches."""
    field = read_field("robocup_msl")
    near = rng.uniform(-3.0, 3.0, (40, 2))
    found, other = (locate_robot(np.vstack([near, [[far, -far]]]).astype(np.float32), field) for far in (3e38, 100.0))
    assert found.reason == other.reason
    assert found.evidence == other.evidence


Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["gpuvision", "locate-robot", *map(str, arguments)])
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
        output = capfd.readouterr()
        return code, output.out, output.err

    return call


def test_the_command_refuses_in_a_line(tmp_path: Path, run: Command, rng: np.random.Generator) -> None:
    cv2.imwrite(str(tmp_path / "tiles.png"), seen_from(tiles(1.4), (0.3, 0.2, 0.4), rng))
    arguments = ("--field", "robocup_msl", "--scale", "3cm", "--out", tmp_path / "out")
    code, out, err = run(tmp_path / "tiles.png", *arguments)
    assert (code, out) == (1, "")
    assert err.startswith("gpuvision: no pose: ")
    assert err.count("\n") == 1
    report = json.loads((tmp_path / "out" / "pose.json").read_text())
    assert (report["status"], report["candidates"]) == ("refused", [])
    assert report["evidence"]["on_lines"] < 0.6
    assert (tmp_path / "out" / "located.png").exists()


@pytest.mark.parametrize(
    ("name", "pose", "scale"),
    [("robocup_msl", (-6.0, 2.0, 0.7), 0.03), ("robocup_junior", (0.4, -0.3, -2.0), 4e-3)],
)
def test_a_robot_is_located_with_its_twin(
    name: str, pose: tuple[float, float, float], scale: float, device: Device, rng: np.random.Generator
) -> None:
    field = read_field(name)
    wide = default_line_width(field)
    image = floor_image(field, pose, scale=scale, shape=(400, 440), line_width=wide, rng=rng)
    points = scan_floor(image, scale=scale, line_width=wide, device=device).points
    assert len(points) > 30
    found = locate_robot(points, field, device=device)
    assert found.reason == ""
    first, second = found.candidates[:2]
    assert (first.symmetric_twin, second.symmetric_twin) == (1, 0)
    twins = [each.pose for each in (first, second)]
    true = min(twins, key=lambda each: abs(math.remainder(each[2] - pose[2], 2 * math.pi)))
    # 0.1 px, and its effect at a distance of 200 px: 80 points, each accurate to a few tenths of a pixel.
    np.testing.assert_allclose(true[:2], pose[:2], atol=0.2 * scale)
    assert math.remainder(true[2] - pose[2], 2 * math.pi) == pytest.approx(0.0, abs=2e-3)
    # With an initial pose the twin is not examined.
    tracked = locate_robot(points, field, initial_pose=(pose[0] + 0.02, pose[1], pose[2] + 0.05), device=device)
    assert len(tracked.candidates) == 1
    np.testing.assert_allclose(tracked.candidates[0].pose[:2], pose[:2], atol=0.2 * scale)


def test_floor_points_lie_on_the_lines(rng: np.random.Generator) -> None:
    """Through a lens, with the robot hiding the middle of the image: every stripe is found once along each ray."""
    field = read_field("robocup_msl")
    pose, scale = (1.0, 3.0, 0.3), 0.02
    image = floor_image(field, pose, scale=scale, shape=(500, 500), line_width=0.125, rng=rng)
    lens = Lens(k1=2e-7, centre=(250.0, 250.0))
    columns, rows = np.meshgrid(np.arange(500), np.arange(500))
    at = lens.undistort(np.stack([columns, rows], axis=-1)).astype(np.float32)
    bent = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    points = scan_floor(bent, scale=scale, line_width=0.125, blind=0.5, model=lens).points
    assert len(points) > 60
    assert np.hypot(*points.T).min() > 0.5
    found = locate_robot(points, field)
    assert found.candidates[0].inlier_fraction > 0.95
    assert found.candidates[0].residual_std < 0.5 * scale
    angle = np.arctan2(points[:, 1], points[:, 0])
    for each in np.unique(np.round(angle, 3)):
        away = np.sort(np.hypot(*points[np.abs(angle - each) < 1e-3].T))
        assert np.all(np.diff(away) > 0.06)
