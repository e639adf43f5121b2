"""CSV files of the regions of leads."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.formats.leads_file import read_leads


def test_rectangles_with_and_without_an_angle(tmp_path):
    path = tmp_path / "leads.csv"
    path.write_text("name,x,y,width,height,angle\nA1,1e-3,2e-3,4e-4,2e-4,1.5707963267948966\n\n,0,0,1e-3,1e-3,0\n")
    first, second = read_leads(path)
    assert (first.name, second.name) == ("A1", "3")
    np.testing.assert_allclose(first.bounds, [[0.9e-3, 1.8e-3], [1.1e-3, 2.2e-3]])
    np.testing.assert_allclose([first.area, second.area], [8e-8, 1e-6])
    path.write_text("name,x,y,width,height\nA1,1e-3,2e-3,4e-4,2e-4\n")
    np.testing.assert_allclose(read_leads(path)[0].bounds, [[0.8e-3, 1.9e-3], [1.2e-3, 2.1e-3]])


def test_an_angle_turns_counter_clockwise(tmp_path):
    """The longer side lies along the angle; corners are in order, from the lower left one."""
    path = tmp_path / "leads.csv"
    path.write_text("name, x, y, width, height, angle\nA1,3e-3,-2e-3,5e-4,1e-4,0.6435011087932844\n")
    along, up = 2.5e-4 * np.array([0.8, 0.6]), 0.5e-4 * np.array([-0.6, 0.8])
    corners = [(3e-3, -2e-3) + a * along + b * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    (region,) = read_leads(path)
    np.testing.assert_allclose(region.shapes[0].outline, corners, rtol=0, atol=1e-15)
    np.testing.assert_allclose(region.centroid, [3e-3, -2e-3], rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n", "the header is not name,x,y,width,height"),
        ("name,x,y,width,height\n", "no lead; expected one line for each lead"),
        ("name,x,y,width,height\nA,1,2,3\n", "line 2 has 4 cells, expected 5"),
        ("name,x,y,width,height\nA,1,2,3,0\n", "line 2: expected finite numbers and sides above 0"),
        ("name,x,y,width,height\nA,1,2,0,3\n", "line 2: expected finite numbers and sides above 0"),
        ("name,x,y,width,height\nA,1,2,-3,-1\n", "line 2: expected finite numbers and sides above 0"),
        ("name,x,y,width,height,angle\nA,1,2,3,1,inf\n", "line 2: expected finite numbers and sides above 0"),
        ("name,x,y,width,height,turn\nA,1,2,3,1,0\n", r"the header is not name,x,y,width,height\[,angle\]"),
        ("name,x,y,width,height,angle\nA,1,2,3,1\n", "line 2 has 5 cells, expected 6"),
        ("name,x,y,width,height\nA,1,nan,3,1\n", "line 2: expected finite numbers"),
        ("name,x,y,width,height\nA,1,2,3,1\nA,4,2,3,1\n", "line 3: the name 'A' already stands in line 2"),
        ("name,x,y,width,height\n2,1,2,3,1\n,4,2,3,1\n", "line 3: the name '2' already stands in line 2"),
        ("name,x,y,width,height\nA,1,two,3,1\n", "not a readable CSV file of leads: could not convert"),
    ],
)
def test_damaged_files_are_refused(tmp_path, text, message):
    path = tmp_path / "leads.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        read_leads(path)
    assert str(path) in str(raised.value)


def test_too_many_leads_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("GPUVISION_MAX_LEADS", "2")
    path = tmp_path / "leads.csv"
    path.write_text("name,x,y,width,height\n" + ",1,2,3,4\n" * 2)
    assert [each.name for each in read_leads(path)] == ["1", "2"]
    path.write_text("name,x,y,width,height\n" + ",1,2,3,4\n" * 3)
    with pytest.raises(ValueError, match="3 leads or more, expected at most 2"):
        read_leads(path)
