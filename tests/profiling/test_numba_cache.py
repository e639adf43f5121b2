"""Cache of compiled peers."""

from __future__ import annotations

import importlib.util
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
