"""Simulation of a part and a sensor: readings, errors, causes; interrupted runs continue."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sys
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from error_maps import errors_of
from gpuvision.cli import main as cli
from gpuvision.formats.range_image import read_npz
from gpuvision.host import Device
from gpuvision.host.errors import RecordingError
from gpuvision.ranging.range_image import StraightTransport
from gpuvision.ranging.sheet import BentSheet
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import require_light
from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.readings import PATHS, GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.workflows import light_cache, simulating
from gpuvision.workflows.light_cache import (
    PROFILES_PER_BLOCK,
    LightStore,
    compute_missing_blocks,
    make_light_paths,
)
from gpuvision.workflows.simulating import load_part, prepare_simulation, simulate

MM = 1e-3


def mesh() -> trimesh.Trimesh:
    """Return a plate with a block on it; the block reflects secondary light to the plate."""
    plate = trimesh.creation.box((40 * MM, 20 * MM, 2 * MM))
    plate.apply_translation((0, 0, -1 * MM))
    block = trimesh.creation.box((10 * MM, 8 * MM, 5 * MM))
    block.apply_translation((4 * MM, 0, 2.5 * MM))
    joined: Any = trimesh.util.concatenate([plate, block])
    made: trimesh.Trimesh = joined
    return made


@pytest.fixture(scope="module")
def part_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("part") / "part.stl"
    mesh().export(path)
    return path


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Common cache of the tests: the light of 40 profiles, computed once."""
    return tmp_path_factory.mktemp("light")


def task_of(part_file: Path, sensor: str = "psd_line", **more: Any) -> Any:
    part, materials = load_part(part_file, 1.0, None, 0.5)
    return prepare_simulation(part, materials, Sensor.load(sensor), **({"profiles": 40} | more))


def test_the_limit_is_five_sigmas_or_the_tolerance() -> None:
    """The median of the known sigmas, 3 um."""
    reading: Any = SimpleNamespace(sigma=np.array([[1e-6, np.nan, 3e-6], [np.inf, 9e-6, np.nan]]))
    for tolerance, limit in ((1e-6, 15e-6), (16e-6, 16e-6)):
        task: Any = SimpleNamespace(tolerance=tolerance)
        assert simulating._default_limit(reading, task, simulating.SimulationLimits()) == pytest.approx(limit)
    reading.sigma[:] = np.nan
    assert simulating._default_limit(reading, task, simulating.SimulationLimits()) == 16e-6


def test_a_part_is_scanned_from_end_to_end(part_file: Path) -> None:
    task = task_of(part_file, profiles=None)
    # 20 mm of the plate at 0.25 mm a profile; profiles that only touch its ends do not count.
    assert len(task.transports) == 79
    np.testing.assert_allclose(task.transports[[0, -1]], [-9.75 * MM, 9.75 * MM], atol=1e-12)
    # Fewer profiles lie in the middle, at the same places; of an even number one more lies before it.
    for count in (78, 39, 40, 1):
        fewer = task_of(part_file, profiles=count).transports
        first = (79 - count) // 2
        np.testing.assert_array_equal(fewer, task.transports[first : first + count])
    np.testing.assert_array_equal(task_of(part_file, profiles=80).transports, task.transports)


@pytest.mark.parametrize("bend", [0.4, -0.4])
def test_a_bent_sheet_scans_the_whole_part(bend: float) -> None:
    part = Scene.of(trimesh.creation.box((120 * MM, 10 * MM, 2 * MM)))
    sensor = Sensor.load("camera_line")
    assert isinstance(sensor.transport, StraightTransport)
    sheet = BentSheet(terms=(bend, 0.0, 0.0), pinhole=(0.0, 0.15, 0.08))
    sensor = dataclasses.replace(sensor, transport=dataclasses.replace(sensor.transport, bend=sheet))
    task = prepare_simulation(part, [Material(diffuse=Lambert(albedo=0.5))], sensor)
    # L = y + 0.4/m x^2, with -5 mm < y < 5 mm and x up to 60 mm: 1.44 mm more on one side, at 0.25 mm a profile.
    expected = [-4.75 * MM, 6.25 * MM] if bend > 0.0 else [-6.25 * MM, 4.75 * MM]
    np.testing.assert_allclose(task.transports[[0, -1]], expected, atol=1e-12)


