"""Set-up before the ICD loader is used: Intel's wheels, and a cache folder if the home has no cache."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import tempfile
from pathlib import Path, PurePosixPath

import pytest

from gpuvision.host import cache, runtime


@pytest.fixture
def vendors(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Simulate a system with one driver and an installed wheel, and an empty user cache; return the system's folder."""
    system = tmp_path / "system"
    system.mkdir()
    (system / "pocl.icd").write_text("libpocl.so.2\n")
    monkeypatch.setattr(runtime, "SYSTEM_VENDORS", system)
    monkeypatch.setattr(runtime, "_wheel_libraries", lambda: {"libintelocl.so": Path("/wheel/libintelocl.so")})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("OCL_ICD_VENDORS", "")  # removed again after the test
    monkeypatch.delenv("OCL_ICD_VENDORS")
    return system


def _exposed() -> Path:
    runtime.expose_installed_runtime()
    return Path(os.environ["OCL_ICD_VENDORS"])


def test_wheel_stands_beside_the_systems_drivers(vendors: Path) -> None:
    folder = _exposed()
    assert {path.name: path.read_text() for path in folder.iterdir()} == {
        "pocl.icd": "libpocl.so.2\n",
        "gpuvision-intel.icd": "/wheel/libintelocl.so",
    }


