"""List of the OpenCL devices, and whether each of them works."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import pyopencl as cl

from gpuvision.host.cache import cache_folder, provide_cache, read_private, write_private
from gpuvision.host.process import begin_use, check_process
from gpuvision.host.runtime import expose_installed_runtime, pin_workers, request_inline_device
from gpuvision.host.text import printable

INSTALL_HINT = (
    "install one: `apt-get install pocl-opencl-icd` (as root), or `pip install 'gpuvision[cpu]'` "
    "(Intel's CPU runtime, no root needed), or your GPU maker's OpenCL driver"
)
# Time-out of the probe's process [s] (chosen): a first build by a driver on a busy machine is slow.
_PROBE_SECONDS = 120
# Longest reason that is shown [characters] (chosen).
_MAX_REASON = 500
_KEY = re.compile("[0-9a-f]{24}")
_KINDS = {
    "portable computing language": "pocl",
    "oclgrind": "oclgrind",
    "intel": "intel",
    "nvidia": "nvidia",
    "amd": "amd",
    "apple": "apple",
}
_PREFERRED = ("pocl", "intel")
# Drivers that run on GPUs of several makers: the maker's driver comes first.
_GENERIC_GPU_DRIVERS = ("pocl-gpu", "rusticl")
_SIMULATORS = ("oclgrind",)
# Time for which the verdict of a driver that does not answer is kept [s] (chosen): each process would wait for it.
_HANG_KEPT_SECONDS = 3600
_HANG = "did not finish within"
# Reasons of a device or machine that is busy: the next process probes again. 137: the system stopped the process.
_BUSY = re.compile(
    "exit (-9|137):|OUT_OF_RESOURCES|OUT_OF_HOST_MEMORY|MEM_OBJECT_ALLOCATION_FAILURE|DEVICE_NOT_AVAILABLE"
)

# Messages of drivers and compilers where the cache folder or the folder of temporary files is full: probed again, too.
_DISK_FULL = re.compile("No space left on device|disk is full|Disk quota exceeded|File too large")


@dataclass(frozen=True)
class ListedDevice:
    """OpenCL device as the loader lists it, before its probe.

    Attributes
    ----------
    label : str
        Short unique name: the kind (``pocl``, ``intel``, ``nvidia``, ...), followed by ``:0``, ``:1`` where there are
        several devices of one kind. `Device.named` takes it.
    platform_index, device_index : int
        Indices of the loader. Names do not identify a platform, because two platforms may have the same name.
    handle : pyopencl.Device
    key : str
        Hash of the driver, the device and the source of the probe: the key of the cached verdict.
    inline_device : pyopencl.Device or None
        PoCL's second device on the same processor, which runs kernels in the thread that enqueues them.
    """

    label: str
    kind: str
    platform_index: int
    device_index: int
    handle: Any
    key: str
    inline_device: Any

    @property
    def name(self) -> str:
        """Full name of the device."""
        return printable(str(self.handle.name)).strip()

    @property
    def platform(self) -> str:
        """Name of the platform."""
        return printable(str(self.handle.platform.name)).strip()

    @property
    def driver(self) -> str:
        """Version of the driver."""
        return printable(str(self.handle.driver_version)).strip()

    @property
    def is_gpu(self) -> bool:
        """Whether the device is a GPU."""
        return bool(self.handle.type & cl.device_type.GPU)


@dataclass(frozen=True)
class ProbedDevice(ListedDevice):
    """OpenCL device with the verdict of its probe.

    Attributes
    ----------
    reason : str
        Reason why the device is not healthy; empty for a healthy device.
    """

    reason: str

    @property
    def healthy(self) -> bool:
        """Whether the probe built and ran its kernel on the device with correct results."""
        return not self.reason

    @property
    def advice(self) -> str:
        """Advice to the user about an unhealthy device."""
        if self.healthy:
            return ""
        if _HANG in self.reason:
            return (
                "the driver hangs, or the machine is busy; the verdict is kept for an hour: "
                "`gpuvision devices --probe` asks again"
            )
        if _DISK_FULL.search(self.reason):
            return (
                f"free some space in {cache_folder()}, or set XDG_CACHE_HOME to a folder with space, and start again: "
                "the verdict is not kept"
            )
        if _BUSY.search(self.reason):
            return "the device or the machine is busy; start again when it is idle: the verdict is not kept"
        if self.kind == "pocl" and "debian" not in self.driver:
            return (
                "this PoCL does not suit the processor; use Debian's (as root: apt-get install pocl-opencl-icd) "
                "or Intel's runtime (pip install 'gpuvision[cpu]')"
            )
        return f"update or remove this driver; meanwhile {INSTALL_HINT}"

    @property
    def rank(self) -> tuple[int, ...]:
        """Sort key of the preference: GPUs, PoCL, Intel's CPU runtime, other devices, simulators.

        Among GPUs, the vendor's driver precedes a generic driver. Then a discrete GPU precedes an integrated GPU, which
        shares the memory of the host. Then the number of compute units and the size of the memory decide. Compute units
        of different vendors differ in size; ``GPUVISION_DEVICE`` replaces this guess.
        """
        place = _PREFERRED.index(self.kind) if self.kind in _PREFERRED else len(_PREFERRED)
        return (
            not self.is_gpu,
            self.is_gpu and self.kind in _GENERIC_GPU_DRIVERS,
            place + len(_PREFERRED) * (self.kind in _SIMULATORS),
            self.is_gpu and bool(self.handle.host_unified_memory),
            -int(self.handle.max_compute_units),
            -int(self.handle.global_mem_size),
            self.platform_index,
            self.device_index,
        )


class _Verdict(NamedTuple):
    """Verdict of the cache file.

    Attributes
    ----------
    reason : str
        Reason why the device is not healthy; empty for a healthy device.
    until : int or None
        Time at which the verdict expires [s since 1970]; ``None``: with the driver's version.
    """

    reason: str
    until: int | None = None


def kind_of(handle: Any) -> str:
    """Return the kind of a device: ``pocl``, ``pocl-gpu``, ``intel``, ``intel-gpu``, ``nvidia``, ..."""
    words = f"{handle.platform.name} {handle.platform.vendor} {handle.vendor}".lower()
    other = (handle.platform.name.lower().split() or ["unknown"])[0]
    kind = next((short for word, short in _KINDS.items() if word in words), other)
    return f"{kind}-gpu" if kind in ("intel", "pocl") and handle.type & cl.device_type.GPU else kind


def _key(handle: Any, twin: int) -> str:
    """Return the key of a device's verdict; `twin` counts the equal devices listed before it."""
    platform = handle.platform
    parts = (platform.name, platform.version, handle.name, handle.driver_version, handle.extensions, twin)
    source = Path(__file__).with_name("probe.py").read_bytes()
    return hashlib.sha256(repr(parts).encode() + source).hexdigest()[:24]


