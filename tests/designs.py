"""All-pairs design: few cases of a product of parameters that still hold every pair of values."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence


def all_pairs(cases: Sequence[Mapping[str, object]]) -> list[int]:
    """Return the indices of cases that hold every pair of values of two parameters that occurs in `cases`.

    Parameters
    ----------
    cases : sequence of mapping of str to object
        Values of the parameters, by name. Values are equal where their texts (`repr`) are.

    Returns
    -------
    list of int
        Indices in ascending order: a greedy choice, the same in every process. With two parameters or fewer each case
        has a unique pair, and all cases are chosen.

    References
    ----------
    D. M. Cohen, S. R. Dalal, M. L. Fredman, G. C. Patton, "The AETG system: an approach to testing based on
    combinatorial design", IEEE Transactions on Software Engineering 23(7), 1997.

    Examples
    --------
    >>> product = [{"a": a, "b": b, "c": c} for a in "xy" for b in "xy" for c in "xy"]
    >>> all_pairs(product)
    [0, 3, 5, 6]
    """
    pairs = [set(_pairs(case)) for case in cases]
    missing = set().union(*pairs)
    chosen = []
    while missing:
        best = max(range(len(cases)), key=lambda k: len(pairs[k] & missing))  # the first of equals
        chosen.append(best)
        missing -= pairs[best]
    return sorted(chosen)


def _pairs(case: Mapping[str, object]) -> Iterator[tuple[tuple[str, str], ...]]:
    values = [(name, repr(value)) for name, value in sorted(case.items())]
    return itertools.combinations(values, 2)