@pytest.mark.rendered
def test_what_is_read_is_told_apart_by_cause(part_file: Path, light: Path, tmp_path: Path) -> None:
    done = simulate(task_of(part_file), light, seed=None)
    attribution = done.attribution
    assert attribution.error.shape == (40, 96)
    total = np.sum(list(attribution.causes.values()), axis=0)
    np.testing.assert_allclose(total, attribution.error, atol=1e-12)
    # Secondary light of the block's wall raises the reading of the plate on the side in view of the lens.
    flat = np.abs(attribution.truth.h) < 1e-9
    assert np.nanmax(np.abs(attribution.causes["secondary"][flat])) > 20e-6
    away = flat & (np.abs(attribution.truth.g + 15 * MM) < 2 * MM)
    assert np.nanmax(np.abs(attribution.error[away])) < 20e-6
    done.write(tmp_path)
    arrays, units = read_npz(tmp_path / "simulation.npz")
    np.testing.assert_array_equal(arrays["error"], attribution.error)
    assert units["cause_secondary"] == "m"
    report = json.loads((tmp_path / "report.json").read_text())
    # The path without bounces has a bound; what has none is named.
    assert report["light_statistics"]["bound of multi-bounce left out [m]"] > 0.0
    expected = ["quadrature of indirect light (nodes per bin)", "slabs of the sheet of light (sub_sheets)", "rounding"]
    assert report["not_in_bounds"] == expected
    assert report["errors"]["valid"] == np.isfinite(attribution.error).sum()
    for name in ("errors.png", "causes.png", "picture.png", "range_image.tiff", "range_image.ply"):
        assert (tmp_path / name).stat().st_size > 1000


def test_a_mask_made_for_the_part_helps(part_file: Path, light: Path, tmp_path: Path) -> None:
    task = task_of(part_file)
    without = simulate(task, light, seed=None)
    found = simulate(task, light, seed=None, mask="best")
    assert found.computed_blocks == 0
    assert found.mask is not None
    rms = [np.sqrt(np.nanmean(each.attribution.error**2)) for each in (without, found)]
    assert rms[1] < rms[0]
    found.write(tmp_path)
    again = simulate(task, light, seed=None, mask=Mask.load(tmp_path / "mask.txt"))
    # The mask of another run goes, unless this run read it.
    again.write(tmp_path, inputs=[tmp_path / "mask.txt"])
    assert (tmp_path / "mask.txt").exists()
    again.write(tmp_path)
    assert not (tmp_path / "mask.txt").exists()
    np.testing.assert_allclose(again.attribution.error, found.attribution.error, atol=1e-12)


def test_what_was_stopped_goes_on_where_it_was(part_file: Path, light: Path, tmp_path: Path) -> None:
    task = task_of(part_file)

    def stop(done: int, of: int | None) -> None:
        if done >= 2 * PROFILES_PER_BLOCK:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(task, tmp_path, progress=stop)
    store = LightStore(tmp_path, task)
    assert store.missing() == [2]
    kept = [store.path(k).read_bytes() for k in (0, 1)]
    seen = []
    done = simulate(task, tmp_path, progress=lambda done, of: seen.append((done, of)))
    assert done.computed_blocks == 1
    assert seen == [(32, 40), (40, 40)]
    assert [store.path(k).read_bytes() for k in (0, 1)] == kept
    expected = simulate(task, light)
    np.testing.assert_array_equal(expected.attribution.error, done.attribution.error)
    np.testing.assert_array_equal(expected.attribution.category, done.attribution.category)


