"""Write the seeds of the readers, a small valid file of each kind: ``PYTHONPATH=.:tests python -m fuzz.make_seeds``."""

from __future__ import annotations

import json
import shutil
import zipfile
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import tifffile
import tomli_w
import trimesh

from fuzz.readers import SEEDS
from gpuvision.camera.camera import Camera
from gpuvision.formats.camera_file import write_lens
from gpuvision.formats.range_image import write_npz, write_ply, write_png16, write_tiff
from gpuvision.host.outputs import MANIFEST
from gpuvision.host.tuned_settings import TunedEntry, TunedSettings
from gpuvision.profiling.run import Probe, Row, Run
from gpuvision.ranging.height_map import Grid

_HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%TF.FileFunction,Copper,L1,Top*%\n%LPD*%\nG01*\n"
_COPPER = """%TA.AperFunction,ComponentPad*%
%ADD10C,0.5*%
%ADD11R,1.2X1.2X0.3*%
%ADD12O,1.2X0.6*%
%ADD13P,1X6X15*%
%AMROUND*1,1,$1,0,0*21,1,$2x2,0.3,0,0,30*4,1,3,0,0,1,0,0,1,0,0,0*%
%ADD14ROUND,0.5X0.4*%
D10*
X1000000Y1000000D02*
X4000000Y1000000D01*
G75*
G03X5000000Y2000000I0J1000000D01*
G01*
D11*
X2000000Y3000000D03*
D12*
X4000000Y3000000D03*
D13*
X2000000Y5000000D03*
%SRX2Y2I1.0J1.0*%
D14*
X4000000Y5000000D03*
%SR*%
%LPC*%
G36*
X6000000Y6000000D02*
X7000000D01*
Y7000000D01*
X6000000Y6000000D01*
G37*
M02*
"""
_OUTLINE = "%ADD10C,0.1*%\nD10*\nX0Y0D02*\nX8000000D01*\nY8000000D01*\nX0D01*\nY0D01*\nM02*\n"
_PAD = "%ADD10C,0.8*%\nD10*\nX2000000Y3000000D03*\nM02*\n"
_HOLES = "M48\nMETRIC,TZ\nFMAT,2\nT1C0.5\nT2C1.0\n%\nG90\nG05\nT1\nX2.0Y3.0\nR2X0.5\nT2\nX2.0Y5.0\nM30\n"
_MATERIALS = """[[material]]
name = "mask"
albedo = 0.3
gloss = {model = "phong", albedo = 0.1, exponent = 40}
[[material]]
albedo = 0.5
roughness = 0.4
"""
_FIELD = """name = "small"
length = 2.0
width = 1.5
[[line]]
from = [-1.0, -0.75]
to = [1.0, -0.75]
[[arc]]
centre = [0.0, 0.0]
radius = 0.3
"""


