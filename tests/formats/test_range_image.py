from __future__ import annotations

import os
import struct
import zlib

import cv2
import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import tifffile
import trimesh
from hypothesis.extra import numpy as hnp

from gpuvision.formats import range_image as export
from gpuvision.ranging.height_map import Grid

GRID = Grid(left=-0.25, top=1.5, cell_x=0.001, cell_y=0.002, columns=7, rows=5)


@pytest.fixture
def z(rng):
    heights = rng.uniform(-0.1, 0.4, GRID.shape)
    heights[1, 2:5] = np.nan
    return heights


def test_a_tiff_holds_metres_and_cells(tmp_path, z):
    export.write_tiff(tmp_path / "map.tiff", z, GRID)
    back = export.read_tiff(tmp_path / "map.tiff")
    np.testing.assert_array_equal(back.z, z.astype(np.float32))
    assert back.grid == GRID
    with tifffile.TiffFile(tmp_path / "map.tiff") as file:
        page = file.pages[0]
        assert page.dtype == np.float32
        # 10 and 5 cells a centimetre.
        assert page.resolution == (10.0, 5.0)
        assert page.resolutionunit == 3
        assert page.tags[42113].value == "nan"


def test_a_tiff_without_a_grid_claims_none(tmp_path, z):
    export.write_tiff(tmp_path / "map.tiff", z)
    back = export.read_tiff(tmp_path / "map.tiff")
    assert back.grid is None
    np.testing.assert_array_equal(np.isnan(back.z), np.isnan(z))


def test_opencv_reads_the_tiff(tmp_path, z):
    export.write_tiff(tmp_path / "map.tiff", z, GRID)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "map.tiff"), cv2.IMREAD_UNCHANGED), z.astype(np.float32))


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(
    z=hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=8),
        elements=st.one_of(st.floats(-1e3, 1e3), st.sampled_from([np.nan, np.inf, -np.inf])),
    )
)
def test_a_png_is_off_by_half_a_step(tmp_path_factory, z):
    path = tmp_path_factory.getbasetemp() / "map.png"
    export.write_png16(path, z, overwrite=True)
    back = export.read_png16(path).z
    good = np.isfinite(z)
    np.testing.assert_array_equal(np.isnan(back), ~good)
    if good.any():
        step = max(np.ptp(z[good]) / 65534, 1e-9)
        # 1e-12: rounding of offset + scale * code in double, for numbers up to 1e3.
        assert np.all(np.abs(back - z)[good] <= step / 2 + 1e-12)
        assert np.min(back[good]) == np.min(z[good])


def test_a_png_is_a_plain_png_that_says_what_its_codes_mean(tmp_path, z):
    export.write_png16(tmp_path / "map.png", z, GRID)
    assert export.read_png16(tmp_path / "map.png").grid == GRID
    encoded = (tmp_path / "map.png").read_bytes()
    at, kinds = 8, []
    while at < len(encoded):
        (length,) = struct.unpack_from(">I", encoded, at)
        body = encoded[at + 4 : at + 8 + length]
        assert struct.unpack_from(">I", encoded, at + 8 + length) == (zlib.crc32(body),)
        kinds.append(body[:4])
        at += length + 12
    assert kinds[0] == b"IHDR"
    assert kinds[-1] == b"IEND"
    codes = cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(codes == 0, np.isnan(z))
    assert codes.max() == 65535
    assert codes[codes > 0].min() == 1


def test_heights_outside_a_pngs_span_are_holes(tmp_path):
    export.write_png16(tmp_path / "map.png", np.array([[-0.1, 0.0, 0.5, 1.0, 1.1]]), low=0.0, high=1.0)
    back = export.read_png16(tmp_path / "map.png").z
    np.testing.assert_array_equal(np.isnan(back), [[True, False, False, False, True]])
    np.testing.assert_allclose(back[0, 1:4], [0.0, 0.5, 1.0], atol=0.5 / 65534)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_ply_stays_organised(tmp_path, rng, dtype):
    x, y, z = rng.normal(size=(3, 4, 6)).astype(dtype)
    x[2, 3] = y[2, 3] = z[2, 3] = np.nan
    intensity = rng.uniform(0, 255, (4, 6)).astype(np.float32)
    status = rng.integers(0, 255, (4, 6)).astype(np.uint8)
    export.write_ply(tmp_path / "points.ply", x, y, z, intensity, status)
    back = export.read_ply(tmp_path / "points.ply")
    for name, array in {"x": x, "y": y, "z": z, "intensity": intensity, "status": status}.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype
    header = (tmp_path / "points.ply").read_bytes().split(b"end_header")[0].decode()
    assert "obj_info num_cols 6\nobj_info num_rows 4\n" in header


def test_other_readers_take_the_ply(tmp_path, rng):
    x, y, z = rng.normal(size=(3, 4, 6)).astype(np.float32)
    export.write_ply(tmp_path / "points.ply", x, y, z, np.ones_like(x))
    np.testing.assert_array_equal(
        trimesh.load(tmp_path / "points.ply").vertices, np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float64)
    )


