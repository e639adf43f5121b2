"""Readers of files, each with a small valid file as seed: hypothesis (test_readers.py) and run.py mutate the seeds."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpuvision.formats.camera_file import read_lens, read_mounted
from gpuvision.formats.cmos_sensor_file import read_cmos_sensor
from gpuvision.formats.encoder_file import read_encoder
from gpuvision.formats.features_file import read_features
from gpuvision.formats.field_file import read_field
from gpuvision.formats.height_files import ImageScale, read_heights
from gpuvision.formats.known_points_file import read_known_points
from gpuvision.formats.leads_file import read_leads
from gpuvision.formats.loop_recording import read_loop_recording
from gpuvision.formats.machine_file import read_machine
from gpuvision.formats.materials_file import read_materials
from gpuvision.formats.range_image import read_npz, read_ply, read_png16, read_tiff
from gpuvision.host import GpuVisionError, kept_numbers, open_recording, outputs, tuned_settings
from gpuvision.host.array_files import read_array
from gpuvision.host.image_files import read_image
from gpuvision.matching.artwork.artwork import read_artwork
from gpuvision.profiling.stored_run import read_run
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.workflows.light_cache import LightBlock
from gpuvision.workflows.locating_robot import read_points
from gpuvision.workflows.tracking_robot import read_odometry

SEEDS = Path(__file__).parent / "seeds"
LAYERS = {"(copper|pad).gbr": "top copper", "outline.gbr": "mechanical outline", "holes.drl": "drill plated"}
# Small limits: an image or a mesh that a mutation enlarges must not take memory that would hide a fault.
LIMITS = {"GPUVISION_MAX_PIXELS": "1e6", "GPUVISION_MAX_TRIANGLES": "1e4", "GPUVISION_MAX_BOARD_OBJECTS": "1e4"}


@dataclass(frozen=True)
class Reader:
    """Reader of one kind of file.

    Attributes
    ----------
    seed : str
        Name of the seed, and of the file that is read.
    read : callable
        Function that reads the file at a path.
    beside : tuple of str
        Paths of files that are put beside the file, from the folder of the seeds.
    """

    seed: str
    read: Callable[[Path], object]
    beside: tuple[str, ...] = ()

    def content(self) -> bytes:
        """Return the seed."""
        return (SEEDS / self.seed).read_bytes()

    def accepts(self, content: bytes) -> bool:
        """Read a file with this content and return whether it was accepted.

        Raises
        ------
        AssertionError
            The message of the refusal is not one printable line that names the file.
        """
        folder = _folder()
        for each in folder.iterdir():
            each.unlink()
        for name in self.beside:
            shutil.copyfile(SEEDS / name, folder / Path(name).name)
        path = folder / self.seed
        path.write_bytes(content)
        try:
            self.read(path)
        except GpuVisionError as error:
            text = str(error)
            assert text.isprintable(), repr(text)
            assert path.stem in text or folder.name in text, text
            return False
        return True


_FOLDERS: dict[int, tempfile.TemporaryDirectory[str]] = {}


def _folder() -> Path:
    """Return a folder of this process, in memory where the system has such a place."""
    if os.getpid() not in _FOLDERS:
        _FOLDERS[os.getpid()] = tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None)
    return Path(_FOLDERS[os.getpid()].name)


def _frames(path: Path) -> None:
    source = open_recording(path)
    try:
        out, arrived = np.empty((1, *source.shape), source.dtype), np.zeros(1, np.int64)
        while source.wait() and source.read_into(out, arrived):
            pass
    finally:
        source.close()


def _camera(path: Path) -> None:
    read_lens(path)
    read_mounted(path, (480, 640))


def _board(path: Path) -> None:
    read_artwork(path.parent, layers=LAYERS)


_ALL = (
    Reader("frames.npy", _frames),
    Reader("frames.npz", _frames),
    Reader("frames.tif", _frames),
    Reader("packed.tif", _frames),
    Reader("frames.avi", _frames),
    *(Reader(f"image.{kind}", read_image) for kind in ("png", "jpg", "bmp", "pgm", "webp", "tiff")),
    Reader("sensor.toml", Sensor.load),
    *(Reader(f"encoder.{kind}", read_encoder) for kind in ("csv", "npz")),
    Reader("camera.toml", _camera),
    Reader("cmos_sensor.toml", read_cmos_sensor),
    Reader("machine.toml", read_machine),
    Reader("features.toml", read_features),
    Reader("field.toml", read_field),
    Reader("materials.toml", read_materials),
    Reader("copper.gbr", _board, ("beside/outline.gbr", "holes.drl")),
    Reader("holes.drl", _board, ("beside/pad.gbr", "beside/outline.gbr")),
    Reader("board.zip", lambda path: read_artwork(path, layers=LAYERS)),
    *(Reader(f"part.{kind}", Scene.load) for kind in ("stl", "ply", "obj", "glb")),
    Reader("heights.tif", read_tiff),
    Reader("heights.png", read_png16),
    Reader("levels.png", lambda path: read_heights(path, ImageScale(cell_x=1e-5, cell_y=1e-5, step=1e-7))),
    Reader("surface.csv", read_heights),
    Reader("map.npz", read_heights),
    Reader("leads.csv", read_leads),
    Reader("loop.csv", read_loop_recording),
    Reader("odometry.csv", read_odometry),
    Reader("known_points.csv", read_known_points),
    Reader("points.ply", read_ply),
    Reader("result.npz", read_npz),
    Reader("light.npz", LightBlock.from_file),
    Reader("points.csv", read_points),
    Reader("points.npy", read_array),
    Reader("mask.txt", Mask.load),
    Reader("run.json", read_run),
    # Files of ours that nobody writes by hand: damaged entries are left out, without an error.
    Reader("tuned_settings.json", lambda path: tuned_settings._read(path)),
    Reader("kept_numbers.json", lambda path: kept_numbers._read(path)),
    Reader(outputs.MANIFEST, lambda path: list(outputs._files(path.parent))),
)
READERS = {each.seed: each for each in _ALL}
