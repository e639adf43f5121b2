"""Cache of parsed artwork: equal to freshly parsed artwork, private, verified, of limited size."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from boards import LAYERS, board_folder
from gpuvision.matching.artwork import artwork as reader
from gpuvision.matching.artwork import artwork_cache
from gpuvision.matching.artwork.artwork import Artwork, read_artwork

RINGS = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\n%ADD10C,2X1*%\n%ADD11C,0.4*%\nD10*\nX5000000Y5000000D03*\n%LPC*%\nD11*\n" + (
    "X9000000Y5000000D03*\nM02*\n"
)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the entries in an empty cache; every board is stored, also a small one."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(reader, "_MIN_CACHED", 0.0)
    return tmp_path / "home" / "gpuvision" / "artwork"


@pytest.fixture
def board(tmp_path: Path) -> Path:
    folder = tmp_path / "board"
    folder.mkdir()
    return board_folder(folder)


def check_equal(one: object, other: object) -> None:
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    elif isinstance(one, tuple):
        assert isinstance(other, tuple)
        for each, also in zip(one, other, strict=True):
            check_equal(each, also)
    elif hasattr(one, "__dict__"):
        assert vars(one).keys() == vars(other).keys()
        for key, value in vars(one).items():
            check_equal(value, vars(other)[key])
    else:
        np.testing.assert_equal(one, other)


def never_parse(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> Artwork:
        raise AssertionError("the board is parsed again")

    monkeypatch.setattr(reader, "_parse_artwork", fail)


def entries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*"))


def test_second_reading_does_not_parse(board: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = read_artwork(board, layers=LAYERS)
    (entry,) = entries(cache)
    assert entry.stat().st_mode & 0o777 == 0o600
    assert cache.stat().st_mode & 0o777 == 0o700
    never_parse(monkeypatch)
    check_equal(read_artwork(board, layers=LAYERS), first)
    elsewhere = shutil.copytree(board, board.parent / "moved")
    check_equal(read_artwork(elsewhere, layers=LAYERS), first)


def test_holes_of_shapes_and_words_of_pads_are_kept(board: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (board / "copper.gbr").write_text(RINGS.replace("D10*", "%TO.N,GND \u00b5*%\nD10*", 1), encoding="utf-8")
    first = read_artwork(board, layers={r"copper\.gbr": "top copper"})
    assert [len(each.holes) for each in first.copper] == [1, 0]
    assert [each.dark for each in first.copper] == [True, False]
    assert first.pads[0].net == "GND \u00b5"
    assert first.warnings
    never_parse(monkeypatch)
    check_equal(read_artwork(board, layers={r"copper\.gbr": "top copper"}), first)


@pytest.mark.realdata
def test_real_board_comes_back_bit_by_bit(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = read_artwork(data / "gerber" / "upverter", side="bottom")
    never_parse(monkeypatch)
    check_equal(read_artwork(data / "gerber" / "upverter", side="bottom"), first)


def test_all_that_the_artwork_depends_on_is_in_the_key(
    board: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_artwork(board, layers=LAYERS)
    renamed = {name: each for name, each in LAYERS.items() if name != "mask.gbr"}
    for count, change in enumerate(({"clearance": 60e-6}, {"via_drill": 1e-3}, {"layers": renamed}), 2):
        read_artwork(board, **({"layers": LAYERS} | change))
        assert len(entries(cache)) == count
    copper = board / "copper.gbr"
    copper.write_text(copper.read_text().replace("C,0.5*", "C,0.6*"))
    assert read_artwork(board, layers=LAYERS).edges.width.max() == pytest.approx(1.2e-3)
    assert len(entries(cache)) == 5
    monkeypatch.setattr(artwork_cache, "_code_digest", lambda: "another parser")
    read_artwork(board, layers=LAYERS)
    monkeypatch.setenv("GPUVISION_MAX_BOARD_OBJECTS", "1000")
    read_artwork(board, layers=LAYERS)
    assert len(entries(cache)) == 7


def test_code_digest_is_of_the_sources(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A changed source file of the parser, or another version of gerbonara, makes another key."""
    digest = artwork_cache._code_digest.__wrapped__
    now = digest()
    monkeypatch.setattr(artwork_cache, "version", lambda _: "0.0")
    assert digest() != now
    monkeypatch.undo()
    sources = shutil.copytree(Path(artwork_cache.__file__).parent, tmp_path / "sources")
    monkeypatch.setattr(artwork_cache, "__file__", str(sources / "artwork_cache.py"))
    assert digest() == now
    with (sources / "shapes.py").open("a") as file:
        file.write("# changed\n")
    assert digest() != now


@pytest.mark.parametrize("damage", ["changed", "truncated", "emptied", "writable", "linked"])
def test_an_entry_that_is_not_trusted_is_made_again(board: Path, cache: Path, damage: str) -> None:
    first = read_artwork(board, layers=LAYERS)
    (entry,) = entries(cache)
    content = entry.read_bytes()
    if damage == "writable":
        entry.chmod(0o666)
    elif damage == "linked":
        other = cache.parent / "elsewhere.bin"
        entry.rename(other)
        entry.symlink_to(other)
    else:
        changed = bytearray(content)
        changed[-40] ^= 1
        entry.write_bytes({"changed": bytes(changed), "truncated": content[:-1], "emptied": b""}[damage])
    assert artwork_cache.load_artwork(entry.stem) is None
    check_equal(read_artwork(board, layers=LAYERS), first)
    assert entry.is_file()
    assert not entry.is_symlink()
    assert entry.stat().st_mode & 0o777 == 0o600
    assert artwork_cache.load_artwork(entry.stem) is not None


def test_a_folder_that_others_may_write_is_not_used(board: Path, cache: Path) -> None:
    read_artwork(board, layers=LAYERS)
    (entry,) = entries(cache)
    cache.chmod(0o777)
    assert artwork_cache.load_artwork(entry.stem) is None


def test_size_of_the_folder_is_the_documented_one() -> None:
    text = (Path(__file__).parents[3] / "docs" / "reference" / "environment.md").read_text()
    assert f"The folder `artwork` has at most {artwork_cache._MAX_BYTES // 2**20} MiB" in text


def test_oldest_entries_are_removed(board: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_artwork(board, layers=LAYERS)
    (first,) = entries(cache)
    size = first.stat().st_size
    monkeypatch.setattr(artwork_cache, "_MAX_BYTES", 5 * size)
    for number in range(8):
        for age, each in enumerate(sorted(cache.glob("*"), key=lambda path: -path.stat().st_mtime)):
            os.utime(each, (1e9 - age, 1e9 - age))
        read_artwork(board, layers=LAYERS)  # used again: it stays
        read_artwork(board, layers=LAYERS, clearance=(60 + number) * 1e-6)
    left = entries(cache)
    assert first in left
    assert 3 <= len(left) <= 5
    assert sum(each.stat().st_size for each in left) <= 5 * size


def test_a_cache_that_cannot_be_written_is_no_error(
    board: Path, tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "home").write_text("a file, no folder")
    assert read_artwork(board, layers=LAYERS).edges.width.size
    assert read_artwork(board, layers=LAYERS).edges.width.size
