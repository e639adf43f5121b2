"""Rows of any number through operations that are bound to shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device

Float64 = npt.NDArray[np.float64]
_FEWEST = 16


def run_with_row_padding(operation: Any, device: Device, rows: Float64, *more: Float64) -> Any:
    """Run an operation on rows, filled up to a power of two: it is bound for few shapes only."""
    real = np.float64 if device.has_double else np.float32
    whole = np.full((1 << (max(len(rows), _FEWEST) - 1).bit_length(), rows.shape[1]), np.nan, real)
    whole[: len(rows)] = rows
    result = operation(whole, *(np.ascontiguousarray(each, real) for each in more), device=device)
    return type(result)(*(each[: len(rows)] for each in result))
