"""Parameter tables: the structs of the kernels have the fields of the Python tables, in the same order."""

from __future__ import annotations

import re
from typing import Any

import pytest

from gpuvision.operation import KERNEL_FOLDER
from gpuvision.ranging.line import LineTable
from gpuvision.ranging.psd import PsdTable
from gpuvision.ranging.range_image import RotatingTable, StraightTable
from gpuvision.ranging.regrid import RegridCounts, RegridTable
from gpuvision.ranging.sheet import SheetTable


def fields_of(file: str, struct: str) -> tuple[str, ...]:
    """Return the names of the members of a struct in a kernel file."""
    source = re.sub(r"//[^\n]*|^#[^\n]*", "", (KERNEL_FOLDER / file).read_text(), flags=re.MULTILINE)
    found = re.search(r"typedef struct \{([^}]*)\} " + struct + ";", source)
    assert found is not None
    return tuple(re.findall(r"(\w+)(?:\[\d+\])?[,;]", found[1]))


@pytest.mark.parametrize(
    ("file", "table"),
    [
        ("line/line.cl", LineTable),
        ("psd/psd.cl", PsdTable),
        ("common/sheet.h", SheetTable),
    ],
)
def test_struct_has_the_fields_of_the_table(file: str, table: Any) -> None:
    assert fields_of(file, table.__name__) == table._fields


def test_range_table_has_the_limits_and_the_fields_of_the_geometry() -> None:
    fields = fields_of("range_image/range_image.cl", "RangeTable")
    assert fields == ("low", "high", *RotatingTable._fields)
    assert RotatingTable._fields[: len(StraightTable._fields)] == StraightTable._fields


@pytest.mark.parametrize(("prefix", "table"), [("COUNT", RegridCounts), ("GRID", RegridTable)])
def test_offsets_are_the_fields_of_the_table(prefix: str, table: Any) -> None:
    source = (KERNEL_FOLDER / "regrid" / "regrid.cl").read_text()
    offsets = {name.lower(): int(at) for name, at in re.findall(rf"#define {prefix}_(\w+) (\d+)", source)}
    assert offsets == {name: n for n, name in enumerate(table._fields)}
