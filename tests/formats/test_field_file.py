"""Field files (TOML): the fields of the package, and error messages that name the key."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from gpuvision.formats.field_file import FIELDS, read_field
from gpuvision.schema import DescriptionError

TEXT = """
length = 4.0
width = 2.0
[[line]]
from = [-2.0, -0.25]
to = [1.75, 0.5]
[[arc]]
centre = [0.5, 0.25]
radius = 0.75
start_degrees = 90.0
end_degrees = 180.0
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "hall.toml"
    path.write_text(text)
    return path


def test_a_file_is_read(tmp_path: Path) -> None:
    field = read_field(write(tmp_path, TEXT))
    assert (field.length, field.width) == (4.0, 2.0)
    assert field.lines == ((-2.0, -0.25, 1.75, 0.5),)
    assert field.arcs == ((0.5, 0.25, 0.75, math.pi / 2, math.pi),)


@pytest.mark.parametrize("name", FIELDS)
def test_those_that_come_with_the_package(name: str) -> None:
    field = read_field(name)
    assert field.name
    for x0, y0, x1, y1 in field.lines:
        assert max(abs(x0), abs(x1)) <= field.length / 2
        assert max(abs(y0), abs(y1)) <= field.width / 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length = 4.0", "", "'length' is missing"),
        ("width = 2.0", "width = -2.0", "width is -2.0 m, expected a number"),
        ("to = [1.75, 0.5]", "to = [2.0]", r"line\[0\].to is"),
        ("radius", "radios", "is it 'arc"),
        ("end_degrees = 180.0", "end_degrees = 60.0", "start < end"),
    ],
)
def test_messages_name_the_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(DescriptionError, match=message):
        read_field(write(tmp_path, TEXT.replace(old, new, 1)))
