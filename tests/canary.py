"""Arrays between guard bytes: detect kernels that write outside their outputs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_GUARD = 256
_BYTE = 0xA5


class Guarded:
    """Output arrays for ``out=``, each in the middle of a longer one filled with a known byte."""

    def __init__(self, like: Any) -> None:
        self._whole: list[NDArray[np.uint8]] = []
        self.out = type(like)(*(None if each is None else self._array(each) for each in like))

    def _array(self, like: NDArray[Any]) -> NDArray[Any]:
        guarded = np.full(like.nbytes + 2 * _GUARD, _BYTE, np.uint8)
        self._whole.append(guarded)
        return guarded[_GUARD : _GUARD + like.nbytes].view(like.dtype).reshape(like.shape)

    def assert_intact(self) -> None:
        """Assert that the guard bytes before and after every output are unchanged."""
        for guarded in self._whole:
            assert (guarded[:_GUARD] == _BYTE).all()
            assert (guarded[-_GUARD:] == _BYTE).all()


def shifted(like: Any, shift: int) -> Any:
    """Return output arrays for ``out=`` that begin `shift` elements after an address that is a multiple of 64."""
    return type(like)(*(None if each is None else _shifted(each, shift) for each in like))


def shifted_copy(of: NDArray[Any], shift: int) -> NDArray[Any]:
    """Return a copy that begins `shift` elements after an address that is a multiple of 64."""
    copy = _shifted(of, shift)
    copy[...] = of
    return copy


def _shifted(like: NDArray[Any], shift: int) -> NDArray[Any]:
    whole = np.zeros(like.size + 64 + shift, like.dtype)
    begin = -whole.ctypes.data % 64 // like.itemsize + shift
    return whole[begin : begin + like.size].reshape(like.shape)
