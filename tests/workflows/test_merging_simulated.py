"""Merge of two simulated recordings of one part, by a sensor at either side of the sheet, through files of commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import trimesh

import laser_sensor
from gpuvision.formats.range_image import read_npz
from gpuvision.ranging.merge_heights import DISAGREES, FIRST, SECOND
from gpuvision.status import Status
from mesh_heights import mesh_heights
from scanning import Ran

# A wall from y = 0 to 1.5 mm, 3 mm high: the first sensor (at y < 0) does not see the plate behind it, the second one
# (at y > 0) not the plate before it.
WALL = (0.0, 1.5e-3, 3e-3)


def surfaces() -> dict[str, trimesh.Trimesh]:
    """Return a plate with the wall, and a polished ramp, which reflects the sheet to the wall [m]."""
    plate = trimesh.creation.box((60e-3, 30e-3, 2e-3))
    plate.apply_translation((0.0, 0.0, -1e-3))
    wall = trimesh.creation.box((60e-3, WALL[1] - WALL[0], WALL[2]))
    wall.apply_translation((0.0, 0.5 * (WALL[0] + WALL[1]), 0.5 * WALL[2]))
    outline = [(-4e-3, 0.2e-3), (-2e-3, 0.2e-3), (-4e-3, 2.2e-3)]
    corners = np.array([(x, *each) for x in (1e-3, 6e-3) for each in outline])
    ramp = trimesh.convex.convex_hull(corners)
    joined: Any = trimesh.util.concatenate([plate, wall])
    return {"a_matt": joined, "b_polished": ramp}


@pytest.mark.slow
def test_two_simulated_sensors_are_merged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    parts = surfaces()
    trimesh.Scene(parts).export("part.glb")
    matt, polished = {"name": "matt", "albedo": 0.5}, {"name": "polished", "albedo": 0.08, "mirror": 0.7}
    Path("materials.toml").write_text(tomli_w.dumps({"material": [matt, polished]}))
    truth = laser_sensor.sensor(15.0)
    Path("camera.toml").write_text(tomli_w.dumps(laser_sensor.camera_table(truth)))
    maps = {}
    for name in ("left", "right"):
        table = laser_sensor.sensor_table(truth, (216, 156), (56, 48), turned=name == "right")
        table["light"]["thickness"] = 0.06e-3
        Path(f"{name}.toml").write_text(tomli_w.dumps(table))
        words = ("--sensor", f"{name}.toml", "--materials", "materials.toml", "--profiles", 62, "--out", f"{name}_sim")
        more = ("--paths", "direct,specular,diffuse-specular", "--recording")
        assert Ran(capsys, monkeypatch, "simulate", "part.glb", *words, *more).code == 0
        files = (f"{name}_sim/recording.npy", "--sensor", f"{name}_sim/recording.toml", "--out", name)
        assert Ran(capsys, monkeypatch, "scan", *files).code == 0
        maps[name] = read_npz(Path(name, "range_image.npz"))[0]
    ran = Ran(capsys, monkeypatch, "merge", "left", "right", "--out", "merged")
    assert ran.code == 0, ran.err
    merged, _ = read_npz(Path("merged", "range_image.npz"))
    x, y = (each.ravel() for each in np.meshgrid(merged["map_x"], merged["map_y"]))
    z, sigma, source, status = (merged[f"map_{each}"].ravel() for each in ("z", "sigma", "source", "status"))
    true = mesh_heights(trimesh.util.concatenate(list(parts.values())), x.astype(float), y.astype(float))
    error = (z - true) / sigma
    off_ramp = (np.abs(x) < 8e-3) & ((x < 0.0) | (x > 7e-3))  # in view of both
    plate = np.abs(true) < 1e-9

    # Occlusion is filled: each sensor alone lacks a side of the wall.
    behind = off_ramp & plate & (y > WALL[1] + 0.4e-3) & (y < WALL[1] + 1.4e-3)
    before = off_ramp & plate & (y > -1.4e-3) & (y < -0.4e-3)
    assert np.mean(source[behind] == SECOND) > 0.95
    assert np.mean(source[before] == FIRST) > 0.95
    for one_sided in (behind, before):
        assert np.mean(np.abs(error[one_sided]) < 3.0) > 0.95

    # Both see the rest; the weighted mean is as good as it says, and better than each.
    both = off_ramp & plate & (source == FIRST | SECOND) & ((y < -4e-3) | (y > WALL[1] + 4e-3))
    assert both.sum() > 200
    assert np.mean(np.abs(error[both]) < 3.0) > 0.95
    assert np.median(sigma[both]) < 0.8 * min(np.nanmedian(each["map_sigma"]) for each in maps.values())

    # On the ramp the first sensor reads the line that the ramp throws onto the wall, millimetres too high.
    ramp = (x > 1.5e-3) & (x < 5.5e-3) & (y > -3.7e-3) & (y < -2.3e-3)
    assert np.nanmax(maps["left"]["map_z"]) > WALL[2] + 2e-3
    disagrees = (source & DISAGREES) != 0
    assert ramp.sum() > 50
    assert np.mean(disagrees[ramp]) > 0.95
    assert np.all(status[disagrees] & Status.AMBIGUOUS)
    assert np.all(np.isnan(z[disagrees]))
