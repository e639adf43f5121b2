"""Check of the compiled kernels: unresolved functions, spilled registers, stack, local memory. Results are cached."""

from __future__ import annotations

import functools
import json
import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

from gpuvision.host.cache import read_private, write_private
from gpuvision.host.debug import flatten_includes
from gpuvision.host.program import options
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.profiling.offline.builds import KernelBuild
from gpuvision.profiling.offline.targets import (
    CompilerError,
    Target,
    Usage,
    cache_path,
    check_compilers,
    compile_text,
    versions,
)

_COMMENT = re.compile(r"[ \t]*//[^\n]*")


@dataclass(frozen=True)
class ResourceLimits:
    """Largest resources of a kernel that the check accepts.

    Attributes
    ----------
    spills : int
        Spilled registers of a build in single precision on NVIDIA [bytes]: none.
    spills_amd : int
        The same on AMD [bytes]. Its compiler keeps up to 51 of 256 vector registers of the crosses of ``blob.cl`` in
        memory around their loops (gfx1100).
    spills_double : int
        Spilled registers of a build in double precision [bytes]. A double takes two of the 255 registers that a
        work-item of NVIDIA has; the measurement of deposits spills 552 bytes on sm_90. Choose single for speed.
    stack : int
        Private memory of a work-item beside the registers [bytes], chosen: above the largest of
        ``profiling/results/offline-gpus.json`` (4736 bytes for ``blob.cl`` with 64 spokes), and below kernels that keep
        1024 rows or points in private arrays (16 to 29 KB: ``line_fit.cl`` and ``pose.cl`` before their work-groups).
    local : int
        Local memory of a work-group [bytes]: OpenCL guarantees 32 KiB (``CL_DEVICE_LOCAL_MEM_SIZE``), and Mesa's
        llvmpipe has no more.
    """

    spills: int = 0
    spills_amd: int = 256
    spills_double: int = 768
    stack: int = 5 << 10
    local: int = 32 << 10


LIMITS = ResourceLimits()


@dataclass(frozen=True)
class OfflineRow:
    """Result of one kernel of one build for one target.

    Attributes
    ----------
    target, source, case, kernel : str
        Target, kernel file, name of the build, kernel function (empty if the build failed).
    usage : Usage or None
        Resources of the kernel; None if the build failed.
    fault : str
        Reason why the check fails; empty if it passes.
    """

    target: str
    source: str
    case: str
    kernel: str
    usage: Usage | None
    fault: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the columns of the report by name."""
        numbers = {} if self.usage is None else {k: v for k, v in asdict(self.usage).items() if k != "kernel"}
        row = {"target": self.target, "source": self.source, "case": self.case, "kernel": self.kernel, **numbers}
        return row | ({"fault": self.fault} if self.fault else {})


@dataclass(frozen=True)
class OfflineReport:
    """Rows of a check, and the versions of the compilers.

    Attributes
    ----------
    rows : tuple of OfflineRow
    compilers : dict of str to tuple of str
        Versions by target.
    """

    rows: tuple[OfflineRow, ...]
    compilers: dict[str, tuple[str, ...]]

    @property
    def faults(self) -> list[OfflineRow]:
        """Rows that fail the check."""
        return [row for row in self.rows if row.fault]

    def to_json(self) -> str:
        """Return the report as JSON with one line for each row."""
        rows = ",\n  ".join(json.dumps(row.to_dict()) for row in self.rows)
        head = {"limits": asdict(LIMITS), "compilers": self.compilers}
        parts = [f' "{name}": {json.dumps(value)}' for name, value in head.items()]
        return "{\n" + ",\n".join([*parts, f' "rows": [\n  {rows}\n ]']) + "\n}\n"


def check_builds(
    builds: Sequence[KernelBuild],
    targets: Sequence[Target],
    *,
    progress: Callable[[int, int | None], object] = lambda done, total: None,
) -> OfflineReport:
    """Compile builds for targets, two at a time, and compare the resources with `LIMITS`.

    Results are kept in the cache folder by a digest of source, options and compilers.

    Raises
    ------
    GpuVisionError
        A compiler is missing.
    """
    check_compilers(targets)
    pairs = [(build, target) for target in targets for build in builds]
    rows: list[OfflineRow] = []
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        for done, found in enumerate(pool.map(lambda pair: _rows(*pair), pairs), 1):
            rows += found
            progress(done, len(pairs))
    return OfflineReport(tuple(rows), {target.name: versions(target) for target in targets})


def one_build_each(builds: Sequence[KernelBuild]) -> list[KernelBuild]:
    """Return the first build of each kernel file."""
    return list({build.source: build for build in reversed(builds)}.values())[::-1]


def _rows(build: KernelBuild, target: Target) -> list[OfflineRow]:
    try:
        found = _cached_usage(build, target)
    except CompilerError as error:
        return [OfflineRow(target.name, build.source, build.name, "", None, str(error))]
    return [
        OfflineRow(target.name, build.source, build.name, usage.kernel, usage, fault_of(usage, build, target))
        for usage in found
    ]


def fault_of(usage: Usage, build: KernelBuild, target: Target, limits: ResourceLimits = LIMITS) -> str:
    """Return the limit that a kernel exceeds; empty if it exceeds none."""
    most = limits.spills if target.vendor == "nvidia" else limits.spills_amd
    if "REAL_IS_DOUBLE" in build.defines:
        most = limits.spills_double
    if usage.spills > most:
        return f"spills {usage.spills} bytes, limit {most}"
    if usage.stack > limits.stack:
        return f"takes {usage.stack} bytes of stack, limit {limits.stack}"
    if usage.local > limits.local:
        return f"takes {usage.local} bytes of local memory, limit {limits.local}"
    return ""


def _cached_usage(build: KernelBuild, target: Target) -> list[Usage]:
    text, words = kernel_text(build.source), options(build.defines)
    path = cache_path(text, words, target, ".json")
    kept = read_private(path)
    if kept is not None:
        return [Usage(**each) for each in json.loads(kept)]
    found = compile_text(text, words, target)
    write_private(path, json.dumps([asdict(each) for each in found]))
    return found


@functools.cache
def kernel_text(source: str) -> str:
    """Return a kernel file with its headers and without comments, so that a changed comment needs no compilation."""
    return _COMMENT.sub("", flatten_includes(KERNEL_FOLDER, source, ()))