def _verdicts_file() -> Path:
    return cache_folder() / "devices.json"


def _read_verdicts() -> dict[str, _Verdict]:
    """Return the verdicts of the cache file by key, without expired ones."""
    try:
        read = json.loads(read_private(_verdicts_file()) or "{}")
    except (ValueError, RecursionError):
        return {}
    kept = read.items() if isinstance(read, dict) else ()
    verdicts = {key: _parsed(entry) for key, entry in kept if _KEY.fullmatch(key)}
    return {key: verdict for key, verdict in verdicts.items() if verdict is not None}


def _parsed(entry: Any) -> _Verdict | None:
    """Return the verdict of an entry of the cache file; None where it is damaged or has expired."""
    match entry:
        case str():
            return _Verdict(entry)
        # A later end than a new verdict gets comes from a clock that was set back.
        case [str() as reason, int() as until] if time.time() < until <= time.time() + _HANG_KEPT_SECONDS + 1:
            return _Verdict(reason, until)
    return None


def _keep_verdicts(fresh: Mapping[str, str]) -> None:
    until = int(time.time()) + _HANG_KEPT_SECONDS
    verdicts = _read_verdicts() | {
        key: _Verdict(reason, until if _HANG in reason else None) for key, reason in fresh.items()
    }
    entries = {key: reason if until is None else [reason, until] for key, (reason, until) in verdicts.items()}
    # Without a writable cache the next start probes again, which takes about a second per device.
    with contextlib.suppress(OSError):
        write_private(_verdicts_file(), json.dumps(entries, indent=1))


