"""Mutation tests: plant faults one at a time, and count the killed ones: ``python tests/mutants/run.py [--help]``.

The faults are the list in ``planted.toml``, which earlier tests did not find, and a random sample of changes in Python
files and kernels. Each fault is planted in a copy of the repository in ``build/mutants``. The tests are the fast tier
of the test files of the changed file; with a record of the fast tier, also other tests that run the changed lines.
Planted faults name their tests. ``--sample 0`` tests the planted faults only and needs no record.

A fault is killed if a test fails that passes without the fault. A fault that breaks the import of the package, or the
build of a kernel, says nothing about the tests and is counted separately. A run of tests that does not end counts as
survived: a busy machine must not kill a fault.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests")]

from mutants import order, record  # noqa: E402
from mutants.faults import Fault, draw_faults, planted_faults  # noqa: E402

_BUDGET = 60.0  # for recorded tests of one fault, in addition to its test files [s]; by the times of the record
_TIMEOUT = 900.0  # of all tests of one fault [s]: kernels are compiled anew, and the machine may be busy
_TEST_TIMEOUT = 150.0  # of one test [s]: an endless loop in Python fails the test
_KERNEL_SHARE = 0.3  # of the sample
_OPTIONS = ("-x", "-q", "-p", "no:xdist", "--tb=line", "--tier", "fast", "-p", "mutants.order")
_UNBUILT = ("BuildError", "BUILD_PROGRAM_FAILURE", "clBuildProgram")
_STATES = ("killed", "survived", "did not end", "not built")


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[2])
    parser.add_argument("--sample", type=int, default=100, help="number of faults to draw")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument("--only", nargs="+", default=[""], metavar="START", help="draw files whose paths begin so")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="faults tested at the same time")
    parser.add_argument(
        "--seconds", type=int, default=0, help="limit of the processor time of the tests of a fault [s]; 0: no limit"
    )
    records = parser.add_mutually_exclusive_group()
    records.add_argument("--record", action="store_true", help="record anew which tests run which lines")
    records.add_argument("--no-record", action="store_true", help="run only the test files of the changed file")
    parser.add_argument("--without-planted", action="store_true", help="test the sample only")
    parser.add_argument("--out", type=Path, default=record.OUT / "report.json", help="report")
    arguments = parser.parse_args()
    if arguments.record or not (record.is_recorded() or arguments.no_record or arguments.sample == 0):
        record.record_lines()
    planted = [] if arguments.without_planted else planted_faults()
    rng, only = random.Random(arguments.seed), tuple(arguments.only)
    sample = list(draw_faults(rng, arguments.sample, kernel_share=_KERNEL_SHARE, only=only))
    # In random order: an interrupted run has tested a random part of the sample.
    random.Random(arguments.seed).shuffle(sample)
    budget = 0.0 if arguments.no_record else _BUDGET
    trees = [_Tree(record.OUT / f"tree-{number}", arguments.seconds) for number in range(arguments.jobs)]
    rows = _run(planted + sample, trees, budget, arguments.out)
    killed, survived = _summary("planted", rows[: len(planted)]), _summary("sampled", rows[len(planted) :])
    print(f"report: {arguments.out}")
    return int(not (killed and survived))


def _summary(name: str, rows: list[dict[str, str | int]]) -> bool:
    """Print the counts; return whether enough are killed: all planted ones, and 90 % of the sample."""
    counts = {state: sum(row["state"] == state for row in rows) for state in _STATES}
    tried = len(rows) - counts["not built"]
    others = ", ".join(f"{counts[state]} {state}" for state in _STATES[1:])
    print(f"{name}: {counts['killed']} of {tried} killed ({others})")
    return counts["killed"] >= (1.0 if name == "planted" else 0.9) * tried


def _run(faults: list[Fault], trees: list[_Tree], budget: float, report: Path) -> list[dict[str, str | int]]:
    """Test the faults, each in a copy of the repository; write the report after each fault.

    Tests that fail without a fault kill nothing: their faults are tested again without them.
    """
    rows: list[dict[str, str | int]] = [{"state": "not tested"} for _ in faults]
    left = list(range(len(faults)))
    unsound: set[str] = set()
    while left:
        _run_some(faults, left, trees, budget, rows, report)
        killers = {str(rows[k]["by"]) for k in left if rows[k]["state"] == "killed" and "::" in str(rows[k]["by"])}
        new = trees[0].failing(killers)
        unsound |= new
        for tree in trees:
            tree.omitted = sorted(unsound)
        print(f"{len(killers)} tests killed faults; these fail without a fault: {sorted(new)}", flush=True)
        left = [k for k in left if rows[k]["state"] == "killed" and rows[k]["by"] in new]
    return rows


def _run_some(
    faults: list[Fault],
    chosen: list[int],
    trees: list[_Tree],
    budget: float,
    rows: list[dict[str, str | int]],
    report: Path,
) -> None:
    """Test some of the faults; write their rows."""
    free: queue.Queue[_Tree] = queue.Queue()
    for tree in trees:
        free.put(tree)

    def test(number: int) -> None:
        tree = free.get()
        fault = faults[number]
        try:
            row = {**fault.row((tree.folder / fault.file).read_text()), **tree.test(fault, budget)}
        finally:
            free.put(tree)
        rows[number] = row
        tested = [json.dumps(each, ensure_ascii=False) for each in rows if "file" in each]
        report.write_text("[\n" + ",\n".join(tested) + "\n]\n")
        print(f"{row['state']:11} {row['file']}:{row['line']}: {row['after']}  [{row['by']}]", flush=True)

    with ThreadPoolExecutor(len(trees)) as pool:
        list(pool.map(test, chosen))


class _Tree:
    """Copy of the files that git knows. Compiled kernels are shared: their cache has the kernels' text as key."""

    def __init__(self, folder: Path, seconds: int) -> None:
        self.folder = folder
        self.seconds = seconds  # limit of the processor time of a run of tests [s]; 0: no limit
        self._written = 0  # files written by `_write`
        self.omitted: list[str] = []  # tests that fail without a fault
        shutil.rmtree(folder, ignore_errors=True)
        names = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
        for name in names.splitlines():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
        (folder / "build" / "cache").mkdir(parents=True)
        for cache in (ROOT / "build" / "cache").iterdir():
            # Examples and tests that failed with a fault are not kept.
            if cache.name not in ("hypothesis", "pytest"):
                (folder / "build" / "cache" / cache.name).symlink_to(cache)

    def test(self, fault: Fault, budget: float) -> dict[str, str | int]:
        """Return the state of a fault, and the test that killed it."""
        tests = list(fault.tests) or record.tests_of(fault, budget)
        if not tests:
            return {"state": "survived", "by": "no test runs this line"}
        place = self.folder / fault.file
        text = place.read_text()
        self._write(place, fault.planted(text))
        try:
            status, failed, said = self._pytest(tests)
        except subprocess.TimeoutExpired:
            return {"state": "did not end", "by": " ".join(tests)[:200]}
        finally:
            self._write(place, text)
        if status == 0:
            return {"state": "survived", "by": " ".join(tests)[:200]}
        if status == -signal.SIGXCPU:
            return {"state": "did not end", "by": f"limit of {self.seconds} s"}
        if fault.file.startswith("kernels") and any(word in said for word in _UNBUILT):
            return {"state": "not built", "by": failed[0] if failed else ""}
        if failed:
            return {"state": "killed", "by": failed[0]}
        if status < 0:
            return {"state": "killed", "by": f"the tests end with signal {-status}"}
        if self._pytest(tests, "--collect-only")[0] != 0:
            raise RuntimeError(f"these tests cannot be collected without a fault: {' '.join(tests)}\n{said}")
        return {"state": "not built", "by": said.strip().splitlines()[-1][:200]}

    def _write(self, place: Path, text: str) -> None:
        """Write a file with a later time than before: compiled code of a file with the same time and size stays valid.

        Python compares whole seconds, and a fault that breaks an import ends the tests within a second.
        """
        place.write_text(text)
        self._written += 1
        later = time.time() + 2 * self._written
        os.utime(place, (later, later))

    def failing(self, names: set[str]) -> set[str]:
        """Return the tests that fail without a fault."""
        return set(self._pytest(sorted(names), "--maxfail=0")[1]) if names else set()

    def _pytest(self, tests: list[str], *more: str) -> tuple[int, list[str], str]:
        """Return the exit status, the tests that failed, and the output."""
        omitted = [f"--deselect={name}" for name in self.omitted]
        named = [name for name in tests if "::" not in name or name.partition("::")[0] not in tests]
        (self.folder / "build" / "tests.txt").write_text("\n".join([*named, *omitted]))
        (self.folder / order.LIST).write_text("\n".join(tests))
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *_OPTIONS, f"--timeout={_TEST_TIMEOUT}", *more, "@build/tests.txt"],
            cwd=self.folder,
            env=record.environment(self.folder),
            capture_output=True,
            text=True,
            timeout=_TIMEOUT,
            preexec_fn=self._limit_processor_time,
        )
        said = done.stdout + done.stderr
        lines = [line for line in said.splitlines() if line.startswith(("FAILED ", "ERROR ")) and "::" in line]
        return done.returncode, [line.partition(" ")[2].partition(" - ")[0] for line in lines], said

    def _limit_processor_time(self) -> None:
        if self.seconds:
            resource.setrlimit(resource.RLIMIT_CPU, (self.seconds, self.seconds + 5))


if __name__ == "__main__":
    sys.exit(main())
