"""X3P, SUR and SDF files, read back by SurfaceTopography."""

from __future__ import annotations

import datetime
import hashlib
import re
import struct
import zipfile

import numpy as np
import pytest

from gpuvision.formats.surface_files import SURFACE_WRITERS, write_sdf, write_sur, write_x3p
from gpuvision.ranging.height_map import Grid

GRID = Grid(left=-2e-3, top=5e-3, cell_x=20e-6, cell_y=30e-6, columns=7, rows=5)
METRES = {"m": 1.0, "mm": 1e-3, "µm": 1e-6}


@pytest.fixture
def z(rng):
    heights = rng.normal(1e-3, 40e-6, GRID.shape)
    heights[2, 3] = heights[0, 0] = np.nan
    return heights


def read(path):
    """Return heights [m] with NaN in holes, as (x, y) from the first stored row, and the size [m]."""
    from SurfaceTopography.IO import open_topography  # takes seconds; here only the process of these tests imports it

    topography = open_topography(str(path)).topography()
    unit = METRES[topography.unit]
    return np.ma.filled(topography.heights(), np.nan) * unit, np.array(topography.physical_sizes) * unit


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", SURFACE_WRITERS)
def test_surface_topography_reads_heights_holes_and_size(tmp_path, z, name, dtype):
    ending, write = SURFACE_WRITERS[name]
    path = tmp_path / f"map.{ending}"
    write(path, z.astype(dtype), GRID)
    heights, size = read(path)
    rows = z if name == "sur" else z[::-1]
    # SUR: half a step of the integers; the others keep every digit.
    error = 1.3e-3 / 2**30 + 6e-8 * 1.3e-3 if dtype is np.float32 else 1.3e-3 / 2**30
    np.testing.assert_allclose(heights.T, rows, rtol=1e-15, atol=error if dtype is np.float32 or name == "sur" else 0)
    np.testing.assert_allclose(size, [7 * 20e-6, 5 * 30e-6], rtol=1e-7)


def test_an_x3p_states_positions_and_checksums(tmp_path, z):
    write_x3p(tmp_path / "map.x3p", z, GRID)
    with zipfile.ZipFile(tmp_path / "map.x3p") as archive:
        text, points = archive.read("main.xml").decode(), archive.read("bindata/data.bin")
        checksum = archive.read("md5checksum.hex").decode().split()[0]
    assert "<Offset>-0.002</Offset>" in text  # x of the first column
    assert f"<Offset>{5e-3 - 4 * 30e-6!r}</Offset>" in text  # y of the lowest row
    assert hashlib.md5(points).hexdigest().upper() in text
    assert "<CalibrationDate>1970-01-01T00:00:00+00:00</CalibrationDate>" in text
    assert "<Comment>The date of calibration is not known</Comment>" in text
    assert checksum == hashlib.md5(text.encode()).hexdigest().upper()


@pytest.mark.parametrize(("dtype", "stored", "letter"), [(np.float32, "<f4", "F"), (np.float64, "<f8", "D")])
def test_numbers_of_an_x3p_have_the_type_of_the_heights(tmp_path, z, dtype, stored, letter):
    write_x3p(tmp_path / "map.x3p", z.astype(dtype), GRID)
    with zipfile.ZipFile(tmp_path / "map.x3p") as archive:
        text, points = archive.read("main.xml").decode(), archive.read("bindata/data.bin")
    np.testing.assert_array_equal(np.frombuffer(points, stored).reshape(GRID.shape), z[::-1].astype(dtype))
    assert re.findall("<CZ>.*<DataType>(.)</DataType>", text) == [letter]


def test_a_sur_of_holes_and_zeros_can_be_read(tmp_path):
    pair = Grid(left=0, top=0, cell_x=1, cell_y=1, columns=2, rows=1)
    write_sur(tmp_path / "flat.sur", np.array([[0.0, np.nan]]), pair)
    assert (tmp_path / "flat.sur").stat().st_size == 512 + 8
    np.testing.assert_array_equal(read(tmp_path / "flat.sur")[0].T, [[0.0, np.nan]])
    heights = np.array([[-7e-3, 2e-3]])  # the hole's integer is below the smallest height
    write_sur(tmp_path / "low.sur", heights, pair)
    np.testing.assert_allclose(read(tmp_path / "low.sur")[0].T, heights, atol=7e-3 / 2**30)


