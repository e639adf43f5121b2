"""Roofline: rate of operations over their number for each byte of traffic, below the measured limits of a device.

S. Williams, A. Waterman, D. Patterson, "Roofline: an insightful visual performance model for multicore architectures",
Communications of the ACM 52(4), 2009. The sloped roofs are the rates of a copy of different sizes
(`ceiling.bandwidths`): a small copy stays in the caches. The flat roof is the rate of multiply-adds
(`ceiling.flop_rate`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpuvision.profiling.run import Row

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_MARKS = "osD^v"  # of the first six points, of the next six, ...
_GREYS = ("0.75", "0.55", "0.2")
_INTENSITIES = (0.05, 500.0)  # [FLOP/B]


def points(rows: Sequence[Row]) -> dict[str, Row]:
    """Return one row for each operation, by the class that it launches: the case with the largest traffic."""
    chosen: dict[str, Row] = {}
    for row in rows:
        if row.flops and row.bytes:
            name = row.launched or row.operation
            before = chosen.setdefault(name, row)
            if row.bytes > (before.bytes or 0):
                chosen[name] = row
    return chosen


def roof(intensity: Any, bandwidth: float, rate: float) -> Any:
    """Return the largest rate of operations [FLOP/s] at an intensity [FLOP/B] with a bandwidth [B/s]."""
    return np.minimum(intensity * bandwidth, rate)


def share(row: Row, device: Mapping[str, Any]) -> float:
    """Return the rate of operations of a row over the roof of its device.

    The slope is the rate of the smallest copy that has its traffic, or else of the largest copy.
    """
    flops, moved = row.flops or 0.0, row.bytes or 1  # `points` leaves out rows without operations or traffic
    rates = {int(size): float(rate) for size, rate in device["bandwidths"].items()}
    size = min((each for each in rates if each >= moved), default=max(rates))
    return float(flops / row.seconds / roof(flops / moved, rates[size], 1e9 * device["gflops"]))


def draw_roofline(axes: Any, rows: Sequence[Row], devices: Mapping[str, Any]) -> None:
    """Draw the roofs of the device of the rows, and a point for each operation with its share of the roof."""
    device = devices[rows[0].device]
    rate = 1e9 * device["gflops"]
    intensities = np.geomspace(*_INTENSITIES, 200)
    for grey, (size, bandwidth) in zip(_GREYS, device["bandwidths"].items(), strict=False):
        label = f"{int(size) / 2**20:.0f} MiB: {bandwidth / 1e9:.0f} GB/s"
        axes.loglog(intensities, roof(intensities, bandwidth, rate) / 1e9, color=grey, linewidth=1.0, label=label)
    styles = itertools.cycle(itertools.product(_MARKS, _COLOURS))
    for (mark, colour), (name, row) in zip(styles, points(rows).items(), strict=False):
        flops = row.flops or 0.0
        place = (flops / (row.bytes or 1), flops / row.seconds / 1e9)
        label = f"{name} {row.case}: {share(row, device):.0%}"
        axes.loglog(*place, mark, color=colour, markersize=5, label=label)
    axes.set(xlabel="operations for each byte [FLOP/B]", ylabel="rate [GFLOP/s]")
