"""Sphinx extension: one page for every file of ``profiling/results``, with all of its rows.

All rows are printed in the order of the run, including the rows in which a peer is faster; their number is printed.
The files ``offline-*.json`` hold the resources of kernels compiled for GPUs (``gpuvision profile --offline``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpuvision.profiling.rounds import stated_interval
from pages import table, title, toctree, write_pages

FOLDER = "results/runs"
SOURCE = Path(__file__).resolve().parents[2] / "profiling" / "results"

_COLUMNS = (
    "operation",
    "case",
    "device",
    "seconds",
    "peer",
    "peer_version",
    "peer_seconds",
    "ratio",
    "error",
    "fraction",
    "form",
    "ratio_low",
    "ratio_high",
    "confidence",
    "rounds",
    "device_seconds",
)
_PROBED = ("before", "after")


def _time(seconds: float) -> str:
    for unit, name in ((1.0, "s"), (1e-3, "ms")):
        if seconds >= unit:
            return f"{seconds / unit:.3g} {name}"
    return f"{seconds / 1e-6:.3g} µs"


def _value(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    fraction = row.get("fraction")
    more = ", ".join(
        f"{key} {_value(value)}" for key, value in row.items() if key not in _COLUMNS and value is not None
    )
    kernels = f" ({_time(row['device_seconds'])})" if row.get("device_seconds") else ""
    form = f" ({row['form']})" if row.get("form") else ""
    return (
        f"``{row['case']}``",
        row["device"],
        _time(row["seconds"]) + kernels,
        f"{row['peer']}{form} {row['peer_version']}".strip(),
        _time(row["peer_seconds"]),
        _ratio(row),
        f"{row['error']:.1e}",
        "" if fraction is None else f"{100 * fraction:.0f} %",
        more.replace("_", "\\_"),
    )


def _ratio(row: Mapping[str, Any]) -> str:
    """Return the ratio, bold if the peer is faster, and its interval where the run states one."""
    ratio = f"{row['ratio']:.2f}"
    interval = stated_interval(row)
    limits = "" if interval is None else f" ({interval[0]:.2f} to {interval[1]:.2f})"
    return (f"**{ratio}**" if row["ratio"] < 1.0 else ratio) + limits


_HEADER = ("case", "device", "time", "peer", "peer's time", "ratio", "error", "of limit", "metadata")


def _machine(machine: Mapping[str, Any]) -> str:
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    lines = [f"- Processor: {machine['processor']}; {machine['system']}; Python {machine['python']}; {packages}."]
    for label, device in machine["devices"].items():
        lines.append(
            f"- Device ``{label}``: {device['name']}, driver {device['driver']}, {device['units']} compute units, "
            f"{device['gflops']:.0f} GFLOP/s (FMA, measured)."
        )
    return "\n".join(lines) + "\n"


def _speeds(run: Mapping[str, Any]) -> str:
    """Return the range of the FLOP rates before and after each operation; nothing for runs without them."""
    parts = []
    for device in dict.fromkeys(probe["device"] for probe in run.get("probes", ())):
        rates = [probe[when] / 1e9 for probe in run["probes"] if probe["device"] == device for when in _PROBED]
        parts.append(f"``{device}`` {min(rates):.0f} to {max(rates):.0f} GFLOP/s")
    return f" Probes before and after each operation: {', '.join(parts)}." if parts else ""


def run_page(name: str, run: Mapping[str, Any]) -> str:
    """Return the page of one run."""
    rows = run["rows"]
    operations = list(dict.fromkeys(row["operation"] for row in rows))
    slower = sum(row["ratio"] < 1.0 for row in rows)
    date = f"- Date: {run['machine']['date']}.\n" if "date" in run["machine"] else ""
    parts = [
        ":html_theme.sidebar_secondary.remove:\n",  # the tables are wide
        title(name),
        _machine(run["machine"]),
        f"{date}- Command: ``gpuvision profile {' '.join(operations)} --json FILE``.",
        f"- The speed of the machine was constant during the run: {'yes' if run['valid'] else '**no**'}.{_speeds(run)}",
        f"- Rows: {len(rows)}; the peer is faster in {slower} of them (ratio in bold).\n",
        "See :doc:`../index` for the meaning of the columns.\n",
    ]
    for operation in operations:
        chosen = [_cells(row) for row in rows if row["operation"] == operation]
        parts += [title(operation, "-"), table(_HEADER, chosen, css_class="results")]
    return "\n".join(parts)


_LIMITS = {
    "spills": "spilled registers on NVIDIA [bytes]",
    "spills_amd": "spilled registers on AMD [bytes]",
    "spills_double": "spilled registers of builds in double precision [bytes]",
    "stack": "stack of a work-item [bytes]",
    "local": "local memory of a work-group [bytes]",
}


def _resources(row: Mapping[str, Any] | None) -> str:
    if row is None or "fault" in row:
        return "" if row is None else f"**{row['fault']}**"
    spills = f" / {row['spills']}" if row["spills"] else ""
    return f"{row['registers']} / {row['stack']}{spills}"


def offline_page(name: str, report: Mapping[str, Any]) -> str:
    """Return the page of the kernels compiled for GPUs: a row for each kernel of each build."""
    targets, rows = list(report["compilers"]), report["rows"]
    found = {(row["source"], row["case"], row["kernel"], row["target"]): row for row in rows}
    kernels = dict.fromkeys(key[:3] for key in found)
    cells = []
    for key in kernels:
        of_targets = [found.get((*key, target)) for target in targets]
        local = max((row.get("local", 0) for row in of_targets if row), default=0)
        cells.append((f"``{key[2]}``", key[1], *map(_resources, of_targets), str(local)))
    used = [f"- ``{target}``: {'; '.join(words)}." for target, words in report["compilers"].items()]
    limits = [f"- {words}: {report['limits'][key]}." for key, words in _LIMITS.items()]
    return "\n".join(
        [
            ":html_theme.sidebar_secondary.remove:\n",
            title(name),
            "Resources of the kernels compiled for GPUs that were not present: registers of a work-item (on AMD vector",
            "registers), its stack [bytes] and, where there are any, its spilled registers [bytes]. They are no times.",
            f"Command: ``gpuvision profile {' '.join(f'--offline {each}' for each in targets)} --json FILE``.\n",
            "\n".join(used) + "\n",
            "Limits of the check:\n",
            "\n".join(limits) + "\n",
            table(("kernel", "build", *targets, "local memory [B]"), cells, css_class="results"),
        ]
    )


def results_pages(source: Path = SOURCE) -> dict[str, str]:
    """Return all pages by file name."""
    files = {path.stem: json.loads(path.read_text()) for path in sorted(source.glob("[!.]*.json"))}
    runs = {name: run for name, run in files.items() if not name.startswith("offline-")}
    offline = {name: report for name, report in files.items() if name not in runs}
    pages = {f"{name}.rst": run_page(name, run) for name, run in runs.items()}
    pages |= {f"{name}.rst": offline_page(name, report) for name, report in offline.items()}
    rows = []
    for name, run in runs.items():
        operations = dict.fromkeys(row["operation"] for row in run["rows"])
        slower = sum(row["ratio"] < 1.0 for row in run["rows"])
        rows.append((f":doc:`{name}`", ", ".join(operations), str(len(run["rows"])), str(slower)))
    compiled = [
        (f":doc:`{name}`", ", ".join(report["compilers"]), str(len(report["rows"]))) for name, report in offline.items()
    ]
    parts = [
        title("Runs"),
        table(("run", "operations", "rows", "rows with a faster peer"), rows),
        title("Kernels compiled for GPUs", "-"),
        table(("report", "targets", "rows"), compiled),
        toctree(files),
    ]
    pages["index.rst"] = "\n".join(parts)
    return pages


def setup(app: Any) -> dict[str, Any]:
    """Write the pages before Sphinx looks for documents."""
    app.connect("config-inited", lambda app, config: write_pages(Path(app.srcdir, FOLDER), results_pages()))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