def test_header_of_a_sur(tmp_path, z):
    """Every number of the header of 512 bytes, at the offsets that Gwyddion reads (surffile.c)."""
    before = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    write_sur(tmp_path / "map.sur", z, GRID)
    after = datetime.datetime.now(datetime.UTC)
    header = (tmp_path / "map.sur").read_bytes()[:512]

    def numbers(kind, offset, count):
        return list(struct.unpack_from(f"<{count}{kind}", header, offset))

    assert header[:12] == b"DIGITAL SURF"
    assert numbers("H", 12, 4) == [0, 1, 1, 2]  # format of a PC, objects, version, kind: surface
    assert numbers("H", 80, 5) == [0, 0, 1, 1, 1]  # material, acquisition, range, holes, absolute heights
    assert numbers("f", 90, 2) == [0.0, 0.0]  # resolution and slope of the gauge
    assert numbers("H", 98, 1) == [32]  # bits
    heights = np.frombuffer((tmp_path / "map.sur").read_bytes()[512:], "<i4")
    stored = heights[heights != heights.min()]
    assert numbers("i", 100, 2) == [min(stored.min(), 0), max(stored.max(), 0)]
    assert heights.min() == min(stored.min(), 0) - 2  # holes
    assert numbers("I", 108, 3) == [7, 5, 35]
    assert numbers("f", 120, 3) == pytest.approx([0.02, 0.03, np.nanmax(z) * 1e6 / 2**30], rel=1e-6)
    texts = [header[place : place + 16].decode("latin-1").rstrip() for place in range(132, 276, 16)]
    assert texts == ["X", "Y", "Z", "mm", "mm", "µm", "mm", "mm", "µm"]
    assert numbers("f", 276, 3) == [1.0, 1.0, 1.0]  # ratios of the units of steps and lengths
    assert numbers("H", 288, 3) == [0, 0, 0]  # imprint, inversion, levelling
    second, minute, hour, day, month, year, weekday = numbers("H", 306, 7)
    written = datetime.datetime(year, month, day, hour, minute, second, tzinfo=datetime.UTC)
    assert before <= written <= after
    assert weekday == int(written.strftime("%w"))
    assert numbers("f", 320, 1) == [0.0]  # duration
    assert numbers("H", 334, 2) == [0, 0]  # sizes of a comment and of a private zone
    assert numbers("f", 466, 3) == pytest.approx([-2.0, 5.0 - 4 * 0.03, 0.0], abs=1e-6)  # offsets


def test_units_of_steps_and_lengths_of_a_sur_are_the_same(tmp_path, z):
    """Spacing and lengths have the same unit: their ratios, three floats at byte 276, are 1."""
    write_sur(tmp_path / "map.sur", z, GRID)
    content = (tmp_path / "map.sur").read_bytes()
    assert [content[180 + 16 * k : 196 + 16 * k].strip() for k in range(6)] == [
        b"mm",
        b"mm",
        "µm".encode("latin-1"),
    ] * 2
    assert struct.unpack_from("<3f", content, 276) == (1.0, 1.0, 1.0)


def test_maps_that_do_not_fit_are_refused(tmp_path, z):
    for write in (write_x3p, write_sur, write_sdf):
        with pytest.raises(ValueError, match=r"the grid has \(5, 7\)"):
            write(tmp_path / "map", z.T, GRID)
    wide = Grid(left=0, top=0, cell_x=1, cell_y=1, columns=65536, rows=1)
    with pytest.raises(ValueError, match="an SDF file holds at most 65535 a side"):
        write_sdf(tmp_path / "map", np.zeros((1, 65536)), wide)
    assert list(tmp_path.iterdir()) == []
