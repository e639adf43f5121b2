"""HTML documentation: the build of ``make docs`` if it is up to date, otherwise a new build without the examples."""

from __future__ import annotations

import fcntl
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = ("gpuvision", "host", "kernels")
SOURCES = (*LIBRARY, "docs", "profiling/results", "examples", "README.md", "CHANGELOG.md", "CONTRIBUTING.md")
GENERATED = ("docs/gallery", "docs/reference/api", "docs/reference/commands", "docs/results/runs")


def newest(*sources: str) -> float:
    """Return the time of the last change in files and folders of the repository, without generated pages."""
    generated = {ROOT / each for each in GENERATED}
    files = (
        path
        for source in (ROOT / each for each in sources)
        for path in ([source] if source.is_file() else source.rglob("*"))
    )
    return max(
        path.stat().st_mtime
        for path in files
        if path.is_file() and "__pycache__" not in path.parts and not generated & set(path.parents)
    )


def gallery_picture(example: str) -> Path:
    """Return where ``make docs`` puts the picture of an example."""
    return ROOT / "docs" / "gallery" / "images" / f"sphx_glr_{Path(example).stem}_001.png"


def built_docs() -> Path:
    """Return the folder of the HTML pages; build them if they do not exist or a source is newer."""
    if importlib.util.find_spec("sphinx") is None:
        pytest.skip("sphinx is missing; `bash setup.sh docs` installs it")
    made = ROOT / "build" / "docs"
    if _is_current(made):
        return made
    folder = ROOT / "build" / "docs-of-the-tests"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:  # several test processes may build the pages
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _is_current(folder):
            _build(folder)
    return folder


def _is_current(folder: Path) -> bool:
    index = folder / "searchindex.js"
    return index.exists() and index.stat().st_mtime >= newest(*SOURCES)


def _build(folder: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "--fresh-env", "--fail-on-warning", "--keep-going", "--quiet"]
    command += ["-d", str(folder / ".doctrees"), "-D", "plot_gallery=0", "docs", str(folder)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
