"""Operations on arrays with a varying number of rows, with a bounded number of bound shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device

Float64 = npt.NDArray[np.float64]
# Smallest number of rows: fewer bound shapes for small inputs.
_MIN_ROWS = 16


def run_with_row_padding(operation: Any, device: Device, rows: Float64, *more: Float64) -> Any:
    """Run an operation on rows padded with NaN to a power of two, and return the results of the given rows.

    An operation is bound once for each shape. Padding limits the number of shapes to one for each power of two.

    Parameters
    ----------
    operation
        Operation whose first input is (rows, k) and whose outputs have one entry per row.
    device
        Device of the operation.
    rows
        (n, k), first input; converted to float64 where the device has doubles, else to float32.
    more
        Further inputs, not padded.
    """
    real = np.float64 if device.has_double else np.float32
    padded = np.full((1 << (max(len(rows), _MIN_ROWS) - 1).bit_length(), rows.shape[1]), np.nan, real)
    padded[: len(rows)] = rows
    result = operation(padded, *(np.ascontiguousarray(each, real) for each in more), device=device)
    return type(result)(*(each[: len(rows)] for each in result))
