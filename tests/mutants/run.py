"""Mutation tests: plant faults one at a time, and count the killed ones: ``python tests/mutants/run.py [--help]``.

The faults are the list in ``planted.toml``, which earlier tests did not find, and a random sample of changes in Python
files and kernels. Each fault is planted in a copy of the repository in ``build/mutants``. A record of the fast tier
lists the tests that run its lines. A fault is killed if one of these tests fails or does not end. A fault that breaks
the import of the package, or the build of a kernel, says nothing about the tests and is counted separately.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import random
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests")]

from mutants import record  # noqa: E402
from mutants.faults import Fault, draw_faults, planted_faults  # noqa: E402

_BUDGET = 60.0  # of the tests of one fault [s], by the times of the record
_KERNEL_SHARE = 0.3  # of the sample
_UNBUILT = ("ImportError", "BuildError", "BUILD_PROGRAM_FAILURE", "clBuildProgram")


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[2])
    parser.add_argument("--sample", type=int, default=100, help="number of faults to draw")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="faults tested at the same time")
    parser.add_argument("--record", action="store_true", help="record anew which tests run which lines")
    parser.add_argument("--without-planted", action="store_true", help="test the sample only")
    parser.add_argument("--out", type=Path, default=record.OUT / "report.json", help="report")
    arguments = parser.parse_args()
    if arguments.record or not record.is_recorded():
        record.record_lines()
    planted = [] if arguments.without_planted else planted_faults()
    kernels = round(_KERNEL_SHARE * arguments.sample)
    sample = list(draw_faults(random.Random(arguments.seed), arguments.sample - kernels, kernels))
    rows = _run(planted + sample, arguments.jobs)
    arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
    killed, survived = _summary("planted", rows[: len(planted)]), _summary("sampled", rows[len(planted) :])
    print(f"report: {arguments.out}")
    return int(not (killed and survived))


def _summary(name: str, rows: list[dict[str, str | int]]) -> bool:
    """Print the counts; return whether enough are killed: all planted ones, and 90 % of the sample."""
    counts = {state: sum(row["state"] == state for row in rows) for state in ("killed", "survived", "not built")}
    tried = counts["killed"] + counts["survived"]
    print(f"{name}: {counts['killed']} of {tried} killed, {counts['not built']} not built")
    return counts["killed"] >= (1.0 if name == "planted" else 0.9) * tried


def _run(faults: list[Fault], jobs: int) -> list[dict[str, str | int]]:
    """Test the faults, each in a copy of the repository."""
    trees: queue.Queue[Path] = queue.Queue()
    for number in range(jobs):
        trees.put(_copy(record.OUT / f"tree-{number}"))

    def test(fault: Fault) -> dict[str, str | int]:
        tree = trees.get()
        try:
            row = {**fault.row((ROOT / fault.file).read_text()), **_test(fault, tree)}
        finally:
            trees.put(tree)
        print(f"{row['state']:10} {row['file']}:{row['line']}: {row['after']}", flush=True)
        return row

    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(test, faults))


def _copy(tree: Path) -> Path:
    """Copy the files that git knows; the compiled kernels are shared, the examples of hypothesis are not."""
    shutil.rmtree(tree, ignore_errors=True)
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in names.splitlines():
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name)
    (tree / "build" / "cache").mkdir(parents=True)
    for folder in (ROOT / "build" / "cache").iterdir():
        if folder.name != "hypothesis":
            (tree / "build" / "cache" / folder.name).symlink_to(folder)
    return tree


def _test(fault: Fault, tree: Path) -> dict[str, str | int]:
    """Return the state of a fault, and the test that killed it."""
    tests = list(fault.tests) or record.tests_of(fault, _BUDGET)
    if not tests:
        return {"state": "survived", "by": "no test runs this line"}
    place = tree / fault.file
    text = place.read_text()
    (tree / "build" / "tests.txt").write_text("\n".join(tests))
    place.write_text(fault.planted(text))
    words = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=line", "@build/tests.txt"]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *words],
            cwd=tree,
            env=record.environment(tree),
            capture_output=True,
            text=True,
            timeout=5.0 * _BUDGET,
        )
    except subprocess.TimeoutExpired:
        return {"state": "killed", "by": "a test that does not end"}
    finally:
        place.write_text(text)
    if done.returncode == 0:
        return {"state": "survived", "by": f"{len(tests)} tests"}
    said = (done.stdout + done.stderr).strip().splitlines()
    failed = next((line for line in said if line.startswith(("FAILED", "ERROR"))), said[-1] if said else "")
    if any(word in line for line in said for word in _UNBUILT):
        return {"state": "not built", "by": failed[:200]}
    return {"state": "killed", "by": failed[:200]}


if __name__ == "__main__":
    sys.exit(main())
