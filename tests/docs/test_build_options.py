"""Build options of the kernels against their list in docs/concepts/kernel_variants.md."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.profiling.offline.builds import GpuModel
from gpuvision.profiling.offline.registry import all_examples

PAGE = Path(__file__).resolve().parents[2] / "docs" / "concepts" / "kernel_variants.md"
LANES = re.compile(r"(?<=[A-Z])(2|4|8|16)$")  # type options with a number of lanes: INPUT16


@pytest.mark.slow
def test_every_option_with_a_value_is_listed() -> None:
    listed = set(re.findall(r"`([A-Z_*]+)`", PAGE.read_text()))
    prefixes = tuple(each.removesuffix("*") for each in listed if each.endswith("_*"))
    used = set()
    for example in all_examples():
        for device in (Device.best(), GpuModel(has_double=example.has_double)):
            if device.has_double == example.has_double:
                launch = example.operation.launch(device, example.shape, np.dtype(example.dtype))
                used |= {LANES.sub("", name) for name, value in launch.defines.items() if value is not None}
    assert {name for name in used if name not in listed and not name.startswith(prefixes)} == set()
    assert {"TAPS", "CAPACITY", "INPUT", "NODE_SIZE"} <= used
