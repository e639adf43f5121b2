"""Result of a benchmark run: rows, failures, and the speed of the machine, with their JSON form."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gpuvision.host.outputs import Outputs
from gpuvision.profiling.rounds import stated_interval


@dataclass(frozen=True)
class Row:
    """Result of one comparison.

    Attributes
    ----------
    operation, case, device, peer, peer_version
        Names of the operation, the case, the device and the peer, and the version of the peer.
    seconds, peer_seconds
        Median times of our function and of the peer [s].
    ratio
        Time of the peer over our time, median over the rounds; above 1 if we are faster.
    error
        Our largest error, see `Case`.
    fraction
        Time of a copy with the same traffic over our time; None if the case gives no traffic.
    form
        Fastest form of the peer; empty if the peer has one form.
    ratio_low, ratio_high
        Confidence interval of the ratio within the run, from the spread over the rounds: see `rounds.median_interval`.
    confidence
        Confidence of the interval: at least 0.95, less for a peer so slow that it took part in fewer than 6 rounds.
        See `interval`.
    rounds
        Number of rounds in which the peer took part.
    device_seconds
        Median time from the start to the end of the kernels of a call, from the events of the runtime [s]; None for
        functions that launch several operations, and where the runtime gives no times.
    queued_seconds, submitted_seconds
        Median times from the enqueue to the submission and from the submission to the start [s].
    launched
        Class of the operation that a call launches; empty for functions that launch several operations.
    flops, bytes
        Operations and least traffic of one call, as the case declares them [1], [bytes].
    flop_fraction
        Rate of the declared operations over the rate of multiply-adds in single precision that the speed probe has
        measured, also where the operation computes in double precision.
    metadata
        Additional columns.
    """

    operation: str
    case: str
    device: str
    seconds: float
    peer: str
    peer_version: str
    peer_seconds: float
    ratio: float
    error: float
    fraction: float | None
    form: str = ""
    ratio_low: float | None = None
    ratio_high: float | None = None
    confidence: float | None = None
    rounds: int = 0
    device_seconds: float | None = None
    queued_seconds: float | None = None
    submitted_seconds: float | None = None
    launched: str = ""
    flops: float | None = None
    bytes: int | None = None
    flop_fraction: float | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    @property
    def interval(self) -> tuple[float, float] | None:
        """Confidence interval of the ratio, with the spread between runs; None if its confidence is below 95 %."""
        return stated_interval(vars(self))

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name; the columns of the metadata are the last ones."""
        table = asdict(self)
        return {key: value for key, value in table.items() if key != "metadata"} | dict(self.metadata)


@dataclass(frozen=True)
class Failure:
    """Operation whose benchmark raised an exception.

    The run has no rows of the operation on the device. If an earlier measurement succeeded although the machine
    changed its speed, the run keeps the rows of that measurement.

    Attributes
    ----------
    operation, device
        Name of the operation, and label of the device.
    reason
        Type and message of the exception.
    traceback
        Traceback of the exception.
    """

    operation: str
    device: str
    reason: str
    traceback: str


@dataclass(frozen=True)
class Probe:
    """FLOP rate of a device before and after the measurement of an operation.

    Attributes
    ----------
    operation, device
        Name of the operation, and label of the device.
    before, after
        Rates of single-precision multiply-adds [FLOP/s].
    steady
        Whether the rates differ by less than 20 %. A section that was not steady is measured again.
    """

    operation: str
    device: str
    before: float
    after: float
    steady: bool


@dataclass(frozen=True)
class Run:
    """Rows of a benchmark run.

    Attributes
    ----------
    rows
        Measured comparisons.
    valid
        Whether the machine held its speed during the measurement.
    machine
        Description of the machine, see `describe_machine`.
    failures
        Operations without rows, because their benchmark raised an exception.
    probes
        Speed of the machine before and after each measurement, including measurements that were repeated.
    seconds
        Duration of the run [s], with the preparation of the cases.
    """

    rows: Sequence[Row]
    valid: bool
    machine: Mapping[str, Any]
    failures: Sequence[Failure] = ()
    probes: Sequence[Probe] = ()
    seconds: float = 0.0

    def to_json(self) -> str:
        """Return the run as JSON."""
        table = {
            "machine": self.machine,
            "valid": self.valid,
            "seconds": self.seconds,
            "probes": [asdict(probe) for probe in self.probes],
            "failures": [asdict(failure) for failure in self.failures],
            "rows": [row.to_dict() for row in self.rows],
        }
        return json.dumps(table, indent=1) + "\n"

    def write(self, path: Path, *, overwrite: bool = False) -> None:
        """Write the run as JSON; on an error no file is written.

        With `overwrite` it may replace a file that no earlier profile wrote.
        """
        Outputs("profile", overwrite=overwrite).write_text(path, self.to_json())
