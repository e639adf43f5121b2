"""Output folder of a scan: checked before the scan, with a one-line error."""

from __future__ import annotations

import dataclasses
import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.formats import surface_files as surfaces
from gpuvision.formats.range_image import read_ply, read_tiff
from gpuvision.host.files import atomic_folder, check_writable_file, check_writable_folder
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.scan_result import SCAN_FILES, SIGMA_FILES, surface_files
from gpuvision.workflows.scanning import scan
from scanning import Ran, check_refused, currents


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    return lambda *args: Ran(capsys, monkeypatch, *args)


@pytest.fixture
def plane(tmp_path: Path) -> Path:
    np.save(tmp_path / "plane.npy", currents(4))
    return tmp_path / "plane.npy"


@pytest.fixture
def shut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder in which no user, including root, can create folders."""
    folder = tmp_path / "shut"
    folder.mkdir()
    make = Path.mkdir

    def refuse(path: Path, *args: Any, **options: Any) -> None:
        if path.parent == folder and not path.exists():
            raise PermissionError(13, "Permission denied", str(path))
        make(path, *args, **options)

    monkeypatch.setattr(Path, "mkdir", refuse)
    return folder


def visible(folder: Path) -> list[Path]:
    return [each for each in folder.iterdir() if not each.name.startswith(".")]


def all_of(folder: Path) -> dict[str, str | None]:
    return {str(each): None if each.is_dir() else each.read_bytes().hex() for each in folder.rglob("*")}


@pytest.mark.parametrize("name", ["picture.png", "scan.png", "report.json"])
def test_a_folder_in_the_way_of_a_file_is_named_and_nothing_is_written(
    name: str, plane: Path, tmp_path: Path, run: Any
) -> None:
    out = tmp_path / "out"
    (out / name).mkdir(parents=True)
    before = all_of(tmp_path)
    ran = run("scan", plane, "--sensor", "psd_line", "--out", out)
    check_refused(ran, rf"cannot write {out / name}: it is a folder, expected a file")
    assert ".part" not in ran.err
    assert all_of(tmp_path) == before


def test_a_folder_that_is_there_needs_nothing_of_the_one_above(shut: Path) -> None:
    """A mounted folder is on another file system than its parent, which may be read-only."""
    out = shut / "out"
    os.mkdir(out)
    with atomic_folder(out) as inside:
        assert inside.parent == out
        (inside / "first").write_text("new")
    assert [each.name for each in out.iterdir()] == ["first"]


def test_what_cannot_be_written_is_known_before_the_scan(plane: Path, shut: Path, tmp_path: Path, run: Any) -> None:
    plane.write_bytes(b"")  # reading it would fail first
    before = all_of(tmp_path)
    for args, message in (
        (("--out", shut / "deep" / "out"), rf"cannot write into {shut / 'deep' / 'out'}: {shut}: Permission denied"),
        (("--out", tmp_path / "out", "--trace", shut / "t.json"), rf"cannot write into {shut}: .*Permission denied"),
        (("--out", tmp_path / "out", "--trace", shut), rf"cannot write {shut}: it is a folder, expected a file"),
        (
            ("--out", tmp_path / "o", "--trace", tmp_path / "o"),
            r"o is the folder .*o of the outputs or one above it; give a file",
        ),
    ):
        ran = run("scan", plane, "--sensor", "psd_line", *args)
        check_refused(ran, message)
        assert ".part" not in ran.err
        assert all_of(tmp_path) == before
    check_refused(run("demo", "--out", shut / "out"), rf"cannot write into {shut / 'out'}: {shut}: Permission denied")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a file system into which nobody can write")
def test_a_virtual_file_system_takes_nothing() -> None:
    with pytest.raises(OSError, match=r"cannot write into /proc/gpuvision: /proc: "):
        check_writable_folder("/proc/gpuvision")


def test_an_empty_name_is_not_this_folder(plane: Path, tmp_path: Path, run: Any) -> None:
    for args in (
        ("scan", "", "--sensor", "psd_line", "--out", tmp_path / "out"),
        ("scan", plane, "--sensor", "psd_line", "--out", ""),
        ("scan", plane, "--sensor", "psd_line", "--out", tmp_path / "out", "--trace", ""),
        ("demo", "--out", ""),
        ("profile", "--json", ""),
    ):
        ran = run(*args)
        assert ran.code == 2
        assert "is empty" in ran.err
    for check in (check_writable_folder, check_writable_file):
        with pytest.raises(ValueError, match="is empty; give one"):
            check("")
    with pytest.raises(ValueError, match="is empty"):
        scan(currents(2), Sensor.load("psd_line")).write("")


def test_a_scan_also_writes_surface_files_and_a_ply_of_valid_points(plane: Path, tmp_path: Path, run: Any) -> None:
    from SurfaceTopography.IO import open_topography  # takes seconds; here only the process of this test imports it

    out = tmp_path / "out"
    formats = ("--format", "x3p", "--format", "sur", "--format", "sdf-ascii", "--ply", "valid")
    assert run("scan", plane, "--sensor", "psd_line", "--out", out, *formats).code == 0
    heights = read_tiff(out / "range_image.tiff")
    for name in ("range_image.x3p", "range_image.sur", "range_image.sdf"):
        shape = open_topography(str(out / name)).topography().nb_grid_pts
        assert shape == heights.z.shape[::-1]
    assert all(np.isfinite(read_ply(out / "range_image.ply")["z"]))
    assert run("scan", plane, "--sensor", "psd_line", "--out", out, *formats).code == 0  # its own files, replaced


def test_a_format_that_cannot_hold_the_map_costs_no_other_file(
    plane: Path, tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number of rows is known only after the scan."""
    monkeypatch.setattr(surfaces, "_MAX_SDF_POINTS", 5)
    out, report = tmp_path / "out", tmp_path / "report.json"
    formats = ("--format", "sdf", "--format", "x3p", "--json", report)
    ran = run("scan", plane, "--sensor", "psd_line", "--out", out, *formats)
    assert ran.code == 1
    said = rf"gpuvision: cannot write {out}/range_image\.sdf: the height map has \d+ columns and \d+ rows, an SDF file"
    assert re.fullmatch(rf"{said} holds at most 5 a side; leave out --format sdf .*all other files.*\n", ran.err)
    assert {*SCAN_FILES, *SIGMA_FILES[:1], "range_image.x3p"} == {each.name for each in visible(out)}
    assert report.exists()
    with pytest.raises(ValueError, match=r"range_image\.sdf: the height map has .*leave out --format sdf-ascii"):
        scan(currents(4), Sensor.load("psd_line")).write(tmp_path / "other", formats=["sdf-ascii"])
    assert not (tmp_path / "other").exists()


