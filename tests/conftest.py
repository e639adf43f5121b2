"""Devices, tiers and caches of the tests. Without an OpenCL device, tests that need one fail.

The option ``--tier`` selects the tests. ``fast`` runs all tests without the mark ``slow`` on the best device, and a
smoke set on every other device: one test for each file, kernel variant and precision. Of a kernel test with three
parameters or more it runs an all-pairs design. ``full`` runs all tests on every device. ``nightly`` is ``full`` with
more hypothesis examples.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.configuration
import numpy as np
import pytest

from designs import all_pairs
from gpuvision.host import Device, debug
from gpuvision.host.discovery import INSTALL_HINT

ROOT = Path(__file__).resolve().parents[1]
# Compiled kernels of all runtimes, verdicts of devices, fonts of matplotlib: kept in the clone, so that a second run is
# warm and nothing is written in the home. Each of these folders is read when it is first needed, after this line.
CACHE = ROOT / "build" / "cache"
os.environ |= {"XDG_CACHE_HOME": str(CACHE), "MPLCONFIGDIR": str(CACHE / "matplotlib")}
# For workers of pytest-xdist and subprocesses: two workers with two polling threads each would slow each other down.
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
hypothesis.configuration.set_hypothesis_home_dir(CACHE / "hypothesis")

LEFT = pytest.StashKey[dict[str, int]]()
WITHOUT_INLINE = pytest.StashKey[bool]()
TIERS = ("fast", "full", "nightly")
# Factor on the examples of every hypothesis test in the tier "nightly".
NIGHTLY_EXAMPLES = 20
# New draws in every run; a failure prints how to repeat it. No deadline: a busy machine must not fail a test.
hypothesis.settings.register_profile("unhurried", deadline=None, print_blob=True)
hypothesis.settings.load_profile("unhurried")

DATA = ROOT.parent / "shared" / "data"
# Reasons of skips that are expected with all extras and both CPU runtimes; ``--strict-skips`` fails on other reasons.
ALLOWED_SKIPS = (
    "the recordings in ../shared/data are not here",
    "`make docs` ran this example after the last change",
    "only PoCL 3 has such a device",
    "only Intel's runtime does so by the work's groups",
    "only root mounts a small file system",
    "only root gives files away",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--tier", choices=TIERS, default="full", help="which tests run: see tests/conftest.py")
    parser.addoption("--strict-skips", action="store_true", help="fail when a test is skipped for an unexpected reason")


@pytest.hookimpl(trylast=True)  # after -m and -k: the smoke set is selected from the remaining tests
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests that the tier omits; draw more hypothesis examples in the tier "nightly"."""
    tier = config.getoption("tier")
    if tier == "nightly":
        _draw_more_examples(items)
    if tier != "fast":
        return
    best = Device.all()[:1]
    left = list(_left_to_full_tier(items, best))
    if left:
        config.hook.pytest_deselected(items=left)
        labels = ((_device_of(item), item.get_closest_marker("slow")) for item in left)
        config.stash[LEFT] = dict(
            Counter("slow" if slow else device.label if device else "without a device" for device, slow in labels)
        )
        out = set(left)
        items[:] = [item for item in items if item not in out]


def _left_to_full_tier(items: list[pytest.Item], best: Sequence[Device]) -> Iterator[pytest.Item]:
    """Yield slow tests, cases beyond an all-pairs design and, on all devices but the best, tests beyond the smoke set.

    PoCL compiles each kernel once more for its inline device: beyond the smoke set, tests outside ``tests/host`` run
    without that device.
    """
    fast = [item for item in items if item.get_closest_marker("slow") is None]
    designed = set(_designed(fast))
    seen = set()
    for item in items:
        device = _device_of(item)
        case = _smoke_case(item)
        is_more = device is not None and case in seen
        if item not in designed or (is_more and device not in best):
            yield item
            continue
        seen.add(case)
        item.stash[WITHOUT_INLINE] = is_more and "host" not in item.path.parts


