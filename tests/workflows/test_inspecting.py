"""``gpuvision inspect`` from files: paste of a board, leads of a CSV file and of a part, messages."""

from __future__ import annotations

import csv
import inspect
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.formats.height_files import HeightMapFile
from gpuvision.formats.range_image import write_tiff
from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.paste import PasteSettings
from gpuvision.workflows import inspecting_leads, inspecting_paste
from gpuvision.workflows.inspecting_leads import inspect_leads
from gpuvision.workflows.inspecting_paste import inspect_paste
from paste_maps import Box, Cap, board_grid, circle, paste_map, rectangle
from scanning import Ran, check_refused

HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"
PLACES = [(1.0, 1.0), (2.2, 1.1), (3.0, 2.2), (1.2, 2.6), (2.1, 1.9)]
LAYERS = ("--layers", "paste.gbr=top paste", "--layers", "copper.gbr=top copper")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    return lambda *args: Ran(capsys, monkeypatch, "inspect", *args)


def flashes(places: list[tuple[float, float]]) -> str:
    return "".join(f"X{round(x * 1e6)}Y{round(y * 1e6)}D03*\n" for x, y in places)


@pytest.fixture
def gerbers(tmp_path: Path) -> Path:
    folder = tmp_path / "gerbers"
    folder.mkdir()
    copper = "%ADD10C,0.5*%\nD10*\n"
    for pin, place in enumerate(PLACES, 1):
        copper += f"%TO.P,U7,{pin}*%\n" + flashes([place])
    (folder / "paste.gbr").write_text(HEAD + "%ADD10C,0.4*%\nD10*\n" + flashes(PLACES) + "M02*\n")
    (folder / "copper.gbr").write_text(HEAD + copper + "M02*\n")
    return folder