def test_optional_files_do_not_outlive_their_scan(tmp_path: Path) -> None:
    """A scan with other formats and without noise removes its earlier files alone, if they are unchanged."""
    done = scan(currents(4), Sensor.load("psd_line"))
    bare = dataclasses.replace(done, errors=None, heights=done.heights._replace(sigma=None))
    for out in (tmp_path / "out", tmp_path / "edited"):
        done.write(out, formats=["x3p", "sur"])
    (tmp_path / "edited" / "range_image.x3p").write_text("a user's")
    (tmp_path / "out" / "range_image.sdf").write_text("a user's")
    bare.write(tmp_path / "out", formats=["sur"])
    assert {each.name for each in visible(tmp_path / "out")} == {*SCAN_FILES, "range_image.sur", "range_image.sdf"}
    bare.write(tmp_path / "edited")
    assert {each.name for each in visible(tmp_path / "edited")} == {*SCAN_FILES, "range_image.x3p"}


def test_two_formats_of_one_file_are_refused(plane: Path, tmp_path: Path, run: Any) -> None:
    ran = run("scan", plane, "--sensor", "psd_line", "--out", tmp_path / "out", "--format=sdf", "--format=sdf-ascii")
    check_refused(ran, r"two formats write range_image\.sdf; give one of them")
    with pytest.raises(ValueError, match="the format is 'stl', expected one of x3p, sur, sdf, sdf-ascii"):
        surface_files(["stl"])