def _designed(items: list[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield an all-pairs design of each kernel test with three parameters or more, and all cases of other tests.

    The device is not one of these parameters.
    """
    functions: dict[Any, list[pytest.Item]] = {}
    for item in items:
        functions.setdefault((item.parent, getattr(item, "originalname", item.name), _device_of(item)), []).append(item)
    for (_, _, device), cases in functions.items():
        parameters = [
            {name: value for name, value in _parameters_of(item).items() if name != "device"} for item in cases
        ]
        is_product = device is not None and len(parameters[0]) > 2
        yield from (cases[k] for k in (all_pairs(parameters) if is_product else range(len(cases))))


def _smoke_case(item: pytest.Item) -> tuple[Any, ...]:
    """Return a key: file, device, kernel variant and precision; the smoke set has the first test of each key.

    Runtimes differ most in queues and memory: in ``tests/host`` the key also has the test function.
    """
    parameters = _parameters_of(item)
    chosen = (parameters.get(name) for name in ("device", "variant", "precision"))
    function = getattr(item, "originalname", item.name) if "host" in item.path.parts else ""
    return (item.path, function, *map(str, chosen))


def _device_of(item: pytest.Item) -> Device | None:
    return _parameters_of(item).get("device")


def _parameters_of(item: pytest.Item) -> Mapping[str, Any]:
    return item.callspec.params if hasattr(item, "callspec") else {}


def _draw_more_examples(items: list[pytest.Item]) -> None:
    """Multiply the number of examples of each hypothesis test, also where the test states the number."""
    for function in {getattr(item, "obj", None) for item in items}:
        if hypothesis.is_hypothesis_test(function):
            # Hypothesis has no public name for the settings of a test.
            stated = function._hypothesis_internal_use_settings
            more = hypothesis.settings(stated, max_examples=NIGHTLY_EXAMPLES * stated.max_examples)
            function._hypothesis_internal_use_settings = more


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand the counts of a worker to the main process; fail there for skips that hide a missing extra or device."""
    config = session.config
    if hasattr(config, "workeroutput"):
        config.workeroutput["left"] = config.stash.get(LEFT, {})
    elif config.getoption("strict_skips") and _unexpected_skips(config) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the counts of a worker; every worker collects the same tests."""
    node.config.stash[LEFT] = getattr(node, "workeroutput", {}).get("left", {})


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
def _a_device_is_there(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "device" not in request.fixturenames:
        return
    device = request.getfixturevalue("device")
    if device is None:
        pytest.fail(f"this test needs a healthy OpenCL device; {INSTALL_HINT}", pytrace=False)
    request.node.user_properties.append(("device", device.label))
    if request.node.stash.get(WITHOUT_INLINE, False):
        monkeypatch.setattr(device, "inline_device", None)


def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """Write the arrays of a test whose comparison failed to the folder of ``GPUVISION_DEBUG``, if it is set."""
    if call.excinfo is None or not call.excinfo.errisinstance(AssertionError):
        return
    frames = [each.frame for each in call.excinfo.traceback if each.path == item.path]
    values = {name: value for frame in frames for name, value in frame.f_locals.items() if name != "self"}
    path = debug.dump_arrays(item.nodeid, **values) if values else None
    if path is not None:
        item.add_report_section(call.when, "arrays", str(path))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the number of passed tests for every device, which CI reads, and of the tests of the full tier only."""
    config = terminalreporter.config
    passed = terminalreporter.getreports("passed")
    labels = Counter(label for each in passed for name, label in each.user_properties if name == "device")
    terminalreporter.write_line(f"kernel tests passed: {_counts(labels) or 'on no device'}")
    left = config.stash.get(LEFT, {})
    if left:
        terminalreporter.write_line(f"left to the full tier (make test-full): {_counts(left)}")
    if config.getoption("strict_skips"):
        for each in _unexpected_skips(config):
            terminalreporter.write_line(f"unexpected skip: {each}", red=True)


def _counts(labels: Mapping[str, int]) -> str:
    return ", ".join(f"{label} {count}" for label, count in sorted(labels.items()))


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers, the same in every run."""
    return np.random.default_rng(20080107)


@pytest.fixture
def data() -> Path:
    """The folder of the real recordings; a test that uses it is marked ``realdata``."""
    if not DATA.is_dir():
        pytest.skip("the recordings in ../shared/data are not here")
    return DATA
