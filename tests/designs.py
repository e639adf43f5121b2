"""Covering designs: few cases of a product of parameters that still hold every value, or every pair of values."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet

Combination = tuple[tuple[str, str], ...]
"""Names and texts of the values of some parameters."""


def covering(
    cases: Sequence[Mapping[str, object]], strength: int, *, held: AbstractSet[Combination] = frozenset()
) -> list[int]:
    """Return the indices of cases that hold every combination of values of `strength` parameters in `cases`.

    Parameters
    ----------
    cases : sequence of mapping of str to object
        Values of the parameters, by name. Values are equal where their texts (`repr`) are.
    strength : int
        1: every value of each parameter; 2: every pair of values of two parameters.
    held : set of tuple, optional
        Combinations that other cases hold, see `combinations`: this design need not hold them.

    Returns
    -------
    list of int
        Indices in ascending order: a greedy choice, the same in every process.

    References
    ----------
    D. M. Cohen, S. R. Dalal, M. L. Fredman, G. C. Patton, "The AETG system: an approach to testing based on
    combinatorial design", IEEE Transactions on Software Engineering 23(7), 1997.

    Examples
    --------
    >>> product = [{"a": a, "b": b, "c": c} for a in "xy" for b in "xy" for c in "xy"]
    >>> covering(product, 2)
    [0, 3, 5, 6]
    >>> covering(product, 1)
    [0, 7]
    >>> covering(product, 1, held={(("a", repr("x")),), (("b", repr("x")),), (("c", repr("x")),)})
    [7]
    """
    of_case = [set(combinations(case, strength)) for case in cases]
    missing = set().union(*of_case) - held
    chosen = []
    while missing:
        best = max(range(len(cases)), key=lambda k: len(of_case[k] & missing))  # the first of equals
        chosen.append(best)
        missing -= of_case[best]
    return sorted(chosen)


def combinations(case: Mapping[str, object], strength: int) -> Iterator[Combination]:
    """Yield the combinations of values of `strength` parameters in a case, as names and texts."""
    values = [(name, repr(value)) for name, value in sorted(case.items())]
    return itertools.combinations(values, strength)
