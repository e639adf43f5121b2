"""Devices, tiers and caches of the tests. Without an OpenCL device, tests that need one fail.

The option ``--tier`` selects the tests. ``fast`` runs all tests without the mark ``slow`` on the best device, and a
smoke set on every other device: one test for each kernel. Of tests with several parameters it runs a covering design,
of both variants of a kernel a few tests for each file, and of hypothesis tests fewer examples, see `tiers`.
``full`` runs all tests on the best device, and a covering design of products of kernel tests; on every other device it
runs no slow tests, and smaller designs. ``nightly`` runs all tests and all cases on every device, also those with the
mark ``nightly``, with more hypothesis examples.
``GPUVISION_DEVICE`` selects the best device, see `Device.best`.

The option ``--one-case`` reduces the fast and the full tier to the best device, and to one case of each test function
of kernels, of code that kernels share, and of ``tests/host``. Expected failures do not run then: their kernels take
minutes to compile.

No tier runs the cases that a device refuses: double precision without doubles, vectors on a runtime without them. The
last lines of a run state their number. Of cases that PoCL or Intel's CPU runtime refuses, one runs alone and fails.
"""

from __future__ import annotations

import gc
import os

# Before NumPy loads BLAS: its threads poll, so that small matrices take five times the processor time, and the workers
# of pytest-xdist and the subprocesses slow each other down.
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
# Collected tests are a million objects, which stay. The garbage collector starts in `pytest_collection_finish`.
gc.disable()

# ruff: noqa: E402
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import hypothesis
import hypothesis.configuration
import numpy as np
import pytest

from driver_faults import mark_faults
from gpuvision.host import Device, debug
from gpuvision.host.discovery import INSTALL_HINT
from processor_time import record_test, table_of_files
from tiers import (
    LEFT,
    best_devices,
    device_of,
    has_one_case,
    is_refused,
    one_case_each,
    refusal_message,
    select_fast,
    select_full,
    split_refused,
    unexpected_refusal,
)

ROOT = Path(__file__).resolve().parents[1]
# Compiled kernels of all runtimes, verdicts of devices, fonts of matplotlib: kept in the clone, so that a second run is
# warm and nothing is written in the home. Each of these folders is read when it is first needed, after this line.
CACHE = ROOT / "build" / "cache"
os.environ |= {"XDG_CACHE_HOME": str(CACHE), "MPLCONFIGDIR": str(CACHE / "matplotlib")}
# Launches as described by the operations, whatever `gpuvision tune` has kept.
os.environ["GPUVISION_TUNING"] = "off"
hypothesis.configuration.set_hypothesis_home_dir(CACHE / "hypothesis")

LEFT_COUNTS = pytest.StashKey[dict[str, int]]()
REFUSED_COUNTS = pytest.StashKey[dict[str, int]]()
# Full garbage collections of the process when its objects were last frozen.
FULL_COLLECTIONS = pytest.StashKey[int]()
WITHOUT_INLINE = pytest.StashKey[bool]()
TIERS = ("fast", "full", "nightly")
Draws = Callable[..., int]
"""Type of the fixture ``draws``."""
# Factor on the examples of every hypothesis test by tier. The fast tier draws 10 at least, or all of fewer.
EXAMPLES = {"fast": 0.3, "full": 1, "nightly": 20}
LEAST_EXAMPLES = 10
# New draws in every run; a failure prints how to repeat it. No deadline: a busy machine must not fail a test.
hypothesis.settings.register_profile("unhurried", deadline=None, print_blob=True)
hypothesis.settings.load_profile("unhurried")

# Folders of tests that run whole commands, which draw pictures.
_FOLDERS_OF_COMMANDS = ("cli", "docs", "workflows")

