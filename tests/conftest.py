"""Devices for the tests: every healthy one, and failure rather than silence where there is none."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from gpuvision.host import Device, debug
from gpuvision.host.discovery import INSTALL_HINT

# New draws in every run; what fails prints how to repeat it. Without a clock: a busy machine is no fault of the code.
hypothesis.settings.register_profile("unhurried", deadline=None, print_blob=True)
hypothesis.settings.load_profile("unhurried")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that asks for a ``device`` on every healthy one."""
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
    """Say how many tests passed on which device; CI reads it."""
    passed = terminalreporter.getreports("passed")
    labels = Counter(label for each in passed for name, label in each.user_properties if name == "device")
    counts = ", ".join(f"{label} {count}" for label, count in sorted(labels.items())) or "on no device"
    terminalreporter.write_line(f"kernel tests passed: {counts}")


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