@pytest.fixture
def paste(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Height map of caps; the second has a quarter of its volume, the last is missing."""
    grid = board_grid(200, 180, cell=20e-6)
    place = BoardPlacement(x=0.1e-3, y=-0.3e-3, theta=0.02)
    heights = [130e-6, 40e-6, 130e-6, 130e-6]
    spots = [(Cap(200e-6, h), (1e-3 * x, 1e-3 * y)) for h, (x, y) in zip(heights, PLACES, strict=False)]
    z = paste_map(grid, place, spots) + rng.normal(0, 1e-6, grid.shape)
    write_tiff(tmp_path / "map.tiff", z, grid)
    return tmp_path / "map.tiff"


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_the_search_covers_two_millimetres_and_three_degrees() -> None:
    default = inspect.signature(inspect_paste).parameters["search_range"].default
    assert default == pytest.approx((0.002, np.deg2rad(3.0)))


@pytest.mark.rendered
def test_the_paste_of_a_board(gerbers: Path, paste: Path, tmp_path: Path, run: Any) -> None:
    out = tmp_path / "out"
    ran = run(paste, "--board", gerbers, "--stencil=120um", *LAYERS, "--out", out, "--scale-sigma=0.01,0.002")
    assert ran.code == 0, ran.err
    assert "5 deposits: 3 pass, 2 low" in ran.out
    rows = rows_of(out / "paste.csv")
    assert [each["verdict"] for each in rows] == ["pass", "low", "pass", "pass", "low"]
    assert [each["status"] for each in rows] == ["measured"] * 4 + ["missing"]
    volume = [float(each["volume_m3"]) for each in rows]
    np.testing.assert_allclose(volume[:4], [Cap(200e-6, h).volume for h in (130e-6, 40e-6, 130e-6, 130e-6)], rtol=0.01)
    np.testing.assert_allclose(float(rows[0]["expected_area_m2"]), np.pi * 200e-6**2, rtol=1e-3)
    np.testing.assert_allclose(float(rows[0]["volume_systematic_sigma_m3"]), volume[0] * np.hypot(0.01, 0.004))
    assert rows[4]["offset_x_m"] == ""
    report = json.loads((out / "report.json").read_text())
    np.testing.assert_allclose(
        [report["pose"][name] for name in ("x_m", "y_m", "theta_rad")], [1e-4, -3e-4, 0.02], atol=1e-4
    )
    assert report["files"] == {"height_map": str(paste), "board": str(gerbers)}
    assert report["settings"]["stencil_m"] == pytest.approx(120e-6)
    assert report["board_scatter_m"] == pytest.approx(1e-6, rel=0.1)
    assert report["alignment"]["residual_scale_m"] < 1e-5
    assert report["deposits"][4]["offset_x_m"] is None
    assert report["noise_m"] == pytest.approx(1e-6, rel=0.1)
    assert (out / "volume.png").stat().st_size > 10_000
    limits = ("--minimum-volume=0.1", "--maximum-volume=0.4", "--sigma=2um", "--margin=20um", "--ring=0.1mm")
    pose = ("--pose=0.1mm,-0.3mm,0.02rad", "--json", "-")
    ran = run(paste, "--board", gerbers, "--stencil=120um", *LAYERS, "--out", out, *limits, *pose)
    report = json.loads(ran.out)
    assert [each["verdict"] for each in report["deposits"]] == ["high", "pass", "high", "high", "low"]
    assert report["alignment"] is None
    assert report["noise_m"] == 2e-6
    assert report["warnings"] == []
    ran = run(
        paste, "--board", gerbers, "--stencil=120um", *LAYERS, "--out", out, "--sigma=0.4um", pose[0], "--pin-names"
    )
    assert [each["name"] for each in rows_of(out / "paste.csv")] == ["U7.1", "U7.2", "U7.3", "U7.4", "U7.5"]
    assert "warning: the board scatters by 1" in ran.err
    assert "the sigma of the heights is 0.4 um" in ran.err


def test_an_image_with_a_scale(gerbers: Path, tmp_path: Path, run: Any) -> None:
    grid = board_grid(200, 180, cell=20e-6)
    here = BoardPlacement(x=-10e-6, y=-10e-6, theta=0.0)  # an image begins at the centre of its first pixel
    z = paste_map(grid, BoardPlacement(x=0.0, y=0.0, theta=0.0), [(Box((360e-6, 360e-6), 120e-6), (1e-3, 1e-3))])
    cv2.imwrite(str(tmp_path / "map.png"), np.rint((z - 0.8e-3) / 1e-8).astype(np.uint16))
    scale = ("--cell=20um", "--height-step=0.01um", "--height-offset=0.8mm", "--hole=-1")
    pose = f"--pose={here.x},{here.y},0"
    ran = run(
        tmp_path / "map.png", *scale, "--board", gerbers, *LAYERS, "--stencil=120um", "--out", tmp_path / "o", pose
    )
    assert ran.code == 0, ran.err
    first = rows_of(tmp_path / "o" / "paste.csv")[0]
    np.testing.assert_allclose(float(first["volume_m3"]), 360e-6**2 * 120e-6, rtol=1e-3)


@pytest.mark.parametrize("by_part", [False, True])
def test_the_leads_of_a_component(gerbers: Path, tmp_path: Path, run: Any, by_part: bool) -> None:
    """Balls over the pads of a part, leads up: the mirror image of the board."""
    grid = board_grid(220, 180, cell=20e-6)
    seen = BoardPlacement(x=4.2e-3, y=0.1e-3, theta=0.0, side="bottom")
    lows = [0.0, 30e-6, 0.0, 0.0, 10e-6]
    spots = [(Cap(250e-6, 200e-6 - low), (1e-3 * x, 1e-3 * y)) for low, (x, y) in zip(lows, PLACES, strict=True)]
    write_tiff(tmp_path / "map.tiff", paste_map(grid, seen, spots), grid)
    if by_part:
        chosen = ["--leads=U7", "--board", gerbers, *LAYERS, "--pose=4.2mm,0.1mm,0deg"]
    else:
        at = [seen.to_map(np.array([1e-3 * x, 1e-3 * y])) for x, y in PLACES]
        lines = [f"{k},{x},{y},5e-4,5e-4,0.1" for k, (x, y) in enumerate(at, 1)]
        (tmp_path / "leads.csv").write_text("name,x,y,width,height,angle\n" + "\n".join(lines) + "\n")
        chosen = ["--leads", tmp_path / "leads.csv"]
    ran = run(tmp_path / "map.tiff", *chosen, "--out", tmp_path / "out", "--maximum-gap=20um", "--sigma=1um")
    assert (ran.code, ran.err) == (0, "")
    rows = rows_of(tmp_path / "out" / "leads.csv")
    np.testing.assert_allclose([float(each["gap_m"]) for each in rows], lows, atol=1e-6)
    assert [each["verdict"] for each in rows] == ["pass", "high", "pass", "pass", "pass"]
    assert [each["seat"] for each in rows] == ["True", "False", "True", "True", "False"]
    assert "coplanarity 30 um" in ran.out
    assert (tmp_path / "out" / "coplanarity.png").exists()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [report[name] for name in ("maximum_gap_m", "noise_m")] == pytest.approx([20e-6, 1e-6])
    assert report["coplanarity_m"] == pytest.approx(30e-6, abs=1e-6)
    assert report["files"]["height_map"] == str(tmp_path / "map.tiff")
    assert report["files"]["leads"] == str(chosen[0].removeprefix("--leads=") if by_part else chosen[1])
    assert ("board" in report["files"]) == by_part


@pytest.mark.parametrize("source", ["map", "option", "estimate"])
def test_estimated_sigmas_of_leads_are_named(rng: np.random.Generator, source: str) -> None:
    """Neighbours that share their error: the estimate of the sigma does not see it, and a warning says so."""
    grid = board_grid(220, 180, cell=20e-6)
    common = np.repeat(rng.normal(0.0, 20e-6, (grid.rows // 20, grid.columns // 20)), 20, axis=0).repeat(20, axis=1)
    z = common + rng.normal(0.0, 1e-6, grid.shape)
    places = [(0.3e-3, 0.3e-3), (3.9e-3, 0.3e-3), (0.3e-3, 3.1e-3), (3.9e-3, 3.1e-3)]
    regions = [rectangle(str(k), place, (0.4e-3, 0.4e-3)) for k, place in enumerate(places)]
    sigma = np.full(grid.shape, 20e-6) if source == "map" else None
    found = inspect_leads(
        HeightMapFile(z, grid, sigma), regions, sigma=20e-6 if source == "option" else None, correlation_area=400.0
    )
    warned = found.report()["warnings"]
    assert list(found.warnings()) == warned
    if source == "estimate":
        assert found.leads.noise < 2e-6
        (sentence,) = warned
        assert sentence.startswith("the sigma of the heights is estimated from differences of neighbouring cells")
    else:
        assert not warned


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--stencil=120um",), "--board is missing; expected a board with its stencil, or --leads"),
        (("--board", "GERBERS"), "--stencil is missing"),
        (("--leads=U7",), "--leads is 'U7', a part: give --board too"),
        (("--leads=U7", "--board", "GERBERS", *LAYERS), "--leads is 'U7', a part: give --pose too"),
        (("--leads=U8", "--board", "GERBERS", *LAYERS), "no pad belongs to the part 'U8'; known parts: U7"),
        (("--leads=U7", "--stencil=1um"), "--stencil has no effect with --leads"),
        (("--leads=U7", "--pin-names"), "--pin-names has no effect with --leads"),
        (("--centre=0,0",), "--centre has no effect without --leads"),
        (("--cell=1um",), "--height-step is missing"),
        (("--leads=U7", "--sigma=-5um"), r"--sigma is -[0-9.e-]+, expected a number > 0"),
        (("--leads=U7", "--sigma=1e400m"), "--sigma is '1e400m', expected finite numbers"),
        (("--leads=U7", "--correlation-area=inf"), "--correlation-area must be finite"),
        (("--board", "GERBERS", "--stencil=1", "--sigma=0"), "--sigma is 0.0, expected a number > 0"),
        (("--board", "GERBERS", "--stencil=1", "--correlation-area=inf"), "--correlation-area must be finite"),
        (
            ("--board", "GERBERS", "--stencil=0.1mm", "--search-range=-1mm,1deg"),
            "the shift of --search-range is -0.001, expected a number >= 0",
        ),
        (
            ("--board", "GERBERS", "--stencil=0.1mm", "--search-range=1mm,-1deg"),
            "the rotation of --search-range is -0.01[0-9]*, expected a number >= 0",
        ),
        (("--hole=1",), "--hole has no effect without --cell and --height-step"),
        (("--board", "GERBERS", "--stencil=1", "--pose=0,0,0", "--search-range=1,1"), "--search-range has no effect"),
        (("--board", "GERBERS", "--stencil=0.1mm", "--scale-sigma=1"), "--scale-sigma is '1', expected two numbers"),
        (
            ("--board", "GERBERS", "--stencil=0.1mm", "--minimum-volume=2"),
            "maximum volume is 1.5, expected a number > 2",
        ),
    ],
)
def test_options_that_do_not_fit_are_refused(
    gerbers: Path, paste: Path, tmp_path: Path, run: Any, options: tuple[str, ...], message: str
) -> None:
    given = [gerbers if each == "GERBERS" else each for each in options]
    check_refused(run(paste, *given, "--out", tmp_path / "out"), message)
    assert not (tmp_path / "out").exists()


def test_a_missing_height_map_is_named(gerbers: Path, tmp_path: Path, run: Any) -> None:
    check_refused(run(tmp_path / "no.tiff", "--out", tmp_path / "out"), r"no\.tiff: no such file")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sigma": -5e-6}, "sigma is -5e-06, expected a number > 0"),
        ({"sigma": float("inf")}, "sigma must be finite"),
        ({"correlation_area": float("nan")}, "correlation_area must be finite"),
    ],
)
def test_noise_that_is_no_noise_is_refused(given: dict[str, float], message: str) -> None:
    grid = board_grid(20, 20)
    heights = HeightMapFile(np.zeros(grid.shape), grid)
    place = [circle(str(k), (1e-4 * k, 1e-4 * k**2), 5e-5) for k in (1, 2, 3)]
    with pytest.raises(ValueError, match=message):
        inspect_leads(heights, place, **given)
    with pytest.raises(ValueError, match=message):
        inspect_paste(heights, place, PasteSettings(stencil=1e-4), pose=(0.0, 0.0, 0.0), **given)


def aperture(x: float, y: float) -> Any:
    """Return an aperture of 2 x 1 mm with its lower left corner at a place [m]."""
    return SimpleNamespace(bounds=np.array([[x, y], [x + 2e-3, y + 1e-3]]))


@pytest.mark.parametrize(("side", "sign"), [("top", 1.0), ("bottom", -1.0)])
def test_a_search_begins_with_the_centres_over_each_other(side: Any, sign: float) -> None:
    """The apertures reach from (1, 2) to (9, 7) mm; the map of 5 x 3 cells of 2 x 4 mm from (10, 30) mm."""
    grid = SimpleNamespace(left=10e-3, top=30e-3, columns=5, rows=3, cell_x=2e-3, cell_y=4e-3)
    heights: Any = SimpleNamespace(grid=grid)
    found = inspecting_paste._centred(heights, [aperture(1e-3, 6e-3), aperture(7e-3, 2e-3)], side)
    assert (found.side, found.theta) == (side, 0.0)
    assert found.x == pytest.approx(14e-3 - sign * 5e-3)
    assert found.y == pytest.approx(26e-3 - 4.5e-3)


@pytest.mark.parametrize("given", ["pose", "initial_pose", None])
def test_a_pose_is_known_or_the_beginning_of_a_search(given: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    pose = (1e-3, -2e-3, 0.1)
    calls: list[Any] = []
    place, aligned, centred = (SimpleNamespace(name=name) for name in ("place", "aligned", "centred"))

    def align(z: Any, grid: Any, apertures: Any, settings: Any, *, initial: Any, search_range: Any) -> Any:
        calls.append(("align", initial, search_range))
        return SimpleNamespace(placement=aligned)

    def measure(z: Any, grid: Any, apertures: Any, placement: Any, settings: Any, **how: Any) -> Any:
        calls.append(("measure", placement, how))
        return "deposits"

    monkeypatch.setattr(inspecting_paste, "align_apertures", align)
    monkeypatch.setattr(inspecting_paste, "measure_deposits", measure)
    monkeypatch.setattr(inspecting_paste, "_centred", lambda *_: centred)
    monkeypatch.setattr(inspecting_paste, "BoardPlacement", lambda **where: SimpleNamespace(**vars(place), where=where))
    heights: Any = SimpleNamespace(z="z", grid="grid", sigma=3e-6, phase="phase")
    options: dict[str, Any] = {} if given is None else {given: pose}
    found = inspect_paste(
        heights,
        ["aperture"],
        "settings",
        side="bottom",
        search_range=(1e-3, 0.2),
        correlation_area=4.0,
        **options,  # type: ignore[list-item, arg-type]
    )
    where = {"x": 1e-3, "y": -2e-3, "theta": 0.1, "side": "bottom"}
    *searched, (_, placement, how) = calls
    assert how == {"sigma": 3e-6, "phase": "phase", "correlation_area": 4.0}
    if given == "pose":
        assert searched == []
        assert placement.where == where
        assert found.alignment is None
    else:
        ((_, initial, search_range),) = searched
        assert search_range == (1e-3, 0.2)
        assert initial is centred if given is None else initial.where == where
        assert placement is aligned
        assert found.alignment is not None
    with pytest.raises(ValueError, match="pose and initial_pose are both given; expected a known pose or the"):
        inspect_paste(heights, [], "settings", side="top", pose=pose, initial_pose=pose)  # type: ignore[arg-type]


@pytest.mark.parametrize("centre", [None, (1e-3, 2e-3)])
@pytest.mark.parametrize("placed", [False, True])
@pytest.mark.parametrize("sigma", [None, 4e-6])
def test_leads_are_moved_with_their_centre_of_gravity(
    centre: tuple[float, float] | None, placed: bool, sigma: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(
        inspecting_leads, "measure_coplanarity", lambda *given, **how: asked.append((given, how)) or "leads"
    )
    placement: Any = SimpleNamespace(to_map=lambda point: np.add(point, (0.5, 0.25))) if placed else None
    regions: Any = [SimpleNamespace(moved=lambda where, k=k: (k, where is placement)) for k in range(3)]
    heights: Any = SimpleNamespace(z="z", grid="grid", sigma=2e-6, phase="phase")
    found = inspect_leads(
        heights, regions, placement=placement, sigma=sigma, correlation_area=3.0, centre=centre, maximum=5e-5,
        files={"a": "b"},
    )  # fmt: skip
    ((given, how),) = asked
    expected = tuple((k, True) for k in range(3)) if placed else tuple(regions)
    assert given == ("z", "grid", expected)
    shift = (0.5, 0.25) if placed else (0.0, 0.0)
    place = None if centre is None else pytest.approx((1e-3 + shift[0], 2e-3 + shift[1]))
    assert how == {"sigma": sigma or 2e-6, "phase": "phase", "correlation_area": 3.0, "centre": place}
    assert (found.heights, found.regions, found.leads, found.maximum) == (heights, expected, "leads", 5e-5)
    assert found.files == {"a": "b"}


def test_pads_of_a_part_are_named_by_their_pins() -> None:
    """Pads without a pin by their number; a part that is not there names those that are."""
    square = np.array([[0.0, 0.0], [1e-3, 0.0], [1e-3, 1e-3], [0.0, 1e-3]])
    pads: Any = [SimpleNamespace(part=part, pin=pin, outline=square + k) for k, (part, pin) in enumerate(
        (("U1", "A1"), ("R1", "1"), ("U1", ""), ("", "7"), ("U1", "B2"))
    )]  # fmt: skip
    found = inspecting_leads.pads_of_part(pads, "U1")
    assert [each.name for each in found] == ["A1", "2", "B2"]
    for each, k in zip(found, (0, 2, 4), strict=True):
        np.testing.assert_allclose(each.centroid, [k + 5e-4, k + 5e-4])
    with pytest.raises(ValueError, match=r"no pad belongs to the part 'U9'; known parts: R1, U1$"):
        inspecting_leads.pads_of_part(pads, "U9")
    with pytest.raises(ValueError, match="known parts: none: the files do not name parts"):
        inspecting_leads.pads_of_part(pads[3:4], "U9")
    many: Any = [SimpleNamespace(part=f"P{k:02}", pin="1", outline=square) for k in range(14)]
    with pytest.raises(ValueError, match=r"known parts: P00, .*, P11$"):
        inspecting_leads.pads_of_part(many, "U9")
