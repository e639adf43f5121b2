"""Merge of two scans on files: occlusion filled, disagreement flagged, wrong files refused."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.cli import main as cli
from gpuvision.formats.height_files import read_heights
from gpuvision.formats.range_image import read_npz, read_tiff, write_npz, write_tiff
from gpuvision.host.errors import ReadError
from gpuvision.ranging.height_map import Grid
from gpuvision.ranging.merge_heights import DISAGREES, FIRST, SECOND, UNCONFIRMED
from gpuvision.status import Status
from gpuvision.workflows import merging
from gpuvision.workflows.merging import MERGE_FILES, SIGMA_FILE, HeightMapMerge, merge_scans, read_height_map

CELL = 1e-4
BOTH = FIRST | SECOND
Run = Callable[..., tuple[int, str, str]]


def write_scan(folder: Path, z: np.ndarray, left: float = 0.0, sigma: float | None = 2e-6) -> Path:
    """Write the height map of a scan as `Scan.write` does."""
    folder.mkdir()
    rows, columns = z.shape
    grid = Grid(left=left, top=0.01, cell_x=CELL, cell_y=CELL, columns=columns, rows=rows)
    arrays = {
        "map_x": grid.x,
        "map_y": grid.y,
        "map_z": z,
        "map_status": np.where(np.isfinite(z), 0, Status.NO_DATA).astype(np.uint8),
        "map_intensity": np.ones_like(z),
    }
    if sigma is not None:
        arrays["map_sigma"] = np.full_like(z, sigma)
    write_npz(folder / "range_image.npz", arrays, dict.fromkeys(arrays, "m"))
    write_tiff(folder / "range_image.tiff", z, grid)
    return folder


def step(rng: np.random.Generator, hidden: slice, noise: float = 2e-6) -> np.ndarray:
    """Return a step of 1 mm seen by a sensor that does not see some columns at its foot."""
    z = np.where(np.arange(60) < 30, 1e-3, 0.0) + rng.normal(0.0, noise, (40, 60))
    z[:, hidden] = math.nan
    return z.astype(np.float32)


@pytest.fixture
def scans(rng: np.random.Generator, tmp_path: Path) -> tuple[Path, Path]:
    """Two sensors on both sides of a step; the second one reads a reflection in three rows."""
    second = step(rng, slice(22, 30))
    second[5:8, 40:50] += 2e-4
    return (
        write_scan(tmp_path / "first", step(rng, slice(30, 38))),
        write_scan(tmp_path / "second", second[:, 10:], left=10 * CELL),
    )


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*words: Any) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["gpuvision", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        code = ended.value.code
        return code if isinstance(code, int) else 0, *capsys.readouterr()

    return call


def test_occlusion_is_filled_and_disagreement_flagged(scans: tuple[Path, Path], run: Run, tmp_path: Path) -> None:
    out = tmp_path / "merged"
    code, text, err = run("merge", *scans, "--out", out)
    assert code == 0, err
    assert {each.name for each in out.iterdir() if not each.name.startswith(".")} >= {*MERGE_FILES, SIGMA_FILE}
    arrays, _ = read_npz(out / "range_image.npz")
    source = arrays["map_source"]
    assert np.all(source[:, 30:38] == SECOND)
    assert np.all(source[:, :10] == FIRST)
    assert np.all(source[:, 22:30] == FIRST)
    assert np.all(source[5:8, 40:50] == DISAGREES)
    assert np.all(np.isnan(arrays["map_z"][5:8, 40:50]))
    assert np.all(arrays["map_status"][5:8, 40:50] == Status.AMBIGUOUS)
    both = source == BOTH
    np.testing.assert_allclose(arrays["map_sigma"][both], 2e-6 / math.sqrt(2.0), rtol=1e-6)
    true = np.broadcast_to(np.where(np.arange(60) < 30, 1e-3, 0.0), source.shape)
    assert np.std((arrays["map_z"] - true)[both]) == pytest.approx(2e-6 / math.sqrt(2.0), rel=0.1)
    np.testing.assert_array_equal(read_tiff(out / "range_image.tiff").z, arrays["map_z"])
    report = json.loads((out / "report.json").read_text())
    assert report["weights"] == "inverse variance"
    assert report["tolerance_m"] == 0.0
    assert abs(report["difference"]["median_m"]) < 1e-6 < report["difference"]["robust_sigma_m"]
    with pytest.raises(ReadError, match=r"its values are the sigma of height \(noise and phase\)"):
        read_tiff(out / SIGMA_FILE)
    assert report["cells"]["second"] == np.count_nonzero(source == SECOND)
    assert report["cells"]["disagrees"] == np.count_nonzero(source & DISAGREES)
    assert "from the second alone" in text
    assert "warning" not in err
    # A merged map is the input of the next merge.
    assert read_height_map(out)[0].sigma is not None


def test_a_reflection_that_one_sensor_sees(
    rng: np.random.Generator, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second sensor does not see the reflection's place: it is called unconfirmed, or dropped on request."""
    z = step(rng, slice(0, 0), noise=0.0)
    z[10:14, 33:37] += np.float32(4e-4)
    scans = write_scan(tmp_path / "first", z), write_scan(tmp_path / "second", step(rng, slice(30, 38), noise=0.0))
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(
        merging, "draw_height_map", lambda path, *heights, **options: drawn.update({path.name: (heights, options)})
    )
    seen = np.zeros((40, 60), bool)
    seen[:, 30:38] = True
    counts, pictures = {}, {}
    for words in ((), ("--require-both",)):
        code, text, err = run("merge", *scans, "--out", tmp_path / "out", *words)
        assert code == 0, err
        arrays, _ = read_npz(tmp_path / "out" / "range_image.npz")
        counts[words] = json.loads((tmp_path / "out" / "report.json").read_text())["cells"]
        assert "seen by one sensor and unconfirmed" in text
        expected = UNCONFIRMED if words else FIRST
        np.testing.assert_array_equal(arrays["map_source"], np.where(seen, expected, BOTH))
        np.testing.assert_array_equal(np.isnan(arrays["map_z"]), seen if words else np.zeros_like(seen))
        pictures[words] = {meaning: mask for mask, _, meaning in drawn["sources.png"][1]["tints"] if mask.any()}
    assert counts[()] | {"unconfirmed": 320, "unconfirmed_dropped": 0, "none": 0} == counts[()]
    assert (
        counts[("--require-both",)] | {"unconfirmed": 0, "unconfirmed_dropped": 320, "none": 320}
        == counts[("--require-both",)]
    )
    np.testing.assert_array_equal(pictures[()].pop("first scan alone: unconfirmed"), seen)
    np.testing.assert_array_equal(pictures[("--require-both",)].pop("one scan alone: dropped"), seen)
    assert not any(pictures.values())


