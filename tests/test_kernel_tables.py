"""Parameter tables: the structs of the kernels have the fields of the Python tables, in the same order and widths."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from gpuvision.matching.pose import board_pose, feature_pose, pose
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.ranging.line_launch import LineTable
from gpuvision.ranging.psd import PsdTable
from gpuvision.ranging.regrid import RegridCounts, RegridTable
from gpuvision.ranging.sheet import SheetTable
from gpuvision.ranging.sheet_motion import BentTable, RotatingTable, StraightTable
from gpuvision.simulation.transport.mirror_points import MirrorPoints, TriangleBlocks
from gpuvision.simulation.transport.patches import Patches, PatchTriangle

TRIANGLE = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
NORMALS = np.broadcast_to([0.0, 0.0, 1.0], (1, 3, 3))


def members_of(file: str, struct: str) -> dict[str, int]:
    """Return the names of the members of a struct in a kernel file, and how many numbers each has."""
    source = re.sub(r"//[^\n]*|^#[^\n]*", "", (KERNEL_FOLDER / file).read_text(), flags=re.MULTILINE)
    found = re.search(r"typedef struct \{([^}]*)\} " + struct + ";", source)
    assert found is not None
    members = {}
    for declaration in found[1].split(";"):
        kind, _, names = declaration.strip().partition(" ")
        for name, length in re.findall(r"(\w+)(?:\[(\d+)\])?", names):
            members[name] = (3 if kind == "Fixed" else 1) * int(length or 1)
    return members


def fields_of(file: str, struct: str) -> tuple[str, ...]:
    """Return the names of the members of a struct in a kernel file."""
    return tuple(members_of(file, struct))


@pytest.mark.parametrize(
    ("file", "table"),
    [
        ("line/line.cl", LineTable),
        ("psd/psd.cl", PsdTable),
        ("regrid/regrid.cl", RegridCounts),
        ("regrid/regrid.cl", RegridTable),
        ("common/sheet.h", SheetTable),
    ],
)
def test_struct_has_the_fields_of_the_table(file: str, table: Any) -> None:
    assert fields_of(file, table.__name__) == table._fields


def test_range_table_has_the_limits_and_the_fields_of_the_geometry() -> None:
    fields = fields_of("range_image/range_image.cl", "RangeTable")
    straight = StraightTable._fields
    assert fields == ("low", "high", *straight, *BentTable._fields, *RotatingTable._fields[len(straight) :])
    assert RotatingTable._fields[: len(straight)] == straight


@pytest.mark.parametrize(
    ("file", "struct", "columns"),
    [
        ("board_pose/board_edge.h", "BoardRuler", board_pose.RULER),
        ("board_pose/board_line.h", "BoardLine", board_pose.LINE),
        ("pose/pose_input.h", "PoseRow", (*pose.ROW, "etch_factor")),
        ("feature_pose/feature_view.h", "FeatureRuler", feature_pose.RULER_FEATURE),
        ("feature_pose/feature_view.h", "FeatureFiducial", feature_pose.FIDUCIAL_FEATURE),
        ("feature_pose/feature_view.h", "FeatureView", feature_pose.VIEW),
    ],
)
def test_struct_has_the_columns_of_the_rows(file: str, struct: str, columns: tuple[str, ...]) -> None:
    assert members_of(file, struct) == dict.fromkeys(columns, 1)


@pytest.mark.parametrize(
    "rows",
    [
        MirrorPoints(corners=TRIANGLE, normals=NORMALS, numbers=np.zeros(1, np.int32)).rows(np.zeros(3)),
        TriangleBlocks.of(TRIANGLE, NORMALS).rows(np.zeros(3)),
    ],
    ids=["MirrorTriangle", "MirrorBlock"],
)
def test_struct_of_the_mirrors_has_the_columns_of_the_table(rows: Any) -> None:
    widths = {name: column.size for name, column in rows._asdict().items()}
    assert members_of("mirrors/mirrors.cl", type(rows).__name__) == widths


def test_struct_of_the_patches_has_the_columns_of_the_table() -> None:
    members = members_of("patches/patches.cl", "PatchTriangle")
    assert tuple(members) == PatchTriangle._fields
    triangles, _, _ = Patches(corners=TRIANGLE).tables(np.zeros(3), np.dtype(np.float32))
    assert triangles.shape == (1, sum(members.values()))
