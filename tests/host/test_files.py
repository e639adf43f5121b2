"""Files are written whole or not at all."""

from __future__ import annotations

import os

import pytest

from gpuvision.host import files


@pytest.mark.parametrize("old", [None, b"what was there"])
def test_a_failure_leaves_what_was_there(tmp_path, old):
    path = tmp_path / "map.tiff"
    if old is not None:
        path.write_bytes(old)
    before = sorted(os.listdir(tmp_path))

    def write_half() -> None:
        with files.replacing(path) as file:
            file.write(b"half of it")
            assert sorted(os.listdir(tmp_path)) != before
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert sorted(os.listdir(tmp_path)) == before
    assert old is None or path.read_bytes() == old


def test_a_file_is_as_open_to_others_as_any_new_one(tmp_path):
    with files.replacing(tmp_path / "a") as file:
        file.write(b"x")
    (tmp_path / "b").write_bytes(b"x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_written_whole_or_not_at_all(monkeypatch, tmp_path):
    path = tmp_path / "folder" / "file"
    files.write_whole(path, "old")

    def fail(source, target):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        files.write_whole(path, "new")
    assert [each.name for each in path.parent.iterdir()] == ["file"]
    assert path.read_text() == "old"
