"""Free memory of the machine and a device."""

from __future__ import annotations

import os
from pathlib import Path

from gpuvision.host.device import Device


def free_bytes(device: Device) -> int:
    """Return the memory that the system can give away without swapping, and the device has, at most [bytes]."""
    device_bytes = int(device.handle.global_mem_size)
    try:
        fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        return min(int(fields["MemAvailable"].split()[0]) << 10, device_bytes)
    except (OSError, KeyError, ValueError):  # not Linux
        return min(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), device_bytes)
