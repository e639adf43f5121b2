"""Arrays between memory pages that cannot be read: a program that reads or writes beyond them ends with SIGSEGV.

``python tests/guard_pages.py CASE`` runs the operations of a case on such arrays on the best device.
"""

from __future__ import annotations

import ctypes
import mmap
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gpuvision.camera.lens import Lens
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout

_NO_ACCESS = 0  # PROT_NONE of mprotect(2)
_KEPT: list[mmap.mmap] = []


def between_pages(array: NDArray[Any], *, at_end: bool) -> NDArray[Any]:
    """Return a copy that ends right before a page without access, or begins right after one."""
    page = mmap.PAGESIZE
    size = -(-array.nbytes // page) * page
    memory = mmap.mmap(-1, size + 2 * page)
    _KEPT.append(memory)
    whole = np.frombuffer(memory, np.uint8)
    protect = ctypes.CDLL(None, use_errno=True).mprotect
    for start in (0, page + size):
        if protect(ctypes.c_void_p(whole.ctypes.data + start), ctypes.c_size_t(page), _NO_ACCESS):
            raise OSError(ctypes.get_errno(), "mprotect")
    begin = page + (size - array.nbytes if at_end else 0)
    copy = whole[begin : begin + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def _lines() -> Iterator[tuple[Any, tuple[NDArray[Any], ...]]]:
    frames = np.random.default_rng(1).integers(0, 200, (2, 40, 50), np.uint8)
    for along in ("columns", "rows"):
        for variant in ("vector", "work_item"):
            yield LineReadout(along=along, variant=variant, threshold=20, window=6, ambiguity=0.5), (frames,)
        yield LineReadout(along=along, method="centroid", threshold=20), (frames,)


def _images() -> Iterator[tuple[Any, tuple[NDArray[Any], ...]]]:
    rng = np.random.default_rng(1)
    lens = Lens(k1=1e-7, centre=(60.0, 41.0))
    for shape, channels in (((83, 117, 3), 3), ((83, 117), 1)):
        image = rng.integers(0, 255, shape, np.uint8)
        yield UndistortImage(model=lens, channels=channels, coordinates="computed"), (image,)
        yield UndistortImage(model=lens, channels=channels), (image,)


CASES: dict[str, Callable[[], Iterator[tuple[Any, tuple[NDArray[Any], ...]]]]] = {
    "line": _lines,
    "undistort_image": _images,
}


def assert_within_pages(case: str) -> None:
    """Assert that the operations of a case neither read nor write beyond their arrays on the best device."""
    if not Device.best().shares_memory:
        pytest.skip("the kernels of this device read copies")
    done = subprocess.run([sys.executable, __file__, case], capture_output=True, text=True)
    last = done.stdout.splitlines()[-1:]
    assert done.returncode == 0, f"ended with {done.returncode} in {last}: {done.stderr[-1000:]}"


def main() -> None:
    """Run the operations of a case; print each before it runs."""
    device = Device.best()
    for operation, arrays in CASES[sys.argv[1]]():
        expected = operation(*arrays, device=device)
        for at_end in (True, False):
            print(f"{operation} at_end={at_end}", flush=True)
            guarded = [between_pages(each, at_end=at_end) for each in arrays]
            out = type(expected)(*(None if a is None else between_pages(a, at_end=at_end) for a in expected))
            found = operation(*guarded, device=device, out=out)
            for a, b in zip(found, expected, strict=True):
                np.testing.assert_array_equal(a, b)


if __name__ == "__main__":
    main()
