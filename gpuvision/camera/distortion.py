"""Interface of distortion models: the methods that triangulation and its fits use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


class Distortion(Protocol):
    """Distortion model; `Lens` and `Camera` are two."""

    def undistort(self, points: npt.ArrayLike, /) -> Float64:
        """Return the ideal positions of measured points (..., 2); NaN where there is no ideal position."""

    def distort(self, points: npt.ArrayLike, /) -> Float64:
        """Return the measured positions of ideal points (..., 2): the inverse of `undistort`."""

    def jacobian(self, points: npt.ArrayLike, /) -> Float64:
        """Return d(ideal) / d(measured), (..., 2, 2), at measured points (..., 2)."""


@dataclass(frozen=True)
class ExchangedAxes:
    """Distortion of points in (row, column) order.

    Parameters
    ----------
    model : Distortion
        Distortion of points in (column, row) order.
    """

    model: Distortion

    def undistort(self, points: npt.ArrayLike, /) -> Float64:
        """Return the ideal positions of measured points (..., 2), both (row, column)."""
        return self.model.undistort(_exchanged(points))[..., ::-1]

    def distort(self, points: npt.ArrayLike, /) -> Float64:
        """Return the measured positions of ideal points (..., 2), both (row, column)."""
        return self.model.distort(_exchanged(points))[..., ::-1]

    def jacobian(self, points: npt.ArrayLike, /) -> Float64:
        """Return d(ideal) / d(measured), (..., 2, 2), at measured points (..., 2), all in the order (row, column)."""
        return self.model.jacobian(_exchanged(points))[..., ::-1, ::-1]


def _exchanged(points: npt.ArrayLike) -> Float64:
    return np.asarray(points, dtype=np.float64)[..., ::-1]
