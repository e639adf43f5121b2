"""Cached programs: the key contains the text of all included headers, and no path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from gpuvision.host import Device, clear_cache
from gpuvision.host import program as programs

FILES = {
    "scale/scale.cl": """#include "scale/near.h"
kernel void scale(global const float *restrict from, global float *restrict to) {
    to[get_global_id(0)] = scaled(from[get_global_id(0)]);
}
""",
    "scale/near.h": '#include "common/far.h"\nstatic inline float scaled(float x) { return FACTOR * x; }\n',
}


def write_kernels(folder: Path, factor: float) -> Path:
    """Write a kernel whose factor is in a header of its header."""
    for name, text in (FILES | {"common/far.h": f"#define FACTOR {factor}f\n"}).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def scaled_one(device: Device, folder: Path) -> float:
    """Build the kernel as a new process does, and return its result for 1."""
    programs._build.cache_clear()
    kernel = cl.Kernel(programs.build(device, folder, "scale/scale.cl", {}), "scale")
    given = cl.array.to_device(device.queue, np.ones(1, np.float32))
    made = cl.array.empty_like(given)
    kernel(device.queue, (1,), None, given.data, made.data)
    return float(made.get()[0])


def test_a_changed_header_of_a_header_is_another_program(device: Device, tmp_path: Path) -> None:
    """The same folder, file and options: the programs that drivers and pyopencl keep on disk do not fit."""
    factors = (2.0, 3.0, 2.0)
    assert tuple(scaled_one(device, write_kernels(tmp_path, each)) for each in factors) == factors


def test_clear_cache_frees_programs(device: Device, tmp_path: Path) -> None:
    """The same folder, file and options give the same program, and another one after the cache is cleared."""
    folder = write_kernels(tmp_path, 2.0)
    one, same = (programs.build(device, folder, "scale/scale.cl", {}) for _ in range(2))
    assert same is one
    clear_cache()
    assert programs.build(device, folder, "scale/scale.cl", {}) is not one


def test_copies_of_the_kernels_share_their_programs(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Text and options, which make the key of a cached program, do not depend on the folder."""
    keys: list[Any] = []

    class Recorded(cl.Program):
        def __init__(self, context: Any, text: str) -> None:
            super().__init__(context, text)
            self.text = text

        def build(self, options: Any = (), **more: Any) -> Any:
            keys.append((self.text, tuple(options)))
            return super().build(options=options, **more)

    monkeypatch.setattr(programs.cl, "Program", Recorded)
    for name, factor in (("one", 2.0), ("other", 2.0), ("changed", 3.0)):
        scaled_one(device, write_kernels(tmp_path / name, factor))
    assert keys[0] == keys[1]
    assert keys[0][0] != keys[2][0]
