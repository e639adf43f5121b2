"""Key of simulated light: digest of everything that the light depends on, including the program that computes it."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.resources
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.sensor.light_source import Light
from gpuvision.sensor.sensor import Sensor

NOT_OPTICAL: dict[type, frozenset[str]] = {
    # The transports of a task hold what an encoder measured.
    Sensor: frozenset({"name", "recording", "output", "auto_threshold", "files", "encoder"}),
    Light: frozenset({"responsivity", "ambient", "modulated", "exposure", "full_well", "read_noise"}),
    PsdReadout: frozenset(
        {
            "ampere",
            "dark",
            "right_gain",
            "interelectrode_resistance",
            "load_resistance",
            "minimum_total",
            "saturation",
            "linearity",
            "margin",
            "noise",
            "layout",
            "outputs",
            "precision",
            "variant",
        }
    ),
    LineReadout: frozenset(
        {
            "method",
            "threshold",
            "window",
            "peak_selection",
            "minimum_peak",
            "minimum_width",
            "maximum_width",
            "saturation",
            "ambiguity",
            "fir_length",
            "read_noise",
            "gain",
            "outputs",
            "precision",
            "variant",
        }
    ),
}
"""Fields of a sensor description that the light does not depend on. All other fields are part of the key."""

# Packages whose sources and kernels compute the light, and the suffixes of their source files.
_PACKAGES = ("camera", "formats", "ranging", "sensor", "simulation", "host", "kernels")
_SUFFIXES = (".py", ".cl", ".h")


def key_of(*values: Any) -> str:
    """Return the key of light that depends on values and on the sources of the program: 16 hexadecimal digits.

    Parameters
    ----------
    values
        Numbers, texts, arrays, sequences, and dataclasses of these. Fields in `NOT_OPTICAL` do not count.

    Raises
    ------
    TypeError
        A value has another type, for which equal content cannot be recognised.

    Notes
    -----
    The key does not depend on the device or on the versions of the drivers and of NumPy: light differs between them by
    rounding.
    """
    digest = hashlib.sha256(source_digest().encode())
    for part in _encode(values):
        digest.update(part)
    return digest.hexdigest()[:16]


@functools.cache
def source_digest() -> str:
    """Return the digest of `source_files`; read once per process (about 10 ms)."""
    digest = hashlib.sha256()
    for name, path in source_files().items():
        content = path.read_bytes()
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


def source_files() -> dict[str, Path]:
    """Return the Python and OpenCL sources that compute light, by their name in the package, in order."""
    found = {}
    top = Path(__file__).parent.parent
    here = Path(__file__).parent
    for path in (*top.glob("*.py"), here / "__init__.py", *here.glob("light_*.py")):
        found[path.relative_to(top).as_posix()] = path
    for package in _PACKAGES:
        folder = Path(str(importlib.resources.files(f"gpuvision.{package}")))
        for path in folder.rglob("*"):
            if path.suffix in _SUFFIXES:
                found[f"{package}/{path.relative_to(folder).as_posix()}"] = path
    return dict(sorted(found.items()))


def _encode(value: Any) -> Iterator[bytes]:
    """Yield bytes that are equal for equal values, and different for different ones."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        omitted = frozenset().union(*(names for kind, names in NOT_OPTICAL.items() if isinstance(value, kind)))
        yield f"{type(value).__qualname__}(".encode()
        for each in dataclasses.fields(value):
            if each.init and each.name not in omitted:
                yield f"{each.name}=".encode()
                yield from _encode(getattr(value, each.name))
        yield b")"
    elif isinstance(value, (tuple, list)):
        yield f"[{len(value)}:".encode()
        for each in value:
            yield from _encode(each)
        yield b"]"
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif value is None or isinstance(value, (str, bool, int, float, np.number)):
        yield f"{value!r};".encode()
    else:
        raise TypeError(f"light depends on a {type(value).__name__}, for which gpuvision has no key")
