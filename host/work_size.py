"""Work sizes: how a launch divides its elements into work-items and work-groups."""

from __future__ import annotations

from dataclasses import dataclass

Shape = tuple[int, ...]

# Elements of a work-item in kernels that stream: ITEM_SAMPLES in kernels/common/item_samples.h.
ITEM_SAMPLES = 4


@dataclass(frozen=True)
class WorkSize:
    """Division of a launch into work-items.

    Attributes
    ----------
    global_size, local_size : tuple of int
        As in `Launch`.
    each : int
        Elements of one work-item (vector variant) or of one work-group. Default 1.
    vectors : bool
        Whether this is the kernel's vector variant (wide vectors, work-groups of one work-item). Default False.
    """

    global_size: Shape
    local_size: Shape | None
    each: int = 1
    vectors: bool = False


def vector_work(count: int, each: int) -> WorkSize:
    """Return the work size of a vector variant: one work-item, alone in its work-group, per `each` elements.

    The group size is explicit because PoCL may put all work-items into one group, and so on one core.
    """
    return WorkSize((ceil_div(count, each),), (1,), each, vectors=True)


def padded_groups(count: int, group: int) -> WorkSize:
    """Return the work size of one work-item per element in whole groups; the kernel skips items beyond `count`."""
    return WorkSize((round_up(count, group),), (group,))


def padded_rows(rows: int, columns: int, group: int = 64) -> WorkSize:
    """Return the work size of one work-item per cell of a grid; the kernel skips items beyond the last column.

    PoCL compiles a kernel anew for each group size, and without a given size it chooses one by the grid's size.
    """
    return WorkSize((round_up(columns, group), rows), (group, 1))


def strided_groups(count: int, group: int) -> WorkSize:
    """Return the work size of whole groups whose work-items process `ITEM_SAMPLES` elements, a group apart."""
    each = group * ITEM_SAMPLES
    return WorkSize((ceil_div(count, each) * group,), (group,), each)


def fitted_groups(count: int, group: int) -> WorkSize:
    """Return the work size of groups that overlap: the last group moves back to end with the last element.

    Where `count` is below `group`, the group size is 16 or 1: PoCL compiles a kernel anew for each group size.
    """
    each = next(size for size in (group, 16, 1) if size <= min(group, max(count, 1)))
    return WorkSize((round_up(count, each),), (each,), each)


def group_per_element(count: int, group: int) -> WorkSize:
    """Return the work size of one work-group per element."""
    return WorkSize((count * group,), (group,))


def ceil_div(count: int, size: int) -> int:
    """Return the number of parts of `size` that hold `count` elements: count / size, rounded up."""
    return -(-count // size)


def round_up(count: int, multiple: int) -> int:
    """Return the smallest multiple of a number that is not below `count`."""
    return ceil_div(count, multiple) * multiple


def capacity(count: int, least: int = 1) -> int:
    """Return the power of two for arrays of `count` elements in a kernel, not below `least`.

    Powers of two as compile-time sizes keep the number of builds small for inputs of many sizes.
    """
    return max(least, 1 << max(count - 1, 0).bit_length())