def test_folder_follows_the_systems_drivers(vendors: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = _exposed()
    monkeypatch.delenv("OCL_ICD_VENDORS")
    assert _exposed() == first
    (vendors / "nvidia.icd").write_text("libnvidia-opencl.so.1\n")
    monkeypatch.delenv("OCL_ICD_VENDORS")
    second = _exposed()
    assert second != first
    assert (second / "nvidia.icd").exists()


def test_users_own_choice_is_left_alone(vendors: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("OCL_ICD_VENDORS", "/opt/mine")
    monkeypatch.setattr(runtime, "_load_siblings", lambda _: pytest.fail("nothing is to be loaded"))
    assert _exposed() == Path("/opt/mine")
    assert not (tmp_path / "cache").exists()


def test_inherited_folder_still_loads_the_siblings(vendors: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of the probe inherits the variable and also needs the libraries of the driver."""
    folder = _exposed()
    loaded = []
    monkeypatch.setattr(runtime, "_load_siblings", lambda libraries: loaded.append(libraries) or True)
    assert _exposed() == folder
    assert len(loaded) == 1


@pytest.mark.parametrize("libraries", [{}, {"libintelocl.so": Path("/x"), "libimf.so": Path("/not/there/libimf.so")}])
def test_no_usable_wheel_changes_nothing(
    vendors: Path, monkeypatch: pytest.MonkeyPatch, libraries: dict[str, Path]
) -> None:
    monkeypatch.setattr(runtime, "_wheel_libraries", lambda: libraries)
    runtime.expose_installed_runtime()
    assert "OCL_ICD_VENDORS" not in os.environ


def test_system_without_any_driver(vendors: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "SYSTEM_VENDORS", vendors / "not-there")
    assert [path.name for path in _exposed().iterdir()] == ["gpuvision-intel.icd"]


def test_missing_wheel_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise runtime.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(runtime.importlib.metadata, "files", missing)
    assert runtime._wheel_libraries() == {}


def test_home_that_cannot_be_written(vendors: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" / "below"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    cache.provide_cache()
    folder = Path(os.environ["XDG_CACHE_HOME"])
    assert folder.parent == tmp_path
    assert _exposed().is_relative_to(folder)


def test_home_without_space_for_kernels(small_disk: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """PoCL cannot compile where its cache is full."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(small_disk))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    cache.provide_cache()
    assert Path(os.environ["XDG_CACHE_HOME"]).parent == tmp_path / "temporary"
    assert [path for path in small_disk.rglob("*") if path.is_file()] == []


def test_home_that_can_be_written_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "new"))
    cache.provide_cache()
    assert os.environ["XDG_CACHE_HOME"] == str(tmp_path / "new")
    assert list((tmp_path / "new" / "gpuvision").iterdir()) == []


@pytest.mark.parametrize(
    ("entries", "asked"),
    [
        (["libpocl.so.2.10.0"], True),
        (["/usr/lib/libpocl.so.2.9.0\n", "libnvidia-opencl.so.1\n"], True),
        (["libpocl.so.2.10.0", "/opt/lib/libpocl.so.2.14.0"], False),
        (["libpocl.so.2"], False),
        ([], False),
    ],
)
def test_inline_device_is_requested_where_its_name_is_known(
    vendors: Path, monkeypatch: pytest.MonkeyPatch, entries: list[str], asked: bool
) -> None:
    monkeypatch.delenv("POCL_DEVICES", raising=False)
    monkeypatch.setenv("OCL_ICD_VENDORS", str(vendors))
    (vendors / "pocl.icd").unlink()
    for number, text in enumerate(entries):
        (vendors / f"{number}.icd").write_text(text)
    runtime.request_inline_device()
    assert os.environ.get("POCL_DEVICES") == ("pthread basic" if asked else None)
    monkeypatch.setenv("POCL_DEVICES", "pthread")
    runtime.request_inline_device()
    assert os.environ["POCL_DEVICES"] == "pthread", "the user decided"


@pytest.fixture
def cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a machine of four cores without settings of PoCL."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2, 3})
    for name in ("POCL_AFFINITY", *runtime._WORKER_COUNTS):
        monkeypatch.setenv(name, "")  # removed again after the test
        monkeypatch.delenv(name)


def test_workers_are_pinned_unless_the_user_decided(cores: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POCL_AFFINITY", "0")
    runtime.pin_workers()
    assert os.environ["POCL_AFFINITY"] == "0"
    monkeypatch.delenv("POCL_AFFINITY")
    runtime.pin_workers()
    assert os.environ["POCL_AFFINITY"] == "1"


@pytest.mark.parametrize("name", runtime._WORKER_COUNTS)
def test_few_workers_are_not_pinned(cores: None, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """PoCL pins the one worker of each process to the first core."""
    monkeypatch.setenv(name, "1")
    runtime.pin_workers()
    assert "POCL_AFFINITY" not in os.environ


def test_workers_of_a_restricted_process_are_not_pinned(cores: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """PoCL pins worker k to core k, also where the process may not run there."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {2, 3})
    runtime.pin_workers()
    assert "POCL_AFFINITY" not in os.environ


@pytest.mark.parametrize("missing", [None, "intel-opencl-rt", "intel-cmplr-lib-rt", "driver"])
def test_libraries_of_the_wheels_by_name(missing: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver and the libraries that it finds by name only, of both wheels; nothing without one of these."""

    class Packaged(PurePosixPath):
        def locate(self) -> Path:
            return Path("/site") / self

    content = {
        "intel-opencl-rt": ["lib/cl.cfg", "lib/libintelocl.so", "lib/zz.so", "lib/libintelocl.so.2"],
        "intel-cmplr-lib-rt": [
            "lib/libirng.so",
            "lib/libimf.so",
            "lib/libsvml.so",
            "lib/libintlc.so.5",
            "lib/libiomp5.so",
        ],
    }

    def files(wheel: str) -> list[Packaged]:
        if wheel == missing:
            raise importlib.metadata.PackageNotFoundError(wheel)
        return [Packaged(name) for name in content[wheel] if not (missing == "driver" and name.endswith("ocl.so"))]

    monkeypatch.setattr(importlib.metadata, "files", files)
    names = ["libintelocl.so", "libirng.so", "libimf.so", "libsvml.so", "libintlc.so.5"]
    expected = {} if missing else {name: Path("/site/lib", name) for name in names}
    assert runtime._wheel_libraries() == expected


def test_libraries_are_loaded_for_the_whole_process_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[tuple[str, int]] = []
    monkeypatch.setattr(ctypes, "CDLL", lambda name, mode: loaded.append((name, mode)))
    libraries = {name: Path("/lib", name) for name in ("libimf.so", "libintlc.so.5", "libintelocl.so", "libsvml.so")}
    assert runtime._load_siblings(libraries)
    assert loaded == [(f"/lib/{name}", ctypes.RTLD_GLOBAL) for name in ("libintlc.so.5", "libimf.so", "libsvml.so")]


def test_entries_that_cannot_be_read_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.icd").write_text("liba.so")
    (tmp_path / "b.txt").write_text("libb.so")
    (tmp_path / "c.icd").mkdir()
    assert runtime._entries(tmp_path) == {"a.icd": "liba.so"}
    assert runtime._entries(tmp_path / "none") == {}
