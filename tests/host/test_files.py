"""Files and folders are written completely or not at all."""

from __future__ import annotations

import errno
import io
import os
import resource
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gpuvision.host import files


@pytest.mark.parametrize("old", [None, b"what was there"])
def test_a_failure_leaves_what_was_there(tmp_path, old):
    path = tmp_path / "map.tiff"
    if old is not None:
        path.write_bytes(old)
    before = sorted(os.listdir(tmp_path))

    def write_half() -> None:
        with files.atomic_write(path, overwrite=True) as file:
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
        files.write_text_atomic(path, "new", overwrite=True)
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
        files.write_text_atomic(tmp_path / "link", text, overwrite=True)
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


def test_an_existing_file_is_replaced_only_on_request(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("a user's")
    with pytest.raises(FileExistsError, match=f"cannot write {path}: the file exists"):
        files.write_text_atomic(path, "ours")
    assert path.read_text() == "a user's"
    files.write_text_atomic(path, "ours", overwrite=True)
    assert path.read_text() == "ours"


def test_a_failure_while_files_move_restores_the_replaced_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    (out / "b").mkdir(parents=True)
    for name in ("b/2", "c"):
        (out / name).write_text("old")
    (tmp_path / "elsewhere").write_text("old")
    (out / "a").symlink_to(tmp_path / "elsewhere")
    moved, replace = [], os.replace

    def fail_at_the_third(source: Path, target: Path) -> None:
        if Path(source).read_text() == "new":
            moved.append(target)
            if len(moved) == 3:
                raise OSError(5, "Input/output error")
        replace(source, target)

    def write() -> None:
        with files.atomic_folder(out) as inside:
            for name in ("a", "b/1", "b/2", "c", "new/3"):
                (inside / name).parent.mkdir(exist_ok=True)
                (inside / name).write_text("new")

    monkeypatch.setattr(os, "replace", fail_at_the_third)
    with pytest.raises(OSError, match="Input/output error"):
        write()
    assert len(moved) == 3
    assert {str(each.relative_to(out)): each.read_text() for each in out.rglob("*") if each.is_file()} == {
        "a": "old",
        "b/2": "old",
        "c": "old",
    }
    assert sorted(each.name for each in out.iterdir()) == ["a", "b", "c"]
    assert (out / "a").is_symlink()


KILLED = """
import sys, time
from gpuvision.host import files
with files.atomic_folder(sys.argv[1]) as inside, files.atomic_write(sys.argv[2]) as file:
    (inside / "half").write_text("x")
    print("writing", flush=True)
    time.sleep(60)
"""


def test_what_a_killed_process_left_goes_with_the_next_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", KILLED, str(out), str(tmp_path / "file")]
    foreign = [tmp_path / ".gpuvision.part", tmp_path / ".file.0123abcd.part", tmp_path / "x.gpuvision.0123abcd.part"]
    for each in foreign:
        each.write_text("of another program")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as ran:
        assert ran.stdout is not None
        assert ran.stdout.readline() == "writing\n"
        left = set(tmp_path.glob(".gpuvision.????????.part"))
        assert len(left) == 3  # a file, a folder of new files, a folder of replaced files
        files.write_text_atomic(tmp_path / "other", "while it lives")
        assert left == set(tmp_path.glob(".gpuvision.????????.part"))
        ran.kill()
    assert left == set(tmp_path.glob(".gpuvision.????????.part"))
    files.write_text_atomic(tmp_path / "other", "after its death", overwrite=True)
    assert {each.name for each in tmp_path.iterdir()} == {"other", *(each.name for each in foreign)}


def test_a_full_disk_is_named_with_wanted_and_free_bytes(small_disk: Path) -> None:
    (small_disk / "old").write_bytes(bytes(8192))

    def write(size: int) -> None:
        with files.atomic_write(small_disk / "file") as file:
            for _ in range(size // 1000):
                file.write(bytes(1000))

    with pytest.raises(files.DiskFullError) as raised:
        write(200_000)
    assert (raised.value.wanted, raised.value.free) == (200_000, 65536 - 8192)
    assert raised.value.filename == str(small_disk / "file")
    assert raised.value.strerror == f"disk full: 200000 bytes or more wanted, {65536 - 8192} bytes free"
    assert [each.name for each in small_disk.iterdir()] == ["old"]
    write(50_000)
    assert (small_disk / "file").stat().st_size == 50_000


def test_a_folder_that_does_not_fit_leaves_nothing(small_disk: Path) -> None:
    out = small_disk / "deep" / "out"

    def write() -> None:
        with files.atomic_folder(out) as inside:
            files.write_text_atomic(inside / "first", "x" * 40_000)
            files.write_text_atomic(inside / "second", "x" * 50_000)

    with pytest.raises(files.DiskFullError) as raised:
        write()
    assert (raised.value.wanted, raised.value.filename) == (90_000, str(out / "second"))
    assert raised.value.free > 60_000
    assert list(small_disk.iterdir()) == []


def test_a_full_disk_of_every_kind_of_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seeking writers, such as the writers of ZIP and TIFF, continue to count; a quota counts as a disk."""

    def full(_: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(os, "fsync", full)

    def write() -> None:
        with files.atomic_write(tmp_path / "a.npz") as file:
            np.savez(file, a=np.zeros(100_000), b=np.zeros(7))

    with pytest.raises(files.DiskFullError) as raised:
        write()
    plain = io.BytesIO()
    np.savez(plain, a=np.zeros(100_000), b=np.zeros(7))
    assert raised.value.wanted == len(plain.getvalue())
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def small_files() -> Iterator[None]:
    """Let this process write files of at most 64 KiB, as a file system with a largest file does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.usefixtures("small_files")
@pytest.mark.parametrize("is_direct", [False, True])
def test_a_file_that_is_too_large_is_named(tmp_path: Path, is_direct: bool) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "large").write_text("old")

    def write() -> None:
        with files.atomic_folder(out) as inside:
            if is_direct:  # as Matplotlib and Pillow write
                (inside / "large").write_bytes(bytes(70_000))
            with files.atomic_write(inside / "large") as file:
                file.write(bytes(70_000))

    with pytest.raises(OSError, match="larger than the file system or the limit of the process") as raised:
        write()
    named = out if is_direct else out / "large"  # the system names no file
    assert (raised.value.errno, raised.value.filename) == (errno.EFBIG, str(named))
    assert [(each.name, each.read_text()) for each in out.iterdir()] == [("large", "old")]
    with pytest.raises(OSError, match="larger than the file system") as raised, files.atomic_write(out / "new") as file:
        file.write(bytes(70_000))
    assert raised.value.filename == str(out / "new")


def test_an_error_names_the_final_file_and_not_the_temporary_one(tmp_path: Path) -> None:
    def write() -> None:
        with files.atomic_folder(tmp_path / "out") as inside:
            (inside / "missing" / "file").write_text("x")

    with pytest.raises(FileNotFoundError) as raised:
        write()
    assert raised.value.filename == str(tmp_path / "out" / "missing" / "file")


def test_a_full_device_is_named() -> None:
    with pytest.raises(OSError, match="No space left") as raised, files.atomic_write("/dev/full") as file:
        file.write(b"x")
    assert raised.value.filename == "/dev/full"


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("fails_at", [1, 2, 3, 4, None])
def test_a_move_that_fails_restores_every_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool, fails_at: int | None
) -> None:
    """New and replaced files and folders; also on a file system without hard links."""
    out = tmp_path / "out"
    (out / "b").mkdir(parents=True)
    (out / "a").write_text("old a")
    (out / "b" / "c").write_text("old c")
    replace, count = os.replace, [0]

    def sometimes(source: Path, target: Path) -> None:
        if ".gpuvision." in str(source) and Path(source).name in ("a", "c", "d", "f"):
            count[0] += 1
            if count[0] == fails_at:
                raise OSError("no more")
        replace(source, target)

    def refuse(*_: object, **__: object) -> None:
        raise OSError("no hard links here")

    if not links:
        monkeypatch.setattr(os, "link", refuse)
    new = {"a": "new a", "b/c": "new c", "b/d": "new d", "e/f": "new f"}

    def write() -> None:
        with files.atomic_folder(out) as inside:
            for name, text in new.items():
                (inside / name).parent.mkdir(exist_ok=True)
                (inside / name).write_text(text)

    monkeypatch.setattr(os, "replace", sometimes)
    old = {"a": "old a", "b/c": "old c"}
    if fails_at is None:
        write()
    else:
        with pytest.raises(OSError, match="no more"):
            write()
    found = {str(each.relative_to(out)): each.read_text() for each in out.rglob("*") if each.is_file()}
    assert found == (new if fails_at is None else old)
    assert (out / "e").exists() == (fails_at is None)
    assert [each.name for each in tmp_path.iterdir()] == ["out"]


def test_temporaries_of_a_process_are_removed_before_it_ends(tmp_path: Path) -> None:
    (tmp_path / "unrelated").write_text("stays")
    with files._temporary(tmp_path, Path.mkdir) as folder, files._temporary(tmp_path, Path.touch):
        (folder / "a").write_text("half")
        assert len(list(tmp_path.iterdir())) == 3
        files.remove_temporaries()
        assert [each.name for each in tmp_path.iterdir()] == ["unrelated"]
    assert not files._live
