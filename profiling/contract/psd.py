"""Contract of the PSD readout: scans, light levels of 1:1e6, and samples at every limit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.profiling.psd import LENGTH, MINIMUM, SATURATION, scan_currents
from gpuvision.ranging.psd import PsdNoise, PsdReadout
from gpuvision.reference.psd import read_out

LIMITS = {
    "PsdReadout": (
        equal("status", reason="comparisons only, except within rounding of a threshold"),
        roundings(4, "position", of="half of the strip length [m]", reason="difference, sum, quotient and product"),
        roundings(1.5, "total", of="sum of the currents [A]", reason="sum, product with the unit, and this constant"),
        roundings(
            16, "sigma", of="sigma [m]",
            reason="a sum of positive terms, each of at most 24 roundings; the root halves the sum's relative error",
        ),
    )
}  # fmt: skip


def cases() -> Iterator[Case]:
    """Yield scans of each input type and layout, a range of light levels, and the limits."""
    for dtype in ("float32", "uint16", "float64"):
        yield _case(f"scan, {dtype}", scan_currents(dtype, 4097), layout="planar")
    rng = np.random.default_rng(21)
    level, place = 10.0 ** rng.uniform(-12.0, -6.0, (7, 1023)), rng.uniform(-0.1, 1.1, (7, 1023))
    wide = np.stack([level * (1.0 - place), level * place]).astype(np.float32)
    yield _case("light levels 1:1e6", wide, layout="pairs", minimum_total=1e-11, saturation=5e-7)
    noise = PsdNoise(independent=1e-11, opposed=2e-12, spot=50e-6, bandwidth=100e3)
    lit = (scan_currents("float64", 4097)[:, :1500] * 1e-11).astype(np.float32)
    yield _case("noise model", lit, layout="planar", minimum_total=1e-8, saturation=1e-6, noise=noise)
    nan, inf, most = np.nan, np.inf, float(np.finfo(np.float32).max)
    samples = (
        (1.0, 3.0), (0.0, 0.0), (0.04, 0.05), (-0.5, 0.2), (-0.1, 2.0), (0.0, 2.0), (2.0, 0.0), (8.0, 1.0), (1.0, 9.0),
        (nan, 1.0), (1.0, inf), (-inf, inf), (most, most), (3.0, 3.0), (np.nextafter(np.float32(8.0), 0.0), 1.0),
    )  # fmt: skip
    limits = np.array(samples, np.float32).T
    yield _case("samples at the limits", limits, layout="pairs", minimum_total=0.125, saturation=8.0)


def _case(name: str, planar: npt.NDArray[Any], *, layout: Any, **settings: Any) -> Case:
    """Return a case of currents (2, ...), left and right."""
    parameters = {"strip_length": LENGTH, "minimum_total": MINIMUM, "saturation": SATURATION, **settings}
    readout = PsdReadout(layout=layout, **parameters)
    left, right = planar
    expected = read_out(readout, left, right)
    exact: dict[str, npt.NDArray[Any]] = {
        "position": expected.position,
        "status": expected.status,
        "total": expected.total,
    }
    exact |= {"sigma": expected.sigma} if readout.noise else {}
    # A sum that overflows in single precision does not in float64.
    real = np.float64 if planar.dtype == np.float64 else np.float32
    exact["total"] = np.where(np.abs(expected.total) > np.finfo(real).max, np.inf, expected.total)
    quantities = {"position": 0.5 * LENGTH, "total": np.abs(exact["total"]), "sigma": expected.sigma}
    given = planar if layout == "planar" else np.ascontiguousarray(np.moveaxis(planar, 0, -1))
    undecided = _near_thresholds(readout, left, right, float(np.finfo(real).eps))
    return Case("PsdReadout", name, readout, (given,), exact, quantities, undecided)


def _near_thresholds(
    readout: PsdReadout, left: npt.NDArray[Any], right: npt.NDArray[Any], eps: float
) -> npt.NDArray[np.bool_]:
    """Return where the sum is near its least value, or the spot near an end of the trusted part of the strip."""
    a, b = left.astype(np.float64), right.astype(np.float64)
    margin = 3.0 * readout.noise.spot if readout.noise else 0.0
    inner = 1.0 - 2.0 * margin / LENGTH
    with np.errstate(invalid="ignore"):
        total, size = a + b, np.abs(a) + np.abs(b)
        dark = np.abs(total - readout.minimum_total) <= 2.0 * eps * size
        end = np.abs(np.abs(b - a) - inner * total) <= 2.0 * eps * size
    # A current of 0 or below, or codes: difference and sum have the same roundings, and the comparison is exact.
    return np.asarray((dark | (end & (np.minimum(a, b) != 0.0))) & np.isfinite(total))
