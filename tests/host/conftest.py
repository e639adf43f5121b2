"""Memory paths for the stream tests, a small file system, and a check for threads that outlive a test."""

from __future__ import annotations

import copy
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gpuvision.host import Device


@pytest.fixture(params=["shared", "staged", "separate"])
def memory(request: pytest.FixtureRequest, device: Device) -> dict[str, Any]:
    """Options for a device and a memory path: shared, copied within shared memory, or copied to separate memory."""
    if request.param == "separate":
        device = copy.copy(device)
        device.shares_memory = False
    elif request.param == "shared" and not device.shares_memory:
        pytest.skip(f"{device.label} does not share memory with the host")
    return {"device": device, "zero_copy": request.param == "shared"}


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    """No test may leave the stream's thread behind."""
    yield
    left = [thread.name for thread in threading.enumerate() if thread.name == "gpuvision stream"]
    assert not left


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield the folder of a file system of 64 KiB."""
    folder = tmp_path / "small"
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True, check=False)
    if done.returncode:
        pytest.skip("only root mounts a small file system")
    yield folder
    subprocess.run(["umount", folder], check=True)
