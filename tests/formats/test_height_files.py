"""Height maps of other programs and sensors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import tifffile

from gpuvision.formats.height_files import HeightMapFile, ImageScale, read_gocator, read_heights
from gpuvision.formats.range_image import read_tiff, write_npz, write_png16, write_tiff
from gpuvision.ranging.height_map import Grid

GRID = Grid(left=-2e-3, top=5e-3, cell_x=20e-6, cell_y=30e-6, columns=4, rows=3)
HEAD = """Info
CSV Version,Sensor Count,Trigger Mode
2,1,0
End
DeviceInfo
ID,Model,Version
13434,311320-2M-01,4.8.2.29
End
"""
SURFACE = (
    HEAD
    + """{section}
Frame,Source,Time,Encoder,Z Encoder,Inputs,Row Count,Column Count,X Offset,Y Offset,Z Offset
12,0,104,0,0,0,3,4,-2.0,4.94,0
Y,-2.000,-1.980,-1.960,-1.940
4.940,0.010,0.020,,0.040
4.970,0.110,NaN,0.130
5.000,0.210,0.220,0.230,-0.240
End
"""
)
EXPECTED = np.array([[0.21, 0.22, 0.23, -0.24], [0.11, np.nan, 0.13, np.nan], [0.01, 0.02, np.nan, 0.04]]) * 1e-3
PROFILE = (
    HEAD
    + """Profile
