"""Base class of the vision operations: their kernels lie in the package's kernel folder."""

from __future__ import annotations

import importlib.resources
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from gpuvision.host import Operation

R = TypeVar("R", bound=tuple[Any, ...])

KERNEL_FOLDER = Path(str(importlib.resources.files("gpuvision.kernels")))
"""Folder of the OpenCL sources of gpuvision. Kernels include headers by their path relative to it."""


class VisionOperation(Operation[R]):
    """Base of the operations whose kernels are shipped with gpuvision."""

    kernel_folder: ClassVar[Path | None] = KERNEL_FOLDER
