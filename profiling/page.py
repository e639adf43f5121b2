"""Page of a benchmark run: one HTML file with the machine, the peers, figures and all rows, which needs no network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

from gpuvision.host.outputs import Outputs
from gpuvision.profiling.page_figures import page_figures
from gpuvision.profiling.run import Row, Run

PAGE_FILE = "profile.html"
"""Name of the file that `write_page` writes."""

_UNITS = ((3600.0, "h"), (60.0, "min"), (1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


class PeerSummary(NamedTuple):
    """Ratios of a peer on a device over all cases.

    Attributes
    ----------
    peer, device
        Names of the peer and of the device.
    cases, faster
        Number of cases, and of those in which gpuvision is faster.
    mean, smallest, largest
        Geometric mean, smallest and largest ratio.
    """

    peer: str
    device: str
    cases: int
    faster: int
    mean: float
    smallest: float
    largest: float


def write_page(folder: str | Path, run: Run, *, overwrite: bool = False) -> Path:
    """Write the page of a run into a folder; return its path.

    With `overwrite` it may replace a file that no earlier profile wrote.
    """
    path = Path(folder) / PAGE_FILE
    with Outputs("profile", overwrite=overwrite).folder(folder) as inside:
        (inside / PAGE_FILE).write_text(page(run), encoding="utf-8")
    return path


def page(run: Run) -> str:
    """Return the HTML of the page of a run. All texts of the run are escaped."""
    source = resources.files("gpuvision.profiling").joinpath("page.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.ChainableUndefined)
    environment.filters |= {"duration": duration, "digits": digits}
    machine = run.machine
    return environment.from_string(source).render(
        machine=machine,
        packages=_mapping(machine, "packages"),
        facts=_facts(machine),
        devices=list(_mapping(machine, "devices").items()),
        valid=run.valid,
        seconds=run.seconds,
        peers=summaries(run.rows),
        figures=page_figures(run),
        operations=[
            (name, [row for row in run.rows if row.operation == name])
            for name in dict.fromkeys(row.operation for row in run.rows)
        ],
        probes=run.probes,
        failures=run.failures,
    )


def summaries(rows: Sequence[Row]) -> list[PeerSummary]:
    """Return the summary of each peer on each device, in the order of the rows. A ratio of 0 or NaN is left out."""
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if math.isfinite(row.ratio) and row.ratio > 0.0:
            found.setdefault((row.peer, row.device), []).append(row.ratio)
    return [
        PeerSummary(
            peer=peer,
            device=device,
            cases=len(ratios),
            faster=sum(ratio > 1.0 for ratio in ratios),
            mean=math.exp(math.fsum(map(math.log, ratios)) / len(ratios)),
            smallest=min(ratios),
            largest=max(ratios),
        )
        for (peer, device), ratios in found.items()
    ]


def duration(seconds: float) -> str:
    """Return a time [s] with three digits and its unit."""
    unit, name = next((each for each in _UNITS if seconds >= each[0]), _UNITS[-1])
    return f"{seconds / unit:.3g} {name}"


def digits(value: object) -> str:
    """Return a float with three significant digits, a large one as a whole number, and other values as text."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:.3g}"


def _facts(machine: Mapping[str, Any]) -> list[tuple[str, str]]:
    facts = [(name, str(machine[name])) for name in ("processor", "system", "python") if name in machine]
    packages = ", ".join(f"{name} {version}" for name, version in _mapping(machine, "packages").items())
    return [*facts, ("packages", packages)] if packages else facts


def _mapping(machine: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a table of the machine; empty if the file has none."""
    found = machine.get(name)
    return found if isinstance(found, Mapping) else {}