def main() -> None:
    """Write all seeds."""
    shutil.rmtree(SEEDS)
    (SEEDS / "beside").mkdir(parents=True)
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 255, (3, 8, 12), dtype=np.uint8)
    np.save(SEEDS / "frames.npy", frames)
    np.savez_compressed(SEEDS / "frames.npz", frames=frames)
    tifffile.imwrite(SEEDS / "frames.tif", frames, photometric="minisblack")
    tifffile.imwrite(SEEDS / "packed.tif", frames, photometric="minisblack", compression="zlib")
    writer = cv2.VideoWriter(str(SEEDS / "frames.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (16, 16))
    for level in (50, 100):
        writer.write(np.full((16, 16, 3), level, np.uint8))
    writer.release()
    colour = rng.integers(0, 255, (8, 12, 3), dtype=np.uint8)
    for kind in ("png", "jpg", "bmp", "webp", "tiff"):
        cv2.imwrite(str(SEEDS / f"image.{kind}"), colour)
    cv2.imwrite(str(SEEDS / "image.pgm"), colour[..., 0])
    _write_tables()
    board = {
        "copper.gbr": _HEAD + _COPPER,
        "holes.drl": _HOLES,
        "beside/outline.gbr": _HEAD + _OUTLINE,
        "beside/pad.gbr": _HEAD + _PAD,
    }
    for name, text in board.items():
        (SEEDS / name).write_text(text)
    with zipfile.ZipFile(SEEDS / "board.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("copper.gbr", "beside/outline.gbr", "holes.drl"):
            archive.write(SEEDS / name, Path(name).name)
    box = trimesh.creation.box()
    box.export(SEEDS / "part.stl")
    box.export(SEEDS / "part.ply")
    box.export(SEEDS / "part.obj")
    trimesh.Scene([box, trimesh.creation.icosphere(0)]).export(SEEDS / "part.glb")
    grid = Grid(left=0.0, top=0.0, cell_x=1e-3, cell_y=1e-3, rows=3, columns=4)
    z = np.linspace(0.0, 1e-2, 12).reshape(3, 4).astype(np.float32)
    write_tiff(SEEDS / "heights.tif", z, grid)
    write_png16(SEEDS / "heights.png", z, grid)
    write_ply(SEEDS / "points.ply", z, z, z)
    write_npz(SEEDS / "result.npz", {"z": z}, {"z": "m"})
    cv2.imwrite(str(SEEDS / "levels.png"), (1000 * z).astype(np.uint16))
    (SEEDS / "surface.csv").write_text(_SURFACE)
    (SEEDS / "leads.csv").write_text(_LEADS)
    (SEEDS / "loop.csv").write_text("time,command,measured\n0,0,\n0.001,1e-5,0\n0.002,-2.5e-5,1e-5\n")
    (SEEDS / "odometry.csv").write_text("forward,left,turn\n0.1,0,0.02\n0.12,-5e-3,-0.1\n")
    (SEEDS / "known_points.csv").write_text(_KNOWN_POINTS)
    write_npz(SEEDS / "map.npz", {"map_x": grid.x, "map_y": grid.y, "map_z": z}, dict.fromkeys(_MAP, "m"))
    _write_light(z)
    (SEEDS / "points.csv").write_text("0.5,1.0\n-0.5,2e-1\n0.0,0.3\n")
    (SEEDS / "encoder.csv").write_text("count\n0\n12\n25.5\n")
    np.savez_compressed(SEEDS / "encoder.npz", count=np.arange(5))
    np.save(SEEDS / "points.npy", z.reshape(-1, 2))
    _write_own_files()
    (SEEDS / "mask.txt").write_text("# lower, upper end\n0.0, 1.0\n0.5, 2.0\n")


_MAP = ("map_x", "map_y", "map_z")
_KNOWN_POINTS = """column,row,x,y,z
120.5,200.25,0.0,0.0,0.0
380.0,198.5,0.05,0.0,1e-3
140.0,120.75,0.0,0.0,0.02
"""
_LEADS = "name,x,y,width,height,angle\nA1,1e-3,2e-3,4e-4,2e-4,1.5\nA2,0,0,1e-3,1e-3,0\n"
_SURFACE = """Info
CSV Version,Sensor Count
2,1
End
Part
Frame,Source,Row Count,Column Count
0,0,2,3
Y,0.0,0.5,1.0
0.0,0.1,,0.3
0.5,0.4,0.5,0.6
End
"""


def _write_tables() -> None:
    matrix = ((800.0, 0.0, 320.0), (0.0, 800.0, 240.0), (0.0, 0.0, 1.0))
    camera = Camera(matrix=matrix, distortion=(-0.1, 0.01, *(0.0,) * 12))
    write_lens(
        SEEDS / "camera.toml", camera, {"mount": {"height": 0.5, "tilt_degrees": 30.0}, "image": {"columns": 640}}
    )
    (SEEDS / "materials.toml").write_text(_MATERIALS)
    (SEEDS / "field.toml").write_text(_FIELD)
    presets = Path(__file__).resolve().parents[2] / "gpuvision" / "presets"
    (SEEDS / "sensor.toml").write_bytes((presets / "sensors" / "camera_line.toml").read_bytes())
    (SEEDS / "cmos_sensor.toml").write_bytes((presets / "cameras" / "lupa300.toml").read_bytes())
    (SEEDS / "machine.toml").write_bytes((presets / "machines" / "look_while_place.toml").read_bytes())
    identity = np.eye(3).tolist()
    features = {
        "side": "top",
        "placement": [0.0, 0.0],
        "imaging": _imaging(),
        "predicted": {"sigma_x": 1e-6, "sigma_y": 1e-6, "sigma_theta": 1e-4, "condition": 2.0, "covariance": identity},
        "region": {"least": [0.0, 0.0], "greatest": [0.01, 0.01], "columns_and_rows": [64.0, 64.0]},
        "ruler": [
            {"point": [1e-3, k * 1e-3], "normal": [1.0, 0.0], "spacing": 1e-5, "length": 1e-3, "sigma": 1e-6}
            for k in range(3)
        ],
        "fiducial": [{"point": [5e-3, 5e-3], "radius": 5e-4, "hole": 0.0, "sigma": 1e-6}],
    }
    (SEEDS / "features.toml").write_text(tomli_w.dumps(features))


def _write_own_files() -> None:
    """Write seeds of the files of caches, of outputs and of measurements."""
    driver = ("Portable Computing Language", "OpenCL 3.0", "cpu", "3.1")
    entry = TunedEntry(
        operation="gpuvision.ranging.psd.PsdReadout",
        program="0123456789abcdef",
        dtype="float32",
        size_class=9,
        device="pocl",
        driver=driver,
        version="0.1",
        settings=TunedSettings(strip=4096, inline=True),
        gain=1.5,
    )
    row = Row("psd", "float32/1e6", "pocl", 1e-3, "numba", "0.61", 2e-3, 2.0, 1e-9, None, rounds=7)
    run = Run(
        rows=[row], valid=True, machine={"cores": 2}, probes=[Probe("psd", "pocl", 1e10, 1.1e10, True)], seconds=12.5
    )
    files = {
        "tuned_settings.json": {"format": 2, "entries": [asdict(entry)]},
        "kept_numbers.json": {"0123456789abcdef01234567": 1.5e-3, "89abcdef0123456789abcdef": 2},
        MANIFEST: {"files": {"range.png": {"job": "scan", "size": 1234, "mtime_ns": 1_700_000_000_000_000_000}}},
    }
    for name, tree in files.items():
        (SEEDS / name).write_text(json.dumps(tree, indent=1))
    (SEEDS / "run.json").write_text(run.to_json())


def _imaging() -> dict[str, object]:
    from gpuvision.matching.features.imaging import Imaging

    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in asdict(Imaging(pixel=1e-5)).items()
    }


def _write_light(z: np.ndarray) -> None:
    from gpuvision.simulation.sensors.readings import GroundTruth
    from gpuvision.simulation.sensors.sensor_view import Exposure
    from gpuvision.workflows.light_cache import LightBlock

    truth = GroundTruth(*(z for _ in GroundTruth._fields))
    block = LightBlock({"direct": Exposure(z, z)}, truth, {"segments": np.array([1.0])})
    (SEEDS / "light.npz").write_bytes(block.to_bytes())


if __name__ == "__main__":
    main()
