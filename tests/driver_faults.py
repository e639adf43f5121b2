"""Faults of drivers that tests have found: each is an expected failure on that driver, with version and reason."""

from __future__ import annotations

import re
from typing import NamedTuple

import pytest

from gpuvision.host import Device
from tiers import device_of


class DriverFault(NamedTuple):
    """Fault of a driver.

    Attributes
    ----------
    kind, driver : str
        Kind of the device, and the start of the driver's version.
    tests : str
        Regular expression that is found in the names of the affected tests (``path::function[case]``).
    reason : str
        Fault and its effect.
    ends_process : bool
        Whether the test must not run: the driver ends the process, or does not finish within a minute.
    """

    kind: str
    driver: str
    tests: str
    reason: str
    ends_process: bool = False


FAULTS = (
    DriverFault(
        "rusticl",
        "22.3",
        r"test_blob\.py::|test_blob_accuracy\.py::",
        "Mesa 22.3 does not compile the blob kernel within a minute",
        ends_process=True,
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_line\.py::test_(any_shape|tall_frames|fit_of_noise_stays_at_its_peak)\[",
        "Mesa 22.3 ends the process on vectors of 16 (LLVM ERROR), so that gpuvision refuses the vector variant",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_line\.py::test_(not|nothing)_finite\[.*centroid",
        "Mesa 22.3 loses infinite samples in the sums of the centroid: no flag NOT_FINITE (cause not found)",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_registration\w*\.py::",
        "Mesa 22.3 computes wrong pose steps with five or more unknowns (similarity or affine with an etch bias)",
    ),
)


def mark_faults(items: list[pytest.Item]) -> None:
    """Mark the tests that faults of drivers affect as expected failures."""
    for item in items:
        device = device_of(item)
        for fault in FAULTS:
            if device is not None and _affects(fault, device, item.nodeid):
                item.add_marker(pytest.mark.xfail(reason=fault.reason, run=not fault.ends_process, strict=False))


def _affects(fault: DriverFault, device: Device, name: str) -> bool:
    is_driver = device.kind == fault.kind and device.driver.startswith(fault.driver)
    return is_driver and re.search(fault.tests, name) is not None