def test_an_offset_of_the_frames_is_said(rng: np.random.Generator, tmp_path: Path, run: Run) -> None:
    first, second = step(rng, slice(0, 0)), step(rng, slice(0, 0)) + np.float32(2e-5)
    write_scan(tmp_path / "first", first)
    write_scan(tmp_path / "second", second)
    code, _, err = run("merge", tmp_path / "first", tmp_path / "second", "--out", tmp_path / "out")
    assert code == 0
    assert re.search(r"the second map lies \+(19\.9|20(\.[0-2])?) um from the first one", " ".join(err.split()))
    assert "disagree in 100 % of their common cells" in " ".join(err.split())
    found = merge_scans(tmp_path / "first", tmp_path / "second", tolerance=5e-5)
    assert found.counts()["disagrees"] == 0


def test_common_cells_are_those_of_the_merge(rng: np.random.Generator, tmp_path: Path) -> None:
    """A finite height with a flag that no height has, or without a valid sigma, is not common to both maps."""
    z = step(rng, slice(0, 0))
    first, second = write_scan(tmp_path / "first", z), write_scan(tmp_path / "second", z[:, 10:], left=10 * CELL)
    arrays, units = read_npz(second / "range_image.npz")
    arrays["map_z"][3:5] += np.float32(1.0)
    arrays["map_status"][3] = Status.OUT_OF_RANGE
    arrays["map_sigma"][4] = 0.0
    write_npz(second / "range_image.npz", arrays, units, overwrite=True)
    found = merge_scans(first, second)
    assert found.counts()["common"] == found.counts()["both"] == 38 * 50
    np.testing.assert_array_equal(found.differences, 0.0)


