"""The examples run as scripts, and each draws its picture."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from built_docs import LIBRARY, ROOT, gallery_picture, newest

FOLDER = ROOT / "examples"
EXAMPLES = sorted(path.name for path in FOLDER.glob("*.py"))
_SAVE = """
import runpy, sys
import matplotlib.pyplot
runpy.run_path(sys.argv[1], run_name="__main__")
assert matplotlib.pyplot.get_fignums(), "the example draws nothing"
"""


def test_examples_are_here() -> None:
    assert len(EXAMPLES) >= 8


@pytest.mark.slow  # each example takes 4 s or more, and `make docs` runs all of them
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_runs(name: str, tmp_path: Path) -> None:
    """`make docs` also runs the examples: an example whose picture is newer than the library is skipped."""
    picture = gallery_picture(name)
    if picture.exists() and picture.stat().st_mtime >= newest(*LIBRARY, f"examples/{name}"):
        pytest.skip("`make docs` ran this example after the last change")
    environment = os.environ | {"MPLBACKEND": "Agg"}
    command = [sys.executable, "-c", _SAVE, str(FOLDER / name)]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
