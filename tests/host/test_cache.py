"""The cache folder belongs to its user alone; planted files are not used."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fakes import FakePlatform
from gpuvision.host import cache, discovery, runtime
from gpuvision.host.text import printable

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="owners and modes of POSIX")
root = pytest.mark.skipif(sys.platform == "win32" or os.geteuid() != 0, reason="only root gives files away")
NOBODY = 65534


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "gpuvision"


@pytest.fixture
def verdict(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Iterator[Callable[[], str]]:
    """Return the verdict on the only device, which works when it is asked."""
    monkeypatch.setattr(discovery, "platforms", lambda: (FakePlatform(),))
    monkeypatch.setattr(discovery, "_ask_probe", lambda p, d: "")

    def ask() -> str:
        discovery.listed_devices.cache_clear()
        discovery._probed_devices.cache_clear()
        (only,) = discovery.probed_devices()
        return only.reason

    yield ask
    discovery.listed_devices.cache_clear()
    discovery._probed_devices.cache_clear()


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("umask", [0o000, 0o002, 0o022, 0o077])
def test_folder_and_files_are_for_the_user_alone(folder: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        cache.provide_cache()
        cache.write_private(folder / "file", "text")
        cache.private_folder(folder / "vendors" / "x", {"a.icd": "liba.so"})
    finally:
        os.umask(before)
    assert (mode(folder.parent), mode(folder)) == (0o700, 0o700)
    assert mode(folder / "file") == 0o600
    assert cache.read_private(folder / "file") == "text"
    assert (mode(folder / "vendors" / "x"), mode(folder / "vendors" / "x" / "a.icd")) == (0o700, 0o600)
    assert mode(folder / "vendors") == 0o700


def test_a_folder_that_another_process_makes_meanwhile_is_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other process may be loading the drivers of its folder: it is never removed, also for a moment."""
    entries, own_write = {"a.icd": "liba.so"}, cache.write_private
    vendors = folder / "vendors" / "x"

    def slow_write(path: Path, text: str) -> None:
        own_write(path, text)
        own_write(vendors / path.name, text)  # the other process is faster

    monkeypatch.setattr(cache, "write_private", slow_write)
    monkeypatch.setattr(cache, "_remove", lambda path: pytest.fail(f"{path.name} is removed"))
    assert cache.private_folder(vendors, entries) == vendors
    assert [each.name for each in vendors.parent.iterdir()] == ["x"]


def test_an_open_folder_is_closed_and_a_writable_one_emptied(folder: Path) -> None:
    (folder / "vendors").mkdir(parents=True)
    (folder / "devices.json").write_text("{}")
    folder.chmod(0o755)
    cache.provide_cache()
    assert mode(folder) == 0o700
    assert (folder / "devices.json").exists()
    folder.chmod(0o777)
    cache.provide_cache()
    assert mode(folder) == 0o700
    assert list(folder.iterdir()) == []


@root
def test_the_folder_of_another_user_is_not_used(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir(parents=True)
    os.chown(folder, NOBODY, NOBODY)
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path))
    cache.provide_cache()
    assert Path(os.environ["XDG_CACHE_HOME"]).parent == tmp_path
    assert cache.cache_folder() != folder
    assert list(folder.iterdir()) == []


def test_a_relative_cache_home_is_ignored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    cache.provide_cache()
    assert "XDG_CACHE_HOME" not in os.environ
    assert not (tmp_path / "relative").exists()
    assert cache.cache_folder().is_relative_to(tmp_path)
    assert cache.cache_folder().is_dir()


@pytest.mark.parametrize("plant", ["file", "content", "link", "writable", "folder"])
def test_a_planted_driver_is_not_loaded(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: str
) -> None:
    system = tmp_path / "system"
    system.mkdir()
    monkeypatch.setattr(runtime, "SYSTEM_VENDORS", system)
    monkeypatch.setattr(runtime, "_wheel_libraries", lambda: {"libintelocl.so": Path("/wheel/libintelocl.so")})
    monkeypatch.setenv("OCL_ICD_VENDORS", "")  # removed again after the test
    monkeypatch.delenv("OCL_ICD_VENDORS")
    runtime.expose_installed_runtime()
    vendors = Path(os.environ["OCL_ICD_VENDORS"])
    entry = vendors / "gpuvision-intel.icd"
    evil = tmp_path / "evil.icd"
    evil.write_text("/tmp/evil.so")
    if plant == "file":
        (vendors / "evil.icd").write_text("/tmp/evil.so")
    elif plant == "content":
        entry.write_text("/tmp/evil.so")
    elif plant == "link":
        entry.unlink()
        evil.write_text("/wheel/libintelocl.so")  # the owner of the target may change it later
        entry.symlink_to(evil)
    elif plant == "writable":
        entry.chmod(0o666)
    else:
        entry.unlink()
        vendors.rmdir()
        evil.unlink()
        evil.mkdir()
        (evil / entry.name).write_text("/wheel/libintelocl.so")
        vendors.symlink_to(evil)
    monkeypatch.delenv("OCL_ICD_VENDORS")
    runtime.expose_installed_runtime()
    assert Path(os.environ["OCL_ICD_VENDORS"]) == vendors
    assert not vendors.is_symlink()
    assert [each.name for each in vendors.iterdir()] == [entry.name]
    assert (entry.read_text(), entry.is_symlink(), mode(entry)) == ("/wheel/libintelocl.so", False, 0o600)
    assert [each.name for each in vendors.parent.iterdir()] == [vendors.name]