def test_heights_without_sigma_are_reported(rng: np.random.Generator, tmp_path: Path, run: Run) -> None:
    """A focus stack gives a part of its heights no standard deviation."""
    first, second = (write_scan(tmp_path / name, step(rng, slice(0, 0))) for name in ("first", "second"))
    arrays, units = read_npz(second / "range_image.npz")
    arrays["map_sigma"][:10] = math.nan
    write_npz(second / "range_image.npz", arrays, units, overwrite=True)
    code, _, err = run("merge", first, second, "--out", tmp_path / "out")
    assert code == 0
    assert f"{second}: 25 % of the heights have no standard deviation" in err.replace("\n", " ")
    assert err.count("no standard deviation") == 1
    assert merge_scans(first, second).without_sigma == (0.0, 0.25)


def test_files_of_sigma_do_not_outlive_their_merge(scans: tuple[Path, Path], tmp_path: Path) -> None:
    merged = merge_scans(*scans)
    merged.write(tmp_path / "out")
    assert (tmp_path / "out" / SIGMA_FILE).exists()
    dataclasses.replace(merged, heights=merged.heights._replace(sigma=None)).write(tmp_path / "out")
    assert not (tmp_path / "out" / SIGMA_FILE).exists()


def test_noise_and_phase_stay_apart(tmp_path: Path) -> None:
    """A mean of maps with the variances 9 + 16 and 4 + 0 (um^2): weights 4/29 and 25/29; holes of either map."""
    z = np.full((3, 4), 1e-3)
    z[0, 0] = z[2, 1] = math.nan
    first = write_scan(tmp_path / "first", z, sigma=3e-6)
    second = write_scan(tmp_path / "second", z[:, ::-1].copy(), left=-CELL, sigma=2e-6)
    arrays, units = read_npz(first / "range_image.npz")
    arrays["map_phase"] = np.full_like(z, 4e-6)
    arrays["map_phase"][1, 0] = math.nan  # unknown
    write_npz(first / "range_image.npz", arrays, units | {"map_phase": "m"}, overwrite=True)
    merge_scans(first, second).write(tmp_path / "out")
    found, units = read_npz(tmp_path / "out" / "range_image.npz")
    assert units["map_phase"] == "m"
    both = 4.0 / 29.0
    mean, unknown = math.hypot(3 * both, 2 * 25.0 / 29.0), math.hypot(3 * 4.0 / 13.0, 2 * 9.0 / 13.0)
    nan, shared = math.nan, 4 * both
    phase = [[0.0, 0.0, shared, 4.0, 4.0], [0.0, 0.0, shared, shared, 4.0], [0.0, shared, nan, shared, 4.0]]
    noise = [[2.0, 2.0, mean, 3.0, 3.0], [2.0, unknown, mean, mean, 3.0], [2.0, mean, nan, mean, 3.0]]
    np.testing.assert_allclose(found["map_phase"], 1e-6 * np.array(phase), rtol=1e-12)
    np.testing.assert_allclose(found["map_sigma"], 1e-6 * np.array(noise), rtol=1e-12)
    # Merged again, the heights of the first merge keep both.
    again = read_heights(tmp_path / "out" / "range_image.npz")
    assert again.total_sigma is not None
    np.testing.assert_allclose(merge_scans(first, second).heights.sigma, again.total_sigma, rtol=1e-12)
    # A phase without sigma gives no weights.
    del arrays["map_sigma"]
    write_npz(first / "range_image.npz", arrays, dict.fromkeys(arrays, "m"), overwrite=True)
    assert merge_scans(first, second, tolerance=1e-6).phase is None


def test_heights_without_sigma_need_a_tolerance(rng: np.random.Generator, tmp_path: Path) -> None:
    first = write_scan(tmp_path / "first", step(rng, slice(30, 38)), sigma=None)
    second = write_scan(tmp_path / "second", step(rng, slice(22, 30)))
    with pytest.raises(ValueError, match="give a tolerance"):
        merge_scans(first, second)
    found = merge_scans(first / "range_image.tiff", second / "range_image.tiff", tolerance=2e-5)
    assert found.heights.sigma is None
    assert np.all(found.heights.source[:, 30:38] == SECOND)
    assert found.report()["weights"] == "equal"