def test_a_ply_of_valid_points_has_no_nan(tmp_path, rng):
    x, y, z = rng.normal(size=(3, 4, 6)).astype(np.float32)
    z[1, 1:3] = np.nan
    export.write_ply(tmp_path / "points.ply", x, y, z, organised=False)
    back = export.read_ply(tmp_path / "points.ply")
    np.testing.assert_array_equal(back["z"], z[np.isfinite(z)])
    assert "obj_info" not in (tmp_path / "points.ply").read_bytes()[:400].decode("latin-1")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_point_without_x_y_or_z_is_not_valid(tmp_path, rng, bad):
    points = rng.normal(size=(3, 5, 7)).astype(np.float32)
    for axis in range(3):
        points[axis, axis, 2 * axis] = bad
    export.write_ply(tmp_path / "points.ply", *points, organised=False)
    back = export.read_ply(tmp_path / "points.ply")
    valid = [k for k in range(35) if k not in (0, 9, 18)]
    for name, values in zip("xyz", points, strict=True):
        np.testing.assert_array_equal(back[name], values.ravel()[valid])


def test_a_cut_ply_is_refused(tmp_path):
    x = np.zeros((4, 6), np.float32)
    export.write_ply(tmp_path / "points.ply", x, x, x)
    content = (tmp_path / "points.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(content[:-5])
    with pytest.raises(ValueError, match="holds 283 bytes of points, its header says 24 points; it was cut"):
        export.read_ply(tmp_path / "cut.ply")
    (tmp_path / "text.ply").write_bytes(content.replace(b"binary_little_endian", b"ascii"))
    with pytest.raises(ValueError, match="no binary little-endian PLY"):
        export.read_ply(tmp_path / "text.ply")


def test_an_npz_holds_all_arrays_and_their_units(tmp_path, rng):
    arrays = {"x": rng.normal(size=(3, 4)), "status": np.zeros((3, 4), np.uint8)}
    export.write_npz(tmp_path / "all.npz", arrays, {"x": "m", "status": ""})
    back, units = export.read_npz(tmp_path / "all.npz")
    assert units == {"x": "m", "status": ""}
    assert back.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array)
    with pytest.raises(ValueError, match="do not belong together: status"):
        export.write_npz(tmp_path / "all.npz", arrays, {"x": "m"})


def test_an_npz_with_objects_is_refused(tmp_path):
    np.savez(tmp_path / "objects.npz", x=np.array([1, None]), units=np.array('{"x": "m"}'))
    with pytest.raises(
        ValueError, match=r"not a readable NPZ file of arrays and units: Object arrays cannot be loaded"
    ):
        export.read_npz(tmp_path / "objects.npz")


WRITERS = {
    "tiff": lambda path, **how: export.write_tiff(path, np.zeros((2, 2)), **how),
    "png": lambda path, **how: export.write_png16(path, np.zeros((2, 2)), **how),
    "ply": lambda path, **how: export.write_ply(path, *np.zeros((3, 2, 2), np.float32), **how),
    "npz": lambda path, **how: export.write_npz(path, {"x": np.zeros(2)}, {"x": "m"}, **how),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_writer_is_atomic(tmp_path, kind, monkeypatch):
    path = tmp_path / f"image.{kind}"
    WRITERS[kind](path)
    written = path.read_bytes()
    assert os.listdir(tmp_path) == [path.name]

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    path.write_bytes(b"old")
    with pytest.raises(OSError, match=rf"disk full: {len(written)} bytes or more wanted, \d+ bytes free"):
        WRITERS[kind](path, overwrite=True)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == [path.name]
    assert len(written) > 10
    with pytest.raises(FileExistsError, match=f"cannot write {path}: the file exists"):
        WRITERS[kind](path)
    assert path.read_bytes() == b"old"


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist; create it first"):
        WRITERS["tiff"](tmp_path / "nowhere" / "map.tiff")


def test_wrong_arrays_are_refused(tmp_path, z):
    with pytest.raises(ValueError, match="shape \\(35,\\), expected \\(rows, columns\\)"):
        export.write_tiff(tmp_path / "a", z.ravel())
    with pytest.raises(ValueError, match="the grid has \\(5, 7\\)"):
        export.write_png16(tmp_path / "a", z.T, GRID)
    with pytest.raises(ValueError, match=r"low is 2\.0 and high is 1\.0"):
        export.write_png16(tmp_path / "a", z, low=2.0, high=1.0)
    with pytest.raises(ValueError, match="y has shape \\(7, 5\\)"):
        export.write_ply(tmp_path / "a", z, z.T, z)
    with pytest.raises(TypeError, match="intensity is int64"):
        export.write_ply(tmp_path / "a", z, z, z, np.zeros(z.shape, np.int64))
    (tmp_path / "plain.png").write_bytes(cv2.imencode(".png", np.zeros((2, 2), np.uint16))[1].tobytes())
    with pytest.raises(ValueError, match="no 16-bit PNG with Offset and Scale"):
        export.read_png16(tmp_path / "plain.png")
    assert os.listdir(tmp_path) == ["plain.png"]
