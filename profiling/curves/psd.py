"""PSD readout of a light spot: precision, type of the samples, and the least sum of currents that is accepted.

The currents have shot noise and amplifier noise; the light level varies by a factor of 1000 over the samples, as
on a part with dark and bright surfaces. A higher least sum rejects the noisy samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.host.launch import Precision
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.ranging.psd import PsdReadout

_LENGTH = 6e-3  # of the strip [m]
_COUNT = 200_000
_CODES_PER_ELECTRON = 1e-3
_AMPLIFIER = 20.0  # noise of a current [codes]


def settings(device: Device) -> Iterator[Setting]:
    """Yield precisions and least sums."""
    rng = np.random.default_rng(3)
    true = rng.uniform(-0.4, 0.4, _COUNT) * _LENGTH
    level = 10.0 ** rng.uniform(1.7, 4.7, _COUNT)  # sum of the currents [codes]
    shares = np.stack([0.5 - true / _LENGTH, 0.5 + true / _LENGTH])
    electrons = rng.poisson(shares * level / _CODES_PER_ELECTRON)
    currents = electrons * _CODES_PER_ELECTRON + rng.normal(0.0, _AMPLIFIER, shares.shape)
    types: list[tuple[str, Precision]] = [("uint16", None), ("float32", None)]
    types += [("float64", "double")] if device.has_double else []
    for dtype, precision in types:
        samples = np.clip(np.rint(currents), 0, 65_535) if dtype == "uint16" else currents
        for least in (100.0, 400.0, 1600.0, 6400.0):
            operation: Any = PsdReadout(
                strip_length=_LENGTH, minimum_total=least, layout="planar", outputs=("position", "status"),
                precision=precision,
            )  # fmt: skip
            bound = bind_with(operation, device, samples.astype(dtype))
            deviation = to_numpy(bound.outputs.position) - true
            parameters = {"dtype": dtype, "precision": precision or "single", "minimum_total": least}
            yield Setting("psd", "light levels 1:1000", parameters, bound.run, Errors(deviation), "m")
