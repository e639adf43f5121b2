"""Which devices are there, and which of them work."""

from __future__ import annotations

import functools
import hashlib
import json
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyopencl as cl

from gpuvision.host.runtime import cache_folder, expose_installed_runtime, write_whole

INSTALL_HINT = (
    "install one: `apt-get install pocl-opencl-icd` (as root), or `pip install 'gpuvision[cpu]'` "
    "(Intel's CPU runtime, no root needed), or your GPU maker's OpenCL driver"
)
_PROBE_SECONDS = 120
_KINDS = {
    "portable computing language": "pocl",
    "oclgrind": "oclgrind",
    "intel": "intel",
    "nvidia": "nvidia",
    "amd": "amd",
    "apple": "apple",
}


@dataclass(frozen=True)
class Candidate:
    """A device as the OpenCL loader lists it, and the verdict of its probe.

    Attributes
    ----------
    label : str
        Short unique name: the kind (``pocl``, ``intel``, ``nvidia``, ...), with ``:0``, ``:1`` behind it where
        several devices are of one kind. `Device.named` takes it.
    platform_index, device_index : int
        The loader's own indices; platforms may share a name, so a name identifies nothing.
    reason : str
        Why the device is not healthy; empty when it is.
    """

    label: str
    kind: str
    name: str
    platform: str
    driver: str
    is_gpu: bool
    platform_index: int
    device_index: int
    reason: str

    @property
    def healthy(self) -> bool:
        """Whether a kernel was built, launched and checked on the device."""
        return not self.reason

    @property
    def advice(self) -> str:
        """What a user can do about an unhealthy device."""
        if self.healthy:
            return ""
        if self.kind == "pocl" and "unknown target CPU" in self.reason:
            return "this PoCL is too old for the processor; use Debian's: apt-get install pocl-opencl-icd"
        return f"update or remove this driver; meanwhile {INSTALL_HINT}"


def _kind(platform: Any, device: Any) -> str:
    words = f"{platform.name} {platform.vendor} {device.vendor}".lower()
    kind = next((short for word, short in _KINDS.items() if word in words), platform.name.split()[0].lower())
    return f"{kind}-gpu" if kind == "intel" and device.type & cl.device_type.GPU else kind


def _key(platform: Any, device: Any) -> str:
    """Name what a verdict depends on: the driver, the device, and the probe itself."""
    parts = (platform.name, platform.version, device.name, device.driver_version, device.extensions)
    source = Path(__file__).with_name("probe.py").read_bytes()
    return hashlib.sha256(repr(parts).encode() + source).hexdigest()[:24]


def _verdicts_file() -> Path:
    return cache_folder() / "devices.json"


def _read_verdicts() -> dict[str, str]:
    try:
        read = json.loads(_verdicts_file().read_text())
    except (OSError, ValueError):
        return {}
    return read if isinstance(read, dict) else {}


def _ask_probe(platform_index: int, device_index: int) -> str:
    """Run the probe in its own process; a crash or a hang is a verdict too."""
    command = [sys.executable, "-m", "gpuvision.host.probe", str(platform_index), str(device_index)]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return f"the probe kernel did not finish within {_PROBE_SECONDS} s"
    try:
        return str(json.loads(ran.stdout.splitlines()[-1])["reason"])
    except (IndexError, KeyError, ValueError):
        last = (ran.stderr.strip().splitlines() or ["no message"])[-1]
        return f"the runtime ended the probe's process (exit {ran.returncode}: {last[:200]})"


@functools.cache
def platforms() -> tuple[Any, ...]:
    """Return the OpenCL platforms, Intel's pip-installed runtime among them; empty where there are none."""
    expose_installed_runtime()
    try:
        return tuple(cl.get_platforms())
    except cl.Error:  # PLATFORM_NOT_FOUND_KHR is how the loader says "none"
        return ()


def _devices_of(platform: Any) -> list[Any]:
    try:
        return list(platform.get_devices())
    except cl.Error:
        return []


@functools.cache
def candidates(*, probe_again: bool = False) -> tuple[Candidate, ...]:
    """List every device with its verdict.

    A verdict is kept in the user's cache under the driver's version; `probe_again` asks anew where the last
    one was bad. The first call on a machine takes about a second per device.
    """
    known = _read_verdicts()
    fresh: dict[str, str] = {}
    listed = [
        (p, d, platform, device)
        for p, platform in enumerate(platforms())
        for d, device in enumerate(_devices_of(platform))
    ]
    kinds = [_kind(platform, device) for _, _, platform, device in listed]
    count, seen = Counter(kinds), Counter[str]()
    found = []
    for kind, (p, d, platform, device) in zip(kinds, listed, strict=True):
        key = _key(platform, device)
        if key not in known or (probe_again and known[key]):
            known[key] = fresh[key] = _ask_probe(p, d)
        label = kind if count[kind] == 1 else f"{kind}:{seen[kind]}"
        seen[kind] += 1
        is_gpu = bool(device.type & cl.device_type.GPU)
        name, driver = device.name.strip(), device.driver_version
        found.append(Candidate(label, kind, name, platform.name, driver, is_gpu, p, d, known[key]))
    if fresh:
        try:
            write_whole(_verdicts_file(), json.dumps(_read_verdicts() | fresh, indent=1))
        except OSError:
            pass  # an unwritable cache costs a second at the next start, nothing else
    return tuple(found)
