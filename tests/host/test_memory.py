"""Free memory of the machine and of a device."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gpuvision.host.memory import free_bytes

LINUX = "MemTotal:       24000000 kB\nMemAvailable:   3000 kB\nHugePages_Total:  0\n"


@pytest.mark.parametrize(("text", "machine"), [(LINUX, 3000 * 1024), ("MemTotal: 1 kB\n", 24576), ("no table", 24576)])
def test_the_smaller_one_of_machine_and_device(text: str, machine: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the system does not say what is available, the whole memory counts: 6 pages of 4 KiB."""
    monkeypatch.setattr(Path, "read_text", lambda path: text)
    monkeypatch.setattr(os, "sysconf", {"SC_PHYS_PAGES": 6, "SC_PAGE_SIZE": 4096}.__getitem__)
    for memory, expected in ((machine + 1, machine), (machine - 1, machine - 1)):
        device: Any = SimpleNamespace(handle=SimpleNamespace(global_mem_size=memory))
        assert free_bytes(device) == expected