DATA = ROOT.parent / "shared" / "data"
HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")
# Reasons of skips that are expected with all extras and both CPU runtimes; ``--strict-skips`` fails on other reasons.
_NO_DATA = "the recordings in ../shared/data are not here"
_NO_HUGE_PAGES = "the system has no huge pages"
ALLOWED_SKIPS = (
    *(() if DATA.is_dir() else (_NO_DATA,)),
    *(() if HUGE_PAGES.exists() else (_NO_HUGE_PAGES,)),
    "`make docs` ran this example after the last change",
    "only PoCL 3 has such a device",
    "only Intel's runtime does so by the work's groups",
    "only workers of PoCL wake slowly",
    "no Chromium here (Debian package chromium)",
    "only root mounts a small file system",
    "only root gives files away",
    "rusticl does not share memory with the host",
    "rusticl does not share memory with the host; events of copies order the slots there",
    "rusticl has no inline queues",
    "positions are floats on rusticl",
    "Mesa's group limit of a kernel is not read (host/limits.py)",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--tier", choices=TIERS, default="full", help="which tests run: see tests/conftest.py")
    parser.addoption(
        "--one-case",
        action="store_true",
        help="one case of each test function of kernels and shared code, on one device",
    )
    parser.addoption("--strict-skips", action="store_true", help="fail when a test is skipped for an unexpected reason")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import the files without tests of the option ``--one-case``."""
    is_left = config.getoption("one_case") and collection_path.is_file() and not has_one_case(collection_path)
    return True if is_left else None


@pytest.hookimpl(trylast=True)  # after -m and -k: the smoke set is selected from the remaining tests
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests that the tier omits; draw the tier's number of hypothesis examples."""
    tier = config.getoption("tier")
    items[:], refused = split_refused(items)
    unexpected = unexpected_refusal(refused)
    if unexpected is not None:
        items[:] = [unexpected]  # fails in `pytest_runtest_setup`: an error of a worker's collection may get lost
        return
    try:
        best = best_devices()
    except pytest.UsageError as error:
        if hasattr(config, "workerinput"):  # pytest-xdist prints other errors of a worker, not this one
            raise RuntimeError(str(error)) from error
        raise
    if refused:
        config.hook.pytest_deselected(items=refused)
        devices = [device for device in map(device_of, refused) if device is not None]
        config.stash[REFUSED_COUNTS] = dict(Counter(device.label for device in devices))
    mark_faults(items, run=not config.getoption("one_case"))
    _set_examples(items, EXAMPLES[tier])
    if tier == "nightly":
        return
    selection = (select_fast if tier == "fast" else select_full)(items, best)
    chosen, left, without_inline = one_case_each(selection, best) if config.getoption("one_case") else selection
    for item in without_inline:
        item.stash[WITHOUT_INLINE] = True
    if left:
        config.hook.pytest_deselected(items=left)
        labels = ((device_of(item), item.get_closest_marker("slow")) for item in left)
        config.stash[LEFT] = left
        config.stash[LEFT_COUNTS] = dict(
            Counter("slow" if slow else device.label if device else "without a device" for device, slow in labels)
        )
        items[:] = chosen


def pytest_collection_finish() -> None:
    """Start the garbage collector, without the modules and the collected tests: it is 100 times faster then."""
    gc.freeze()
    gc.enable()


def _set_examples(items: list[pytest.Item], factor: float) -> None:
    """Multiply the number of examples of each hypothesis test, also where the test states the number."""
    for function in {getattr(item, "obj", None) for item in items}:
        if hypothesis.is_hypothesis_test(function):
            # Hypothesis has no public name for the settings of a test.
            stated = function._hypothesis_internal_use_settings
            count = max(round(factor * stated.max_examples), min(stated.max_examples, LEAST_EXAMPLES))
            function._hypothesis_internal_use_settings = hypothesis.settings(stated, max_examples=count)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand the counts of a worker to the main process; fail there for skips that hide a missing extra or device."""
    config = session.config
    if hasattr(config, "workeroutput"):
        config.workeroutput["left"] = config.stash.get(LEFT_COUNTS, {})
        config.workeroutput["refused"] = config.stash.get(REFUSED_COUNTS, {})
    elif config.getoption("strict_skips") and _unexpected_skips(config) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the counts of a worker; every worker collects the same tests."""
    counts = getattr(node, "workeroutput", {})
    node.config.stash[LEFT_COUNTS] = counts.get("left", {})
    node.config.stash[REFUSED_COUNTS] = counts.get("refused", {})


def _unexpected_skips(config: pytest.Config) -> list[str]:
    skipped = config.pluginmanager.getplugin("terminalreporter").getreports("skipped")
    places = [each.longrepr for each in skipped if isinstance(each.longrepr, tuple)]
    reasons = {(path, reason.removeprefix("Skipped: ")) for path, _, reason in places}
    return sorted(f"{path}: {reason}" for path, reason in reasons if reason not in ALLOWED_SKIPS)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that has the argument ``device`` on every healthy device."""
    if "device" in metafunc.fixturenames:
        devices = Device.all()
        metafunc.parametrize("device", devices or [None], ids=lambda each: each.label if each else "none")


@pytest.fixture(autouse=True)
def _a_device_is_there(request: pytest.FixtureRequest) -> None:
    if "device" not in request.fixturenames:
        return
    device = request.getfixturevalue("device")
    if device is None:
        pytest.fail(f"this test needs a healthy OpenCL device; {INSTALL_HINT}", pytrace=False)
    request.node.user_properties.append(("device", device.label))


@pytest.fixture(autouse=True)
def _no_inline_device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the tests of `Selection.without_inline` on the worker threads of PoCL only."""
    if request.node.stash.get(WITHOUT_INLINE, False):
        for device in Device.all():
            monkeypatch.setattr(device, "inline_device", None)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Fail a test that its device refuses; start the processor time of a test, before its fixtures."""
    if is_refused(item):
        pytest.fail(refusal_message(item), pytrace=False)
    _freeze_objects(item.config)
    record_test(item)


def _freeze_objects(config: pytest.Config) -> None:
    """Free the garbage, and freeze the other objects, if a full collection ran since the objects were last frozen.

    Modules that tests import and compiled functions add a million objects during a run, which stay: each full
    collection and each `clear_cache` would take 0.4 s. Reference counts still free frozen objects.
    """
    if _full_collections() != config.stash.get(FULL_COLLECTIONS, 0):
        gc.collect()
        gc.freeze()
        config.stash[FULL_COLLECTIONS] = _full_collections()


def _full_collections() -> int:
    return gc.get_stats()[2]["collections"]


def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """Write the arrays of a test whose comparison failed to the folder of ``GPUVISION_DEBUG``, if it is set."""
    if call.when == "teardown":
        record_test(item)
    if call.excinfo is None or not call.excinfo.errisinstance(AssertionError):
        return
    frames = [each.frame for each in call.excinfo.traceback if each.path == item.path]
    values = {name: value for frame in frames for name, value in frame.f_locals.items() if name != "self"}
    path = debug.dump_arrays(item.nodeid, **values) if values else None
    if path is not None:
        item.add_report_section(call.when, "arrays", str(path))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the number of passed tests for every device, which CI reads, and of the tests that do not run.

    Tests that pass although they are marked as expected failures are listed by name: their fault in `driver_faults` is
    gone.
    """
    config = terminalreporter.config
    passed = terminalreporter.getreports("passed")
    labels = Counter(label for each in passed for name, label in each.user_properties if name == "device")
    terminalreporter.write_line(f"kernel tests passed: {_counts(labels) or 'on no device'}")
    left = config.stash.get(LEFT_COUNTS, {})
    if left:
        more = "full tier (make test-full)" if config.getoption("tier") == "fast" else "nightly tier (make nightly)"
        terminalreporter.write_line(f"left to the {more}: {_counts(left)}")
    refused = config.stash.get(REFUSED_COUNTS, {})
    if refused:
        terminalreporter.write_line(f"left to no tier, because the device refuses them: {_counts(refused)}")
    for each in sorted(terminalreporter.getreports("xpassed"), key=lambda each: each.nodeid):
        terminalreporter.write_line(f"expected to fail, passed: {each.nodeid} ({each.wasxfail})", yellow=True)
    for line in table_of_files(each for each in terminalreporter.getreports("") if each.when == "teardown"):
        terminalreporter.write_line(line)
    if config.getoption("strict_skips"):
        for each in _unexpected_skips(config):
            terminalreporter.write_line(f"unexpected skip: {each}", red=True)


def _counts(labels: Mapping[str, int]) -> str:
    return ", ".join(f"{label} {count}" for label, count in sorted(labels.items()))


@pytest.fixture
def draws(request: pytest.FixtureRequest) -> Draws:
    """Number of draws of a statistic by tier: ``draws(fast, full)``, or ``draws(fast, full, nightly)``."""
    place = TIERS.index(request.config.getoption("tier"))
    return lambda *counts: counts[min(place, len(counts) - 1)]


@pytest.fixture(autouse=True)
def _unrendered_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the figures of commands without rendering them in the fast tier, if no mark ``rendered`` asks for pixels.

    Rendering and compressing a page takes 0.3 s of processor time, up to half of such a test.
    """
    has_commands = request.path.parent.name in _FOLDERS_OF_COMMANDS
    if has_commands and request.config.getoption("tier") == "fast" and not request.node.get_closest_marker("rendered"):
        blank = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda _figure, file, **_options: file.write(blank))


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20080107)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of the real recordings; a test that uses it is marked ``realdata``."""
    if not DATA.is_dir():
        pytest.skip(_NO_DATA)
    return DATA