Frame Count,Column Count,X Offset,Y Offset,Z Offset
2,3,0,0,0
Frame,Source,Time,Encoder,Z Encoder,Inputs,Exposure,Y,Axis,1.0,1.5,2.0
0,0,1,0,0,0,20,7.0,Z,0.1,,0.3
0,0,1,0,0,0,20,7.0,I,200,201,202
1,0,2,0,0,0,20,7.5,Z,0.4,0.5,0.6
1,0,2,0,0,0,20,7.5,I,200,201,202
End
"""
)


@pytest.fixture
def write(tmp_path):
    def written(text):
        (tmp_path / "part.csv").write_text(text)
        return tmp_path / "part.csv"

    return written


@pytest.mark.parametrize("section", ["Surface", "Part"])
def test_a_surface_of_a_gocator(write, section):
    z, grid, sigma, _ = read_heights(write(SURFACE.format(section=section)))
    np.testing.assert_allclose(z, EXPECTED, rtol=1e-12)
    np.testing.assert_allclose([grid.left, grid.top, grid.cell_x, grid.cell_y], [-2e-3, 5e-3, 20e-6, 30e-6], rtol=1e-9)
    assert grid.shape == z.shape
    assert sigma is None


def test_a_surface_of_a_gocator_whose_axes_run_the_other_way(write):
    """The first column of the map is that of the least x, the first row that of the largest y."""
    text = SURFACE.format(section="Part").replace("NaN,0.130", "NaN,0.130,")
    lines = [line.split(",") for line in text.splitlines()]
    first = next(number for number, cells in enumerate(lines) if cells[0] == "Y")
    last = next(number for number, cells in enumerate(lines) if number > first and cells[0] == "End")
    plain, plain_grid = read_gocator(write("\n".join(map(",".join, lines))))
    assert last - first == 1 + len(plain)
    reversed_x = [[cells[0], *cells[:0:-1]] if first <= n < last else cells for n, cells in enumerate(lines)]
    reversed_y = [*lines[: first + 1], *lines[first + 1 : last][::-1], *lines[last:]]
    both = [*reversed_x[: first + 1], *reversed_x[first + 1 : last][::-1], *reversed_x[last:]]
    for turned in (reversed_x, reversed_y, both):
        z, grid = read_gocator(write("\n".join(map(",".join, turned))))
        np.testing.assert_array_equal(z, plain)
        assert grid == plain_grid


def test_profiles_of_a_gocator_without_their_intensity(write):
    z, grid = read_gocator(write(PROFILE))
    np.testing.assert_allclose(z, np.array([[0.4, 0.5, 0.6], [0.1, np.nan, 0.3]]) * 1e-3)
    np.testing.assert_allclose([grid.left, grid.top, grid.cell_x, grid.cell_y], [1e-3, 7.5e-3, 0.5e-3, 0.5e-3])


def test_columns_of_profiles_in_another_order(write):
    """The positions begin after the later one of Y and Axis; a height that is not there may be a dash."""
    text = PROFILE.replace("Exposure,Y,Axis", "Axis,Exposure,Y")
    for number in (7.0, 7.5):
        for kind in "ZI":
            text = text.replace(f"20,{number},{kind}", f"{kind},20,{number}")
    plain, plain_grid = read_gocator(write(PROFILE))
    z, grid = read_gocator(write(text.replace("0.1,,0.3", "0.1,-,0.3")))
    np.testing.assert_array_equal(z, plain)
    assert grid == plain_grid
    for name in ("Y", "Axis"):
        with pytest.raises(ValueError, match="its section Profile has no columns Y and Axis"):
            read_gocator(write(PROFILE.replace(name, "Other")))


def test_a_row_that_begins_like_a_section_is_none(write):
    z, _ = read_gocator(write(SURFACE.format(section="Surface,1,2\nPart")))
    np.testing.assert_allclose(z, EXPECTED, rtol=1e-12)


@pytest.mark.parametrize(("rows", "columns"), [(1, 4), (4, 1), (1, 2), (2, 1)])
def test_one_row_or_column_has_square_cells(write, rows, columns):
    x, y = -2.0 + 0.02 * np.arange(columns), 5.0 - 0.02 * np.arange(rows)
    table = [["Y", *x], *([place, *np.full(columns, 0.5)] for place in y)]
    text = HEAD + "Surface\nFrame\n0\n" + "\n".join(",".join(map(str, row)) for row in table) + "\nEnd\n"
    z, grid = read_gocator(write(text))
    np.testing.assert_array_equal(z, np.full((rows, columns), 0.5e-3))
    np.testing.assert_allclose([grid.cell_x, grid.cell_y, grid.left, grid.top], [2e-5, 2e-5, -2e-3, 5e-3])
    with pytest.raises(ValueError, match="1 rows of 1 heights, expected a height map"):
        read_gocator(write(HEAD + "Surface\nFrame\n0\nY,1.0\n2.0,0.5\nEnd\n"))


def test_positions_deviate_by_a_tenth_of_a_cell_at_most(tmp_path):
    z = np.zeros((5, 6))
    x, y = 1e-3 + 1e-4 * np.arange(6.0), 2e-3 - 1e-4 * np.arange(5.0)
    for axis, positions in (("x", x), ("y", y)):
        for part, is_even in ((0.098, True), (-0.098, True), (0.102, False), (-0.102, False)):
            moved = positions.copy()
            moved[2] += part * 1e-4  # the ends stay: so does the mean step
            held = {"map_x": x, "map_y": y, "map_z": z} | {f"map_{axis}": moved}
            write_npz(tmp_path / "map.npz", held, dict.fromkeys(held, "m"), overwrite=True)
            if is_even:
                assert read_heights(tmp_path / "map.npz").grid.cell_x == pytest.approx(1e-4)
                continue
            with pytest.raises(ValueError, match=f"positions in {axis} are not evenly spaced"):
                read_heights(tmp_path / "map.npz")
    for axis, positions in (("x", x[::-1]), ("y", y[::-1])):
        held = {"map_x": x, "map_y": y, "map_z": z} | {f"map_{axis}": positions}
        write_npz(tmp_path / "map.npz", held, dict.fromkeys(held, "m"), overwrite=True)
        with pytest.raises(ValueError, match=f"positions in {axis} are not evenly spaced"):
            read_heights(tmp_path / "map.npz")


def test_noise_and_phase_of_a_height_together(tmp_path):
    """The phase counts where it is known; without noise there is no sum."""
    sigma = np.array([[3e-6, 5e-6], [1e-6, 8e-6]], np.float32)
    phase = np.array([[4e-6, 12e-6], [np.nan, 15e-6]], np.float32)
    found = HeightMapFile(np.zeros((2, 2)), GRID, sigma, phase).total_sigma
    np.testing.assert_allclose(found, [[5e-6, 13e-6], [1e-6, 17e-6]], rtol=1e-6)
    assert found.dtype == np.float32
    assert HeightMapFile(np.zeros((2, 2)), GRID, sigma).total_sigma is sigma
    assert HeightMapFile(np.zeros((2, 2)), GRID, None, phase).total_sigma is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\nPart\n", "\nRange\n", "no section Surface, Part or Profile"),
        ("0.210,", "0.210,9,", "a row of 5 heights, expected 4"),
        ("4.970,", "4.980,", "positions in y are not evenly spaced"),
        ("-1.980", "-1.970", "positions in x are not evenly spaced"),
        ("-1.980", "left", "not a readable CSV file of a Gocator: could not convert string to float: 'left'"),
        ("4.970,", "nan,", "a position is not a finite number"),
        ("Y,-2.000,-1.980,-1.960,-1.940\n", "End\n", "0 rows of 0 heights, expected a height map"),
        ("5.000,0.210,0.220,0.230,-0.240\nEnd\n", "", "does not end with End; the file was cut"),
        (",-0.240\nEnd\n", "", "does not end with End; the file was cut"),
    ],
)
def test_damaged_gocator_files_are_refused(write, old, new, message):
    text = SURFACE.format(section="Part")
    assert text.count(old) == 1
    path = write(text.replace(old, new))
    with pytest.raises(ValueError, match=message) as raised:
        read_gocator(path)
    assert str(path) in str(raised.value)


def test_a_gocator_file_beyond_a_limit_is_refused(write, monkeypatch):
    monkeypatch.setenv("GPUVISION_MAX_PIXELS", "8")
    with pytest.raises(ValueError, match="4 x 3 pixels, expected at most 8"):
        read_gocator(write(SURFACE.format(section="Part")))
    with pytest.raises(ValueError, match="a line of 4194304 characters or more"):
        read_gocator(write("," * (1 << 23)))


def test_a_16_bit_image_with_a_scale(tmp_path):
    levels = np.array([[0, 1, 2], [3, 40000, 65535]], np.uint16)
    cv2.imwrite(str(tmp_path / "map.png"), levels)
    z, grid, *_ = read_heights(tmp_path / "map.png", ImageScale(cell_x=10e-6, cell_y=20e-6, step=-1e-7, offset=5e-3))
    np.testing.assert_allclose(z, [[np.nan, 5e-3 - 1e-7, 5e-3 - 2e-7], [5e-3 - 3e-7, 1e-3, 5e-3 - 6.5535e-3]])
    assert grid == Grid(left=0.0, top=20e-6, cell_x=10e-6, cell_y=20e-6, columns=3, rows=2)
    z, *_ = read_heights(tmp_path / "map.png", ImageScale(cell_x=1.0, cell_y=1.0, step=1.0, hole=float("nan")))
    np.testing.assert_array_equal(z, levels)
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(ValueError, match="a colour image"):
        read_heights(tmp_path / "colour.png", ImageScale(cell_x=1.0, cell_y=1.0, step=1.0))
    with pytest.raises(ValueError, match=r"ImageScale\.step is 0"):
        ImageScale(cell_x=1.0, cell_y=1.0, step=0.0)


def test_the_files_of_a_scan(tmp_path, rng):
    z = rng.normal(size=GRID.shape)
    z[1, 1] = np.nan
    write_tiff(tmp_path / "map.tiff", z, GRID)
    write_png16(tmp_path / "map.png", z, GRID)
    held = {"map_x": GRID.x, "map_y": GRID.y, "map_z": z}
    write_npz(tmp_path / "map.npz", held | {"map_sigma": abs(z)}, dict.fromkeys([*held, "map_sigma"], "m"))
    for name, error in (("map.tiff", 1e-6), ("map.png", 1e-4), ("map.npz", 0.0)):
        found = read_heights(tmp_path / name)
        np.testing.assert_allclose(found.z, z, atol=error)
        np.testing.assert_allclose([found.grid.left, found.grid.top], [GRID.left, GRID.top])
        np.testing.assert_allclose([found.grid.cell_x, found.grid.cell_y], [GRID.cell_x, GRID.cell_y])
        assert (found.sigma is not None) == (name == "map.npz")
    write_tiff(tmp_path / "bare.tiff", z)
    with pytest.raises(ValueError, match="states no grid"):
        read_heights(tmp_path / "bare.tiff")
    write_npz(tmp_path / "bad.npz", held | {"map_x": GRID.y}, dict.fromkeys(held, "m"))
    with pytest.raises(ValueError, match="one row per map_y"):
        read_heights(tmp_path / "bad.npz")
    with pytest.raises(ValueError, match="states its scale"):
        read_heights(tmp_path / "map.npz", ImageScale(cell_x=1.0, cell_y=1.0, step=1.0))
    with pytest.raises(ValueError, match="a folder"):
        read_heights(tmp_path)


def test_a_scale_for_a_file_with_a_grid_is_refused(tmp_path, rng):
    scale = ImageScale(cell_x=1.0, cell_y=1.0, step=5.0)
    for name, write in (("map.tiff", write_tiff), ("map.png", write_png16)):
        write(tmp_path / name, rng.normal(size=GRID.shape), GRID)
        with pytest.raises(ValueError, match=rf"{name}: the file states its scale"):
            read_heights(tmp_path / name, scale)
    tifffile.imwrite(tmp_path / "levels.tiff", np.arange(12, dtype=np.uint16).reshape(3, 4), description="a camera")
    assert np.nanmax(read_heights(tmp_path / "levels.tiff", scale).z) == 55.0


def test_a_tiff_of_another_quantity_is_refused(tmp_path, rng):
    write_tiff(tmp_path / "sigma.tiff", rng.normal(size=GRID.shape), GRID, quantity="random sigma of height")
    with pytest.raises(ValueError, match=r"sigma\.tiff: its values are the random sigma of height, expected heights"):
        read_heights(tmp_path / "sigma.tiff")
    write_tiff(tmp_path / "escape.tiff", rng.normal(size=GRID.shape), GRID, quantity="\x1b[2Jsigma\x7f")
    with pytest.raises(ValueError, match=r"escape\.tiff: its values are the sigma\?, expected heights"):
        read_tiff(tmp_path / "escape.tiff")
    tifffile.imwrite(tmp_path / "colour.tiff", np.zeros((3, 4, 3), np.uint8), photometric="rgb", description="{}")
    with pytest.raises(ValueError, match=r"colour\.tiff: an image of shape \(3, 4, 3\)"):
        read_tiff(tmp_path / "colour.tiff")
    tifffile.imwrite(tmp_path / "complex.tiff", np.zeros((3, 4), np.complex64), description="{}")
    with pytest.raises(ValueError, match=r"complex\.tiff: an image of shape \(3, 4\) and type complex64"):
        read_tiff(tmp_path / "complex.tiff")


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"map_x": np.full(4, np.nan)}, "a position of map_x or map_y is not a finite number"),
        ({"map_y": np.full(3, np.inf)}, "a position of map_x or map_y is not a finite number"),
        ({"map_x": np.zeros((4, 1))}, "map_z has shape"),
        ({"map_y": np.zeros((3, 1))}, "map_z has shape"),
        ({"map_z": np.zeros((3, 4, 1))}, "map_z has shape"),
        ({"map_z": np.zeros((3, 5))}, "map_z has shape"),
        ({"map_sigma": np.zeros((3, 5))}, "map_z has shape"),
        ({"map_phase": np.zeros((2, 4))}, "map_z has shape"),
        ({"map_z": np.full(GRID.shape, "high")}, "map_z has the type <U4, expected real numbers"),
        ({"map_z": np.zeros(GRID.shape, complex)}, "map_z has the type complex128, expected real numbers"),
        ({"map_sigma": np.zeros(GRID.shape, bool)}, "map_sigma has the type bool, expected real numbers"),
    ],
)
def test_a_bad_npz_of_a_scan_is_refused(tmp_path, bad, message):
    held = {"map_x": GRID.x, "map_y": GRID.y, "map_z": np.zeros(GRID.shape)} | bad
    write_npz(tmp_path / "bad.npz", held, dict.fromkeys(held, "m"))
    with pytest.raises(ValueError, match=rf"bad\.npz: {message}"):
        read_heights(tmp_path / "bad.npz")
