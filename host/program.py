"""Compile kernels: once per context, file and set of defines."""

from __future__ import annotations

import functools
import importlib.resources
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyopencl as cl

from gpuvision.host.device import Device
from gpuvision.host.errors import BuildError

Define = int | float | str | None


def kernel_folder() -> Path:
    """Return the folder of the OpenCL sources."""
    return Path(str(importlib.resources.files("gpuvision.kernels")))


def options(defines: Mapping[str, Define]) -> list[str]:
    """Write defines as compiler options; ``None`` defines a name without a value.

    Never fast-relaxed or finite-math-only: range images carry NaN holes.
    """
    words = [f"-D{name}" if value is None else f"-D{name}={value}" for name, value in sorted(defines.items())]
    return ["-cl-mad-enable", *words]


def build(device: Device, stem: str, defines: Mapping[str, Define], *, handle: Any = None) -> Any:
    """Return the program of ``kernels/<stem>.cl`` for a device.

    Parameters
    ----------
    device : Device
    stem : str
        Name of the kernel file without its ending.
    defines : mapping of str to value
        What changes the code: the real type, the terms that exist. Sizes are kernel arguments.
    handle : pyopencl.Device, optional
        Which device of the context; ``device.handle`` unless another is named.

    Returns
    -------
    pyopencl.Program

    Raises
    ------
    BuildError
        The source does not compile; carries the log.
    """
    return _build(device.context, device.handle if handle is None else handle, stem, tuple(options(defines)))


@functools.lru_cache(maxsize=256)
def _build(context: Any, handle: Any, stem: str, words: tuple[str, ...]) -> Any:
    folder = kernel_folder()
    source = (folder / f"{stem}.cl").read_text()
    program = cl.Program(context, source)
    try:
        with warnings.catch_warnings():
            # Both CPU runtimes report success ("Device ... successfully vectorised") as compiler output.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            return program.build(options=[*words, "-I", os.fspath(folder)], devices=[handle])
    except cl.RuntimeError as error:
        said = [line for line in str(error).splitlines() if line.strip()]
        raise BuildError(f"kernels/{stem}.cl does not build with {' '.join(words)}:\n" + "\n".join(said)) from error