def test_wrong_files_are_refused(rng: np.random.Generator, tmp_path: Path) -> None:
    scan = write_scan(tmp_path / "first", step(rng, slice(0, 0)))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        merge_scans(scan, tmp_path / "nowhere")
    write_npz(tmp_path / "other.npz", {"x": np.zeros(3)}, {"x": "m"})
    with pytest.raises(ReadError, match=r"other\.npz"):
        merge_scans(scan, tmp_path / "other.npz")
    arrays, units = read_npz(scan / "range_image.npz")
    write_npz(tmp_path / "cut.npz", {**arrays, "map_x": arrays["map_x"][:-1]}, units)
    with pytest.raises(ReadError, match="map_z has shape"):
        merge_scans(scan, tmp_path / "cut.npz")
    for name, expected in (("map_status", "integers"), ("map_intensity", "real numbers")):
        write_npz(tmp_path / "text.npz", {**arrays, name: np.full(arrays["map_z"].shape, "bad")}, units, overwrite=True)
        with pytest.raises(ReadError, match=rf"text\.npz: {name} has the type <U3, expected {expected}"):
            merge_scans(scan, tmp_path / "text.npz")
    write_tiff(tmp_path / "bare.tiff", np.zeros((4, 4)))
    with pytest.raises(ReadError, match="states no grid"):
        merge_scans(scan, tmp_path / "bare.tiff", tolerance=1e-6)


def test_arrays_of_another_shape_are_refused(rng: np.random.Generator, tmp_path: Path) -> None:
    scan = write_scan(tmp_path / "first", step(rng, slice(0, 0)))
    arrays, units = read_npz(scan / "range_image.npz")
    for name in ("map_status", "map_intensity"):
        write_npz(tmp_path / "cut.npz", {**arrays, name: arrays[name][:, :-1]}, units, overwrite=True)
        with pytest.raises(ReadError, match=rf"cut\.npz: {name} has shape \(40, 59\), expected \(40, 60\) as map_z"):
            read_height_map(tmp_path / "cut.npz")


def test_what_a_map_does_not_hold_follows_from_its_heights(rng: np.random.Generator, tmp_path: Path) -> None:
    """Without flags a hole has no data; without intensities a height has intensity 0."""
    scan = write_scan(tmp_path / "first", step(rng, slice(30, 38)))
    arrays, _ = read_npz(scan / "range_image.npz")
    del arrays["map_status"], arrays["map_intensity"]
    write_npz(tmp_path / "bare.npz", arrays, dict.fromkeys(arrays, "m"))
    heights, _ = read_height_map(tmp_path / "bare.npz")
    holes = np.isnan(arrays["map_z"])
    np.testing.assert_array_equal(heights.status, np.where(holes, Status.NO_DATA, Status.OK))
    np.testing.assert_array_equal(heights.intensity, np.where(holes, np.nan, 0.0))
    assert np.asarray(heights.status).dtype == np.uint8