def plant_verdict(folder: Path, text: str) -> Path:
    file = folder / "devices.json"
    known = json.loads(file.read_text())
    file.write_text(json.dumps(dict.fromkeys(known, text)))
    return file


def test_own_verdicts_are_kept_and_their_text_is_one_printable_line(folder: Path, verdict: Callable[[], str]) -> None:
    assert verdict() == ""
    plant_verdict(folder, "broken\n\x1b[31mred\x1b[0m \x1b]0;title\x07and\x9b2J \u202eback" + "x" * 10_000)
    reason = verdict()
    assert reason.startswith("broken red and?2J ?backxxx")
    assert len(reason) == 500


@pytest.mark.parametrize("plant", ["writable", "link", pytest.param("foreign", marks=root)])
def test_planted_verdicts_are_not_used(folder: Path, tmp_path: Path, verdict: Callable[[], str], plant: str) -> None:
    assert verdict() == ""
    file = plant_verdict(folder, "planted")
    assert verdict() == "planted", "the user's own file counts"
    if plant == "writable":
        file.chmod(0o666)
    elif plant == "link":
        file.rename(tmp_path / "elsewhere")
        file.symlink_to(tmp_path / "elsewhere")
    else:
        os.chown(file, NOBODY, NOBODY)
    assert verdict() == ""


def test_a_huge_or_nested_verdict_file_is_not_read(folder: Path, verdict: Callable[[], str]) -> None:
    assert verdict() == ""
    for content in ("[" * 100_000, '{"a": "' + "x" * (1 << 21) + '"}', "\udcff"):
        (folder / "devices.json").write_bytes(content.encode(errors="surrogateescape"))
        assert verdict() == ""


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain µm, 25°\n\tline", "plain µm, 25°\n\tline"),
        ("\x1b[1;31mred\x1b[0m", "red"),
        ("\x1b]8;;http://x\x1b\\link\x1b]8;;\x07", "link"),
        ("\x1bc\x1b(Breset", "reset"),
        ("bell\x07 back\x08 delete\x7f return\r", "bell? back? delete? return?"),
        ("name\udc80", "name?"),
        ("\x1b", "?"),
    ],
)
def test_printable(text: str, shown: str) -> None:
    assert printable(text) == shown
    shown.encode()


def test_names_of_a_driver_are_printable() -> None:
    handle = FakePlatform("P\x1b[2Jlatform").devices[0]
    listed = discovery.ListedDevice("x", "x", 0, 0, handle, "", None)
    assert listed.platform == "Platform"


def test_the_import_ignores_a_relative_cache_folder(tmp_path: Path) -> None:
    """pyopencl makes its cache folder when it is imported."""
    code = "import os, gpuvision.host; print(os.environ.get('XDG_CACHE_HOME'))"
    environment = os.environ | {"XDG_CACHE_HOME": "relative"}
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path, env=environment)
    assert ran.stdout == "None\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("rights", "is_private"), [(0o600, True), (0o644, True), (0o620, False), (0o602, False)])
def test_a_file_that_others_may_write_is_not_private(tmp_path: Path, rights: int, is_private: bool) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("text")
    file.chmod(rights)
    link.symlink_to(file)
    assert cache.is_private(file) == is_private
    assert cache.read_private(file) == ("text" if is_private else None)
    assert not cache.is_private(link)
    assert not cache.is_private(tmp_path / "none")
    assert cache.is_private(tmp_path) == (not tmp_path.stat().st_mode & 0o022)


def test_a_private_file_has_at_most_the_bytes_that_are_asked_for(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"12345")
    file.chmod(0o600)
    assert cache.read_private_bytes(file, 5) == b"12345"
    assert cache.read_private_bytes(file, 4) is None
    file.write_bytes(b"\xff\xfe")
    assert cache.read_private(file) is None  # no text


def test_a_folder_that_cannot_be_made_private_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "_holds", lambda *_: False)
    with pytest.raises(PermissionError, match="entries cannot be made private; remove it"):
        cache.private_folder(folder / "entries", {"a": "1"})
    assert [each.name for each in folder.iterdir()] == ["entries"]
