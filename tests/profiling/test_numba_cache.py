"""Cache of compiled peers."""

from __future__ import annotations

import importlib.util
import os
import time
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

import numba

from gpuvision.profiling import numba_cache


def test_a_loop_is_compiled_once_for_each_state_of_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "peer.py"
    path.write_text("import numba\n\n@numba.njit\ndef twice(x):\n    return 2.0 * x\n")
    monkeypatch.setattr(numba_cache, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)

    def hits() -> int:
        spec = importlib.util.spec_from_file_location("peer", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        numba_cache.keep_compiled(module)
        assert module.twice(1.5) == 3.0
        return sum(module.twice.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    monkeypatch.setattr(numba_cache, "_sources_hash", lambda: "other")
    assert hits() == 0
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_the_hash_depends_on_every_source_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba_cache, "__file__", str(tmp_path / "numba_cache.py"))
    found = []
    for name, text in (("a.py", "1"), ("b.py", "1"), ("a.py", "2"), ("note.txt", "1"), ("a.py", "1")):
        (tmp_path / name).write_text(text)
        found.append(numba_cache._sources_hash())
    assert len(set(found)) == 3
    assert found[2] == found[3]  # not a source
    assert found[1] == found[4]


def test_folders_that_no_run_has_used_for_30_days_are_removed(tmp_path: Path) -> None:
    for name, days in (("numba-old", 31), ("numba-new", 29), ("numba-mine", 40), ("programs", 40)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").touch()
        then = time.time() - 86400.0 * days
        os.utime(tmp_path / name, (then, then))
    numba_cache._remove_old_siblings(tmp_path / "numba-mine")
    assert {each.name for each in tmp_path.iterdir()} == {"numba-new", "numba-mine", "programs"}