def test_half_a_block_counts_as_none(part_file: Path, tmp_path: Path) -> None:
    task = task_of(part_file, profiles=20)
    store = LightStore(tmp_path, task)
    assert compute_missing_blocks(store) == 2
    content = store.path(1).read_bytes()
    store.path(1).write_bytes(content[: len(content) // 2])
    assert store.missing() == [1]
    assert compute_missing_blocks(store) == 1
    assert compute_missing_blocks(store) == 0
    np.savez(store.path(1), light=np.zeros(3))
    with pytest.raises(RecordingError, match=r"block_00001\.npz: holds no simulated light; delete it"):
        list(store)


def test_another_task_has_other_light(part_file: Path) -> None:
    one = task_of(part_file)
    assert task_of(part_file).fingerprint == one.fingerprint
    others = [
        task_of(part_file, tolerance=1e-6),
        task_of(part_file, paths=("direct",)),
        task_of(part_file, profiles=39),
        task_of(part_file, sensor="camera_line"),
        dataclasses.replace(one, materials=load_part(part_file, 1.0, None, 0.4)[1]),
        dataclasses.replace(one, part=load_part(part_file, 1.001, None, 0.5)[0]),
    ]
    assert len({each.fingerprint for each in (one, *others)}) == 1 + len(others)
    light = dataclasses.replace(one.sensor.light, responsivity=0.1)
    electronics = dataclasses.replace(one, sensor=dataclasses.replace(one.sensor, light=light))
    assert electronics.fingerprint == one.fingerprint


@pytest.mark.slow
def test_a_camera_beside_the_psd_is_hardly_moved_by_the_glow(part_file: Path, tmp_path: Path) -> None:
    worst = {}
    for name in ("psd_line", "camera_line"):
        attribution = simulate(task_of(part_file, name), tmp_path / name, seed=None).attribution
        flat = np.abs(attribution.truth.h) < 1e-9
        worst[name] = np.nanmax(np.abs(attribution.causes["secondary"][flat]))
    assert worst["camera_line"] < 0.1 * worst["psd_line"]


def test_noise_is_the_same_in_every_run(part_file: Path, tmp_path: Path) -> None:
    task = task_of(part_file, profiles=20)
    one, two, other = (simulate(task, tmp_path, seed=each).attribution.error for each in (3, 3, 4))
    np.testing.assert_array_equal(one, two)
    assert np.nanmax(np.abs(one - other)) > 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"paths": ("direct", "defuse")}, "unknown path 'defuse'"),
        ({"paths": ("diffuse-diffuse",)}, "lack 'direct'"),
        ({"tolerance": -1.0}, "tolerance is -1"),
        ({"sensor": "corner_scene"}, "straight transport"),
    ],
)
def test_what_cannot_be_simulated(part_file: Path, change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        task_of(part_file, **change)


def test_a_part_beside_the_sensor_is_told_where_it_is(tmp_path: Path) -> None:
    part = mesh()
    part.apply_translation((1.0, 0.0, 0.0))
    part.export(tmp_path / "aside.stl")
    with pytest.raises(ValueError, match="sees nothing lit in any of 8 profiles: the part lies at x 980 to 1020 mm"):
        simulate(task_of(tmp_path / "aside.stl", profiles=8), tmp_path)


def test_a_mesh_needs_its_materials(tmp_path: Path) -> None:
    scene = trimesh.Scene([mesh(), trimesh.creation.box((MM, MM, MM))])
    scene.export(tmp_path / "two.glb")
    with pytest.raises(ValueError, match="has 2 meshes, 1 materials"):
        load_part(tmp_path / "two.glb", 1.0, load_part(tmp_path / "two.glb", 1.0, None, 0.5)[1][:1], 0.5)


def command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["gpuvision", "simulate", *words])
    with pytest.raises(SystemExit) as left:
        cli.main()
    return int(left.value.code or 0)


def test_the_command(
    part_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    millimetres = mesh()
    millimetres.apply_scale(1000.0)
    millimetres.export(tmp_path / "mm.stl")
    out = tmp_path / "out"
    words = [str(tmp_path / "mm.stl"), "--unit", "mm", "--sensor", "psd_line", "--out", str(out), "--profiles", "8"]
    assert command(monkeypatch, *words) == 0
    output = capsys.readouterr()
    assert "8 profiles" in output.out
    assert output.err == ""
    report = json.loads((out / "report.json").read_text())
    assert report["profiles"] == 8
    assert report["computed_blocks"] == 1
    assert command(monkeypatch, *words, "--no-noise", "--mask", "best") == 0
    assert json.loads((out / "report.json").read_text())["computed_blocks"] == 0
    capsys.readouterr()
    monkeypatch.setattr(light_cache, "_CONNECTION_TIMEOUT", "0.2s")  # of a scheduler that is not there
    for wrong, line in [
        (["--paths", "direct,sideways"], "unknown path 'sideways'"),
        (["--paths", ""], "lack 'direct'"),
        (["--mask", str(tmp_path / "none.txt")], "none.txt"),
        (["--mask", str(tmp_path / "mm.stl")], "mm.stl: expected two numbers a line"),
        (["--materials", str(tmp_path / "none.toml")], "none.toml"),
        (["--scheduler", "tcp://127.0.0.1:1", "--profiles", "7"], "127.0.0.1:1"),
    ]:
        assert command(monkeypatch, *words, *wrong) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert line in lines[-1]
        assert lines[-1].startswith("gpuvision: ")


@pytest.mark.slow
def test_a_cluster_loses_a_worker_and_nothing_else(part_file: Path, tmp_path: Path) -> None:
    from distributed import LocalCluster

    task = task_of(part_file, profiles=None)
    local = simulate(task, tmp_path / "here")
    seen: list[int] = []
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": ":0"}
    with LocalCluster(**options, silence_logs=50) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]

        def kill_one(done: int, of: int | None) -> None:
            seen.append(done)
            if len(seen) == 2:
                os.kill(pids[0], signal.SIGKILL)

        remote = simulate(task, tmp_path / "there", scheduler=cluster.scheduler_address, progress=kill_one)
    assert remote.computed_blocks == len(task.blocks())
    assert seen[-1] == len(task.transports)
    np.testing.assert_array_equal(remote.attribution.error, local.attribution.error)


