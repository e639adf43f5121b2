"""Arithmetic of PTX instructions on NumPy arrays: one element per work-item."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]

DTYPES: dict[str, np.dtype[Any]] = {
    **{f"{kind}{8 * size}": np.dtype(f"{code}{size}") for kind, code in (("s", "i"), ("u", "u"), ("b", "u"), ("f", "f"))
       for size in (1, 2, 4, 8) if not (kind == "f" and size == 1)},
    "pred": np.dtype(bool),
}  # fmt: skip
_ROUNDED: dict[str, Callable[[Values], Values]] = {
    "rni": np.rint,
    "rzi": np.trunc,
    "rmi": np.floor,
    "rpi": np.ceil,
}
_COMPARED: dict[str, Callable[[Any, Any], Any]] = {
    "eq": operator.eq,
    "ne": operator.ne,
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
    "lo": operator.lt,
    "ls": operator.le,
    "hi": operator.gt,
    "hs": operator.ge,
}
_UNARY: dict[str, Callable[[Values], Values]] = {
    "mov": lambda a: a,
    "cvta": lambda a: a,
    "neg": np.negative,
    "abs": np.abs,
    "not": np.invert,
    "sqrt": np.sqrt,
    "rcp": lambda a: (1 / a).astype(a.dtype),
    "rsqrt": lambda a: (1 / np.sqrt(a)).astype(a.dtype),
    "ex2": np.exp2,
    "lg2": np.log2,
    "popc": lambda a: np.bitwise_count(a).astype(np.uint32),
    "clz": lambda a: _leading_zeros(a),
}
_BINARY: dict[str, Callable[[Values, Values], Values]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": lambda a, b: a / b if a.dtype.kind == "f" else _quotient(a, b),
    "rem": lambda a, b: a - b * _quotient(a, b),
    "min": lambda a, b: np.fmin(a, b),  # of a number and a NaN the number
    "max": lambda a, b: np.fmax(a, b),
    "and": operator.and_,
    "or": operator.or_,
    "xor": operator.xor,
}


def _leading_zeros(a: Values) -> Values:
    bits = 8 * a.dtype.itemsize
    return np.array([bits - int(each).bit_length() for each in a], np.uint32)


def _quotient(a: Values, b: Values) -> Values:
    """Return the quotient rounded towards zero; PTX leaves the quotient by zero open."""
    safe = np.where(b == 0, 1, b).astype(b.dtype)
    floor = a // safe
    return np.asarray(floor + ((a % safe != 0) & ((a < 0) != (safe < 0))), a.dtype)


def _shift(name: str, a: Values, by: Values) -> Values:
    """Shift; by the number of bits or more the result is 0, or the sign."""
    bits = 8 * a.dtype.itemsize
    amount = np.minimum(by, bits - 1).astype(a.dtype)
    if name == "shl":
        return np.where(by < bits, a << amount, 0).astype(a.dtype)
    shifted = a >> amount
    return shifted if a.dtype.kind == "i" else np.where(by < bits, shifted, 0).astype(a.dtype)


def _product(words: tuple[str, ...], a: Values, b: Values) -> Values:
    """Return a product of integers: wide, or the high half."""
    wide = np.dtype(f"{a.dtype.kind}{2 * a.dtype.itemsize}") if a.dtype.itemsize < 8 else np.dtype(object)
    product = a.astype(wide) * b.astype(wide)
    if "wide" in words:
        return product
    return np.asarray(product >> (8 * a.dtype.itemsize)).astype(a.dtype)


def convert(words: tuple[str, ...], a: Values) -> Values:
    """Convert between types (``cvt``), with PTX' saturation of conversions from floating point to integers."""
    target = DTYPES[words[-2]]
    if a.dtype.kind == "f" and target.kind == "f":
        rounding = next((each for each in words if each in _ROUNDED), None)
        return (a if rounding is None else _ROUNDED[rounding](a)).astype(target)
    if a.dtype.kind == "f":
        rounded = _ROUNDED[next(each for each in words if each in _ROUNDED)](a.astype(np.float64))
        bounds = np.iinfo(target)
        inside = np.clip(np.nan_to_num(rounded, nan=0.0), float(bounds.min), float(bounds.max))
        high = inside >= float(bounds.max)  # the bound of 64 bits is no double
        return np.where(high, bounds.max, np.where(high, 0, inside).astype(target)).astype(target)
    return a.astype(target)


def compute(words: tuple[str, ...], given: list[Values]) -> Values:
    """Compute the result of an arithmetic instruction from operands of its type.

    Parameters
    ----------
    words : tuple of str
        Opcode with its suffixes.
    given : list of numpy.ndarray
        Operands.

    Raises
    ------
    NotImplementedError
        The interpreter does not know the opcode, or the instruction saturates (``.sat``).

    Notes
    -----
    A fused multiply-add of floats is computed in double, one of doubles rounds the product and the sum.
    """
    name, a = words[0], given[0]
    if "sat" in words:
        raise NotImplementedError(f"PTX instruction {'.'.join(words)}")
    if name == "cvt":
        return convert(words, a)
    if name in ("shl", "shr"):
        return _shift(name, a, given[1])
    if name in ("mul", "mad") and ("wide" in words or "hi" in words):
        product: Values = _product(words, a, given[1])
        return np.asarray(product + given[2].astype(product.dtype)) if name == "mad" else product
    if name in ("fma", "mad"):
        wide = np.float64 if a.dtype == np.float32 else a.dtype  # the product of two floats is exact in double
        return np.asarray(a.astype(wide) * given[1].astype(wide) + given[2].astype(wide), a.dtype)
    if name == "setp":
        return _comparison(words, given)
    if name in ("selp", "slct"):
        chosen = given[2] if name == "selp" else given[2] >= 0
        return np.where(chosen, a, given[1])
    if name == "bfe":
        return _bit_field(a, given[1], given[2])
    if name == "copysign":
        return np.copysign(given[1], a)
    if name in _UNARY:
        return _UNARY[name](a)
    if name in _BINARY:
        return _BINARY[name](a, given[1])
    raise NotImplementedError(f"PTX instruction {'.'.join(words)}")


def _bit_field(a: Values, begin: Values, length: Values) -> Values:
    """Return `length` bits from bit `begin` on, with the sign of the highest one for a signed type."""
    bits = 8 * a.dtype.itemsize
    left = np.asarray(bits - begin.astype(np.int64) - length.astype(np.int64))
    if ((left < 0) | (length == 0)).any():
        raise NotImplementedError("PTX instruction bfe of a field beyond the number")
    return _shift("shr", _shift("shl", a, left), bits - length.astype(np.int64))


def _comparison(words: tuple[str, ...], given: list[Values]) -> Values:
    """Compare; a comparison with the suffix u holds where one of the numbers is NaN."""
    name, (a, b) = words[1], given[:2]
    if name in ("nan", "num"):
        ordered = (a == a) & (b == b)
        found = ordered if name == "num" else ~ordered
    elif name.endswith("u") and name[:-1] in _COMPARED:
        found = _COMPARED[name[:-1]](a, b) | (a != a) | (b != b)
    else:
        found = _COMPARED[name](a, b) & (a == a) & (b == b)
    if len(given) > 2:
        found = {"and": operator.and_, "or": operator.or_, "xor": operator.xor}[words[2]](found, given[2])
    return np.asarray(found)
