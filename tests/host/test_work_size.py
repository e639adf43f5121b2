"""Work sizes: every element has a work-item, and no group is empty."""

from __future__ import annotations

import pytest

from gpuvision.host.work_size import (
    WorkSize,
    capacity,
    ceil_div,
    fitted_groups,
    group_per_element,
    padded_groups,
    padded_rows,
    round_up,
    strided_groups,
    vector_work,
)

COUNTS = (0, 1, 15, 16, 17, 63, 64, 65, 255, 256, 257, 1000)


@pytest.mark.parametrize("size", [1, 3, 16, 64])
def test_parts_hold_all_elements(size: int) -> None:
    for count in COUNTS:
        parts = ceil_div(count, size)
        assert (parts - 1) * size < count <= parts * size
        assert round_up(count, size) == parts * size


def test_capacity_is_the_next_power_of_two() -> None:
    assert [capacity(count) for count in (0, 1, 2, 3, 4, 5, 64, 65)] == [1, 1, 2, 4, 4, 8, 64, 128]
    assert [capacity(count, least=16) for count in (0, 16, 17)] == [16, 16, 32]


def test_divisions_into_groups() -> None:
    assert vector_work(33, 16) == WorkSize((3,), (1,), 16, vectors=True)
    assert padded_groups(65, 64) == WorkSize((128,), (64,))
    assert padded_rows(3, 65) == WorkSize((128, 3), (64, 1))
    assert strided_groups(256, 64) == WorkSize((64,), (64,), 256)
    assert strided_groups(257, 64) == WorkSize((128,), (64,), 256)
    assert group_per_element(5, 64) == WorkSize((320,), (64,))


@pytest.mark.parametrize(
    ("count", "expected"), [(0, 1), (1, 1), (15, 1), (16, 16), (17, 16), (63, 16), (64, 64), (65, 64)]
)
def test_overlapping_groups_are_not_larger_than_the_elements(count: int, expected: int) -> None:
    assert fitted_groups(count, 64) == WorkSize((round_up(count, expected),), (expected,), expected)
    assert fitted_groups(count, 8).local_size == ((8,) if count >= 8 else (1,))
