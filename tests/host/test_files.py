"""Files and folders are written completely or not at all."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from gpuvision.host import files


@pytest.mark.parametrize("old", [None, b"what was there"])
def test_a_failure_leaves_what_was_there(tmp_path, old):
    path = tmp_path / "map.tiff"
    if old is not None:
        path.write_bytes(old)
    before = sorted(os.listdir(tmp_path))

    def write_half() -> None:
        with files.atomic_write(path) as file:
            file.write(b"half of it")
            assert sorted(os.listdir(tmp_path)) != before
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert sorted(os.listdir(tmp_path)) == before
    assert old is None or path.read_bytes() == old


def test_a_file_is_as_open_to_others_as_any_new_one(tmp_path):
    with files.atomic_write(tmp_path / "a") as file:
        file.write(b"x")
    (tmp_path / "b").write_bytes(b"x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_written_whole_or_not_at_all(monkeypatch, tmp_path):
    path = tmp_path / "folder" / "file"
    files.write_text_atomic(path, "old")

    def fail(source, target):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        files.write_text_atomic(path, "new")
    assert [each.name for each in path.parent.iterdir()] == ["file"]
    assert path.read_text() == "old"


def half_way(out: Path) -> None:
    with files.atomic_folder(out) as inside:
        (inside / "first").write_text("new")
        (inside / "nowhere" / "second").write_text("new")


def test_a_folder_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with pytest.raises(FileNotFoundError):
        half_way(out)
    assert list(tmp_path.iterdir()) == []
    out.mkdir(parents=True)
    (out / "first").write_text("old")
    (out / "other").write_text("stays")
    with pytest.raises(FileNotFoundError):
        half_way(out)
    assert (out / "first").read_text() == "old"
    with files.atomic_folder(out) as inside:
        (inside / "first").write_text("new")
        (inside / "sub").mkdir()
        (inside / "sub" / "third").write_text("3")
    assert {each.name: each.read_text() for each in out.rglob("*") if each.is_file()} == {
        "first": "new",
        "other": "stays",
        "third": "3",
    }
    assert [each.name for each in out.parent.iterdir()] == ["out"]


def two_files(out: Path) -> None:
    with files.atomic_folder(out) as inside:
        (inside / "first").write_text("new")
        (inside / "sub").mkdir()
        (inside / "sub" / "second").write_text("new")


def test_a_file_in_the_way_of_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "sub").write_text("old")
    with pytest.raises(NotADirectoryError, match=r"cannot write into .*sub: it is a file"):
        two_files(out)
    assert [(each.name, each.read_text()) for each in out.iterdir()] == [("sub", "old")]
    assert [each.name for each in tmp_path.iterdir()] == ["out"]


def test_a_link_stays_and_leads_to_the_new_file(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere" / "file")
    for text in ("a", "b"):
        files.write_text_atomic(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "elsewhere" / "file").read_text() == text


def test_a_pipe_is_written_into(tmp_path: Path) -> None:
    """A pipe or device file is written in place: replacing it would remove it."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with files.atomic_write(pipe) as file:
        file.write(b"told")
    assert os.read(reader, 10) == b"told"
    os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