def _ask_probe(platform_index: int, device_index: int) -> str:
    """Run the probe in a separate process and return its verdict; a crash or a hang is also a verdict."""
    # -P keeps a folder named gpuvision in the working directory from hiding the package.
    command = [sys.executable, "-P", "-m", "gpuvision.host.probe", str(platform_index), str(device_index)]
    try:
        ran = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PROBE_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"the probe kernel {_HANG} {_PROBE_SECONDS} s"
    try:
        return str(json.loads(ran.stdout.splitlines()[-1])["reason"])
    except (IndexError, KeyError, TypeError, ValueError):
        last = (ran.stderr.strip().splitlines() or ["no message"])[-1]
        return f"the runtime ended the probe's process (exit {ran.returncode}: {last[:200]})"


@functools.cache
def platforms() -> tuple[Any, ...]:
    """Return the OpenCL platforms, with Intel's pip-installed runtime; an empty tuple if no platform exists."""
    begin_use()
    provide_cache()
    pin_workers()
    expose_installed_runtime()
    request_inline_device()
    try:
        return tuple(cl.get_platforms())
    except cl.Error:  # PLATFORM_NOT_FOUND_KHR: there is no platform
        return ()


def _devices_of(platform: Any) -> list[Any]:
    try:
        return list(platform.get_devices())
    except cl.Error:
        return []


def _inline_device(devices: Sequence[Any]) -> Any:
    """Return PoCL's device without worker threads, if PoCL also lists its device with worker threads."""
    with_workers = any(each.name.startswith("pthread-") for each in devices)
    return next((each for each in devices if with_workers and each.name.startswith("basic-")), None)


@functools.cache
def listed_devices() -> tuple[ListedDevice, ...]:
    """Return all devices without probing them."""
    found = []
    for p, platform in enumerate(platforms()):
        devices = _devices_of(platform)
        inline = _inline_device(devices)
        found += [(p, d, handle, inline) for d, handle in enumerate(devices) if handle is not inline]
    kinds = [kind_of(handle) for _, _, handle, _ in found]
    count, occurrences, twins = Counter(kinds), Counter[str](), Counter[str]()
    listed = []
    for kind, (p, d, handle, inline) in zip(kinds, found, strict=True):
        label = kind if count[kind] == 1 else f"{kind}:{occurrences[kind]}"
        occurrences[kind] += 1
        first = _key(handle, 0)
        listed.append(ListedDevice(label, kind, p, d, handle, _key(handle, twins[first]), inline))
        twins[first] += 1
    return tuple(listed)


def probed_devices(*, probe_again: bool = False) -> tuple[ProbedDevice, ...]:
    """Return all devices with the verdicts of their probes.

    Parameters
    ----------
    probe_again : bool
        Whether to probe devices again whose cached verdict is bad. Default False.

    Returns
    -------
    tuple of ProbedDevice

    Notes
    -----
    Verdicts are cached in the user's cache folder for each driver version. The first call on a machine takes about a
    second per device. The verdict of a busy device (no memory) or of a full disk is not cached, the verdict of a device
    that does not answer within the time limit for an hour.
    """
    check_process()
    if probe_again:
        _probed_devices.cache_clear()
    return _probed_devices(trust_bad=not probe_again)


@functools.cache
def _probed_devices(*, trust_bad: bool) -> tuple[ProbedDevice, ...]:
    listed = listed_devices()  # first: it makes the cache folder private
    known = {key: reason for key, (reason, _) in _read_verdicts().items() if trust_bad or not reason}
    fresh: dict[str, str] = {}
    for each in listed:
        if each.key not in known:
            fresh[each.key] = _ask_probe(each.platform_index, each.device_index)
    lasting = {key: reason for key, reason in fresh.items() if not _is_passing(reason)}
    if lasting:
        _keep_verdicts(lasting)
    verdicts = known | fresh
    return tuple(_with_verdict(each, _one_line(verdicts[each.key])) for each in listed)


def _is_passing(reason: str) -> bool:
    """Return whether the device may work at the next start: the machine is busy, or a disk is full."""
    return bool(_BUSY.search(reason) or _DISK_FULL.search(reason))


def _one_line(reason: str) -> str:
    """Return a reason of a driver as one line of printable characters."""
    return " ".join(printable(reason).split())[:_MAX_REASON]


def _with_verdict(listed: ListedDevice, reason: str) -> ProbedDevice:
    return ProbedDevice(**{field.name: getattr(listed, field.name) for field in fields(ListedDevice)}, reason=reason)