@pytest.mark.slow
def test_a_second_sensor_sees_what_is_hidden_from_the_first(
    part_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = resources.files("gpuvision").joinpath("presets", "sensors", "camera_line.toml").read_text(encoding="utf-8")
    across = tmp_path / "across.toml"
    across.write_text(text.replace("[light]", "[light]\nlens = [0.0, -0.08, 0.15]"))
    words = [str(part_file), "--sensor", "camera_line", "--second", str(across), "--out", str(tmp_path)]
    assert command(monkeypatch, *words, "--profiles", "48", "--paths", "direct") == 0
    assert "surface samples read within" in capsys.readouterr().out
    report = json.loads((tmp_path / "both" / "report.json").read_text())
    ranked = {each["name"]: each["failed_fraction"] for each in report["ranking"]}
    assert report["ranking"][0]["name"] == "both"
    # Behind the block, both single sensors miss the same number of samples.
    assert ranked["both"] < 0.5 * min(ranked["first"], ranked["second"])
    assert (tmp_path / "second" / "errors.png").stat().st_size > 1000


def test_a_wrong_second_sensor_costs_no_light(
    part_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(part_file), "--sensor", "psd_line", "--out", str(tmp_path), "--profiles", "1"]
    for second, line in [("nowhere.toml", "nowhere.toml"), ("corner_scene", "straight transport")]:
        assert command(monkeypatch, *words, "--second", second) == 1
        assert line in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_all_paths_by_one_word(part_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = [str(part_file), "--sensor", "psd_line", "--out", str(tmp_path), "--profiles", "1"]
    assert command(monkeypatch, *words, "--paths", "all") == 0
    assert json.loads((tmp_path / "report.json").read_text())["paths"] == list(PATHS)


@pytest.mark.slow
def test_patches_of_the_default_size_suffice_in_a_groove(device: Device) -> None:
    """Readings in a V groove of 90 degrees with the default patches, against patches of half the size.

    Four rays per bin: the light of a single ray beside the edge of the groove changes with the patches there by 7 um in
    one strip, whose error by so few rays is 62 um.
    """
    sensor = Sensor.load("psd_line")
    light = require_light(sensor)
    sensor = dataclasses.replace(sensor, light=dataclasses.replace(light, nodes=(2, 2)))
    half, length = 0.02 / np.sqrt(2.0), 0.08
    profile = np.repeat(np.array([(-half, half), (0.0, 0.0), (half, half)]), 2, axis=0)
    corners = np.stack([profile[:, 0], np.tile([-length / 2, length / 2], 3), profile[:, 1]], axis=-1)
    triangles = [each for n in (0, 2) for each in ((n, n + 2, n + 1), (n + 1, n + 2, n + 3))]
    scene = Scene.of(trimesh.Trimesh(corners, triangles))
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) / 16.0
    readings = []
    for patch_size in (None, size / 2.0):
        task = prepare_simulation(
            scene,
            [Material(diffuse=Lambert(albedo=0.8))],
            sensor,
            paths=("direct", "diffuse-diffuse", "multi-bounce"),
            patch_size=patch_size,
            transports=[0.0],
        )
        paths = make_light_paths(task, device)
        found = paths.profile(0.0)
        one = found.exposures["direct"] + found.exposures["diffuse-diffuse"]
        lit = found.exposures["direct"].total() > 0.0
        slope = StripErrorModel.from_exposure(paths.view, found.exposures["direct"]).slope
        places = [
            (each.first_moment(paths.view.u_edges)[lit] / each.total()[lit] * slope[lit])
            for each in (one, one + found.exposures["multi-bounce"])
        ]
        readings.append((places, found.statistics["estimated error of patches [m]"]))
    (one_bounce, default), estimate = readings[0]
    error = np.abs(default - readings[1][0][1]).max()
    assert np.abs(default - one_bounce).max() > 300e-6
    # Measured: 1.4 um; even patches are wrong by 10 um.
    assert error < 2e-6
    assert error < estimate


# ---- steps of a simulation -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("places", "step", "profiles", "first", "last"),
    [
        ((0.0, 10.0), 1.0, None, 0, 9),
        ((0.5, 10.5), 1.0, None, 1, 9),  # profiles that only touch its ends do not count
        ((0.49, 10.51), 1.0, None, 0, 10),
        ((0.0, 10.0), -1.0, None, -9, 0),
        ((0.0, 10.0), 1.0, 4, 3, 6),
        ((0.0, 10.0), 1.0, 5, 2, 6),
        ((0.0, 10.0), 1.0, 9, 0, 8),
        ((0.0, 10.0), 1.0, 10, 0, 9),
        ((0.0, 10.0), 1.0, 11, 0, 9),
        ((0.4, 0.6), 1.0, None, 0, 0),
    ],
)
def test_profiles_that_meet_a_part(
    places: tuple[float, float],
    step: float,
    profiles: int | None,
    first: int,
    last: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Profile k lies at 0.5 mm + k step."""
    monkeypatch.setattr(simulating, "_corner_transports", lambda *_: MM * np.array([np.mean(places), *places]))
    transport = StraightTransport(start=0.5 * MM, step=step * MM)
    part: Any = None
    found = simulating._transports_over(part, transport, profiles)
    np.testing.assert_allclose(found, 0.5 * MM + step * MM * np.arange(first, last + 1), rtol=1e-12)


@pytest.mark.parametrize(
    ("places", "step", "message"),
    [
        ([0.0, 1.0], None, r"a simulation needs \[transport\] step: metres per profile"),
        ([], 1.0, "the part has no triangle"),
        ([0.6, 1.4], 1.0, "no profile meets the part: it is shorter than a step of the transport"),
        ([0.5, 1.5], 1.0, "no profile meets the part"),
    ],
)
def test_parts_that_no_profile_meets(
    places: list[float], step: float | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulating, "_corner_transports", lambda *_: MM * np.array(places))
    part: Any = None
    with pytest.raises(ValueError, match=message):
        simulating._transports_over(part, StraightTransport(start=0.5 * MM, step=step and MM * step), None)


def test_transports_of_corners_on_oblique_axes() -> None:
    """Corner = origin + G g + H h + L direction: L of each corner of the finite triangles."""
    g, h, along = np.array([0.8, 0.1, -0.3]), np.array([-0.2, 0.4, 0.9]), np.array([0.48, 0.6, -0.64])
    origin = np.array([0.1, -0.2, 0.3])
    transports = np.array([0.01, -0.02, 0.05, 0.07, 0.11, -0.13])
    corners = origin + np.outer([1.0, 2.0, -1.0, 0.5, 3.0, -4.0], g) + np.outer(np.arange(6.0), h)
    corners = (corners + np.outer(transports, along)).reshape(2, 3, 3)
    corners[1, 0, 2] = np.nan
    transport = StraightTransport(
        step=1.0, g_axis=tuple(g), h_axis=tuple(h), direction=tuple(along), origin=tuple(origin)
    )
    found = simulating._corner_transports(Scene(corners), transport)
    np.testing.assert_allclose(np.unique(np.round(found, 9)), np.sort(transports[:3]), rtol=1e-9)


@pytest.mark.parametrize(("patch_size", "expected"), [(None, 7e-3), (2e-3, 2e-3)])
def test_size_of_patches_is_given_or_that_of_the_light(
    part_file: Path, patch_size: float | None, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    light = SimpleNamespace(patch_size=7e-3)
    monkeypatch.setattr(simulating, "require_light", lambda sensor: light)
    task = task_of(part_file, patch_size=patch_size, tolerance=0.0, paths=("direct", "diffuse-diffuse", "direct"))
    assert (task.patch_size, task.tolerance, task.paths) == (expected, 0.0, ("direct", "diffuse-diffuse"))
    for size in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=f"the patch size is {size}, expected metres, more than 0"):
            task_of(part_file, patch_size=size)
    with pytest.raises(ValueError, match="the tolerance is inf, expected metres, 0 or more"):
        task_of(part_file, tolerance=np.inf)


def block_of(first: int, count: int) -> Any:
    """Return a block of light whose numbers are those of its profiles; one path is not of a sensor."""
    profiles = np.arange(first, first + count, dtype=float)
    light = {name: Exposure(profiles + 0.25, profiles + 0.5) for name in ("direct", "diffuse-diffuse", "thrown")}
    truth = GroundTruth(*(profiles + 10.0 * k for k in range(len(GroundTruth._fields))))
    return SimpleNamespace(exposures=light, truth=truth)


@pytest.mark.parametrize(("most", "every"), [(100, 1), (70, 1), (69, 2), (35, 2), (34, 3), (7, 10)])
def test_light_of_every_nth_profile_where_all_would_be_too_many(most: int, every: int) -> None:
    """Seven profiles of ten bins, in blocks of four."""

    class Store(list[Any]):
        task = SimpleNamespace(transports=np.zeros(7), blocks=lambda: [range(4), range(4, 7)])

    store: Any = Store([block_of(0, 4), block_of(4, 3)])
    light, truth = simulating._all_light(store, 10, most)
    chosen = np.arange(7.0)[::every]
    assert set(light) == {"direct", "diffuse-diffuse"}
    for each in light.values():
        np.testing.assert_array_equal(each[0], chosen + 0.25)
        np.testing.assert_array_equal(each[1], chosen + 0.5)
    for number, each in enumerate(truth):
        np.testing.assert_array_equal(each, chosen + 10.0 * number)


def test_statistics_are_sums_and_largest_bounds() -> None:
    blocks: Any = [
        SimpleNamespace(statistics={"rays": np.array([3.0, 4.0]), "bound": np.array([0.5, 0.2]), "estimated": [1.0]}),
        SimpleNamespace(statistics={"rays": np.array([10.0]), "bound": np.array([0.3]), "estimated": [2.0, 1.5]}),
    ]
    found: dict[str, float] = {}
    for each in blocks:
        found = simulating._add_statistics(found, each)
    assert found == {"rays": 17.0, "bound": 0.5, "estimated": 2.0}


def test_attributions_are_joined_field_by_field() -> None:
    rng = np.random.default_rng(4)
    parts = [errors_of(rng.normal(size=(count, 5)), causes=("shape", "noise")) for count in (2, 3)]
    joined = simulating._concatenate(parts)
    np.testing.assert_array_equal(joined.error, np.concatenate([each.error for each in parts]))
    assert list(joined.causes) == ["shape", "noise"]
    for name in joined.causes:
        np.testing.assert_array_equal(joined.causes[name], np.concatenate([each.causes[name] for each in parts]))
    for k, each in enumerate(joined.truth):
        np.testing.assert_array_equal(each, np.concatenate([part.truth[k] for part in parts]))


def test_readings_of_blocks_have_the_numbers_of_their_profiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise is drawn by the number of a profile; statistics are added up."""
    asked: list[Any] = []

    def attribute(simulator: Any, exposures: Any, truth: Any, **how: Any) -> Any:
        asked.append((simulator, exposures, how))
        return errors_of(np.zeros((len(truth.h), 5)))

    monkeypatch.setattr(simulating, "attribute_errors", attribute)

    class Store(list[Any]):
        task = SimpleNamespace(part=None)

    blocks = [
        SimpleNamespace(exposures=k, truth=SimpleNamespace(h=np.zeros(count)), statistics={"rays": np.ones(count)})
        for k, count in enumerate((4, 3, 2))
    ]
    store: Any = Store(blocks)
    simulator: Any = "a simulator"
    device: Any = "a device"
    found, statistics = simulating._attribute_errors(store, simulator, 5, device)
    assert asked == [
        ("a simulator", k, {"seed": 5, "first_profile": first, "device": "a device"})
        for k, first in enumerate((0, 4, 7))
    ]
    assert found.error.shape == (9, 5)
    assert statistics == {"rays": 9.0}
