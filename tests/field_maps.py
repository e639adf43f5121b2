"""Distance maps of a large and of a small field for the tests."""

from __future__ import annotations

from functools import cache

from gpuvision.formats.field_file import read_field
from gpuvision.host import Device
from gpuvision.matching.field.distance_map import Arc, DistanceMap, Field


@cache
def large(device: Device) -> DistanceMap:
    return DistanceMap(field=read_field("robocup_msl"), cell=0.1, margin=1.0, device=device)


@cache
def small(device: Device, columns: int = 7) -> DistanceMap:
    """Return a field with fewer columns than a block."""
    field = Field(length=0.1 * columns, width=0.9, lines=((-1.0, 0.13, 2.0, 0.41),), arcs=(Arc(0.2, -0.3, 0.5, -1, 2),))
    return DistanceMap(field=field, cell=0.1, max_range=2.0, device=device)