@pytest.mark.parametrize("has_sigma", [False, True])
def test_report_of_a_merge(has_sigma: bool) -> None:
    """Each number once; the differences are 1, 2, 4, 5 and 9 um: median 4 um, deviations 3, 2, 0, 1, 5 um."""
    source = np.zeros((2, 4), np.uint8)
    source[0], source[1, :2] = (FIRST, FIRST | SECOND, SECOND, SECOND | DISAGREES), (SECOND, UNCONFIRMED)
    grid = Grid(left=1.0, top=2.0, cell_x=3e-3, cell_y=4e-3, columns=4, rows=2)
    heights: Any = SimpleNamespace(source=source, sigma=np.zeros(1) if has_sigma else None)
    settings = {"max_sigmas": 2.5, "tolerance": 1e-6, "disagreement": "keep", "require_both": False}
    differences = np.array([1.0, 2.0, 4.0, 5.0, 9.0]) * 1e-6
    merge = HeightMapMerge(
        names=("one", "other"), heights=heights, grid=grid, differences=differences, settings=settings
    )
    report = merge.report()
    assert report.pop("gpuvision")
    assert report == {
        "first": "one",
        "second": "other",
        "max_sigmas": 2.5,
        "tolerance_m": 1e-6,
        "disagreement": "keep",
        "require_both": False,
        "cells": {
            "first": 1,
            "second": 3,
            "both": 1,
            "none": 3,
            "unconfirmed": 3,
            "unconfirmed_dropped": 1,
            "common": 5,
            "disagrees": 1,
        },
        "difference": {"median_m": pytest.approx(4e-6), "robust_sigma_m": pytest.approx(1.4826022 * 2e-6)},
        "weights": "inverse variance" if has_sigma else "equal",
        "map": dataclasses.asdict(grid),
        "warnings": list(merge.advice()),
    }
    assert "dropped" not in merge.summary()
    nothing = dataclasses.replace(merge, differences=np.zeros(0)).report()["difference"]
    assert nothing == {"median_m": None, "robust_sigma_m": None}


def test_files_of_a_merge_with_and_without_sigma() -> None:
    merge: Any = object.__new__(HeightMapMerge)
    for sigma, files in ((None, MERGE_FILES), (np.zeros(1), (*MERGE_FILES, SIGMA_FILE))):
        object.__setattr__(merge, "heights", SimpleNamespace(sigma=sigma))
        assert merge.files() == files


def test_inputs_are_not_replaced(scans: tuple[Path, Path], run: Run) -> None:
    before = (scans[0] / "range_image.npz").read_bytes()
    code, _, err = run("merge", *scans, "--out", scans[0], "--overwrite")
    assert code == 1
    assert "range_image.npz" in err
    assert (scans[0] / "range_image.npz").read_bytes() == before


def test_an_npz_is_read_once(scans: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    read, load = [], np.load
    monkeypatch.setattr(np, "load", lambda path, **options: read.append(path) or load(path, **options))
    assert read_height_map(scans[0])[0].sigma is not None
    assert read == [scans[0] / "range_image.npz"]


def test_advice_and_summary_state_the_numbers_of_the_merge() -> None:
    """Ten common cells, two of which disagree; the second map lies 20 um lower, with a deviation of 1.4826 * 4 um."""
    source = np.zeros((4, 10), np.uint8)
    source[0], source[1, :7], source[2, :3] = FIRST | SECOND, FIRST, SECOND
    source[0, :2] |= DISAGREES
    source[3, :4] = UNCONFIRMED
    grid = Grid(left=0.0, top=0.0, cell_x=1e-3, cell_y=1e-3, columns=10, rows=4)
    heights: Any = SimpleNamespace(source=source)
    merge = HeightMapMerge(
        names=("a", "b"),
        heights=heights,
        grid=grid,
        differences=np.array([-30.0, -24.0, -24.0, -23.0, -20.0, -20.0, -16.0, -16.0, -17.0, 90.0]) * 1e-6,
        settings={"require_both": True},
        without_sigma=(0.05, 0.051),
    )
    left_out, offset, disagreement = merge.advice()
    assert left_out.startswith("b: 5 % of the heights have no standard deviation")
    assert offset.startswith("the second map lies -20 um from the first one (median; robust deviation 5.93 um)")
    assert disagreement.startswith("the maps disagree in 20 % of their common cells")
    expected = (
        "10 x 4 cells: 25.0 % from both, 17.5 % from the first alone, 7.5 % from the second alone, 50.0 % without"
    )
    assert merge.summary().startswith(expected)
    assert (
        "the maps disagree in 5.0 %; seen by one sensor and unconfirmed: 25.0 %, and 10.0 % dropped" in merge.summary()
    )
    # Half a deviation is no offset, a tenth of the cells no disagreement.
    even = np.array([-1.0, 1.0] * 5) * 1e-6 * 1.4826
    source[0, 1] = FIRST | SECOND
    assert len(dataclasses.replace(merge, differences=even + 0.9e-6, without_sigma=(0.0, 0.05)).advice()) == 0
    assert dataclasses.replace(merge, differences=np.zeros(0)).advice()[-1].startswith("the two maps have no common")
