"""Scans through a polygon mirror, from a sensor file to a height map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device, to_numpy
from gpuvision.schema import DescriptionError, Section
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import require_light
from gpuvision.workflows.scanning import scan

SAMPLES, PROFILES, LENGTH = 61, 8, 6e-3
C1, C2, C3 = 12.0, 0.05, -20.0  # h = (C1 u + C2)/(C3 u + 1)


def table(**polygon: Any) -> dict[str, Any]:
    return {
        "kind": "psd",
        "psd": {"strips": SAMPLES, "strip_length": LENGTH},
        "triangulation": {"constants": [C1, C2, C3]},
        "polygon": {"apothem": 0.05, "facets": 8, "height": 0.4, "first_rotation": -0.15, "rotation_step": 0.005}
        | polygon,
        "transport": {"kind": "straight", "step": 4e-3},
        "output": {"cell": 4e-3, "max_gap": 20e-3},
    }


def sensor(**polygon: Any) -> Sensor:
    return Sensor.from_section(Section(table(**polygon), "sensor.toml"))


def recording(level: float, slope: float) -> Any:
    """Return currents (profiles, samples, 2) of the plane z = level + slope x.

    From the law of cosines of the path, without the formula of the package: the reading is the height D - (path - s).
    """
    phi = -0.15 + 0.005 * np.arange(SAMPLES)
    drop = 0.4 - 0.05 * math.sqrt(0.5)
    psi = phi - math.pi / 4
    shift = 0.05 * ((1 + np.sin(psi) / math.sqrt(2)) / np.cos(psi) - (1 - 0.5) / math.sqrt(0.5))
    # The line z = level + slope x meets the ray (shift + d sin, drop - d cos).
    d = (drop - level - slope * shift) / (np.cos(2 * phi) + slope * np.sin(2 * phi))
    h = drop - d + shift
    u = (h - C2) / (C1 - C3 * h)
    share = u / LENGTH
    pair = np.stack([0.5 - share, 0.5 + share], axis=-1) * 1e-6
    assert np.all(pair > 0)
    return np.broadcast_to(pair, (PROFILES, SAMPLES, 2)), shift + d * np.sin(2 * phi), drop - d * np.cos(2 * phi)


def test_a_tilted_plane(device: Device) -> None:
    currents, x, z = recording(0.05, 0.1)
    done = scan(currents.astype(np.float32), sensor(), device=device)
    assert done.valid_fraction == 1.0
    # float32: a few roundings of 6e-8 of the drop, 0.36 m.
    np.testing.assert_allclose(to_numpy(done.points.x), np.broadcast_to(x, (PROFILES, SAMPLES)), rtol=0, atol=3e-7)
    np.testing.assert_allclose(to_numpy(done.points.z), np.broadcast_to(z, (PROFILES, SAMPLES)), rtol=0, atol=3e-7)
    time = np.arange(PROFILES)[:, None] + (-0.15 + 0.005 * np.arange(SAMPLES)) / (2 * math.pi / 8)
    np.testing.assert_allclose(to_numpy(done.points.y), 4e-3 * time, rtol=0, atol=1e-8)
    known = np.isfinite(done.heights.z)
    assert known.mean() > 0.6  # the motion shears the sweeps
    plane = np.broadcast_to(0.05 + 0.1 * done.grid.x, known.shape)
    np.testing.assert_allclose(done.heights.z[known], plane[known], rtol=0, atol=2e-6)


@pytest.mark.double
def test_noise_scatters_the_points_by_the_predicted_sigma(device: Device, rng: np.random.Generator) -> None:
    """Noise of the currents moves a spot along its beam: by its sigma in x and z, and not in y."""
    currents, _, _ = recording(0.05, 0.1)
    trials = 2000
    noise = 2e-10  # A
    noisy = np.tile(currents[:1], (trials, 1, 1)) + rng.normal(0.0, noise, (trials, SAMPLES, 2))
    described = table(moving="no")
    described["psd"]["noise"] = {"independent": noise}
    described["transport"] |= {"jitter": 1e-4}
    done = scan(noisy.astype(np.float64), Sensor.from_section(Section(described, "sensor.toml")), device=device)
    assert done.errors is not None
    for axis in "xz":
        values, predicted = to_numpy(getattr(done.points, axis)), getattr(done.errors.random, axis)
        scatter = np.std(values, axis=0)
        # 2000 trials determine a standard deviation to 1.6 %.
        used = predicted[0] > 1e-9
        assert np.mean(scatter[used] / predicted[0][used]) == pytest.approx(1.0, abs=0.03)
        np.testing.assert_allclose(scatter[used], predicted[0][used], rtol=0.1)
    np.testing.assert_allclose(done.errors.random.y, 1e-4)


def test_a_stage_that_stops(device: Device) -> None:
    currents, _, _ = recording(0.05, 0.0)
    done = scan(currents.astype(np.float32), sensor(moving="no"), device=device)
    expected = np.broadcast_to(4e-3 * np.arange(PROFILES)[:, None], (PROFILES, SAMPLES))
    np.testing.assert_allclose(to_numpy(done.points.y), expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"polygon": {"facets": 2}}, r"polygon\.facets is 2, expected a whole number of at least 3"),
        ({"polygon": {"rotation_step": 0.0}}, r"polygon: PolygonScan\.rotation_step is 0"),
        ({"polygon": {"height": 0.03}}, r"polygon: PolygonMirror\.height is 0\.03 m from the centre"),
        ({"polygon": {"first_rotation": 1.0}}, r"\[polygon\] turns from 1 to 1\.3 rad, expected a part of -0\.\d+ to"),
        ({"polygon": {"aphothem": 1.0}}, r"unknown key 'polygon\.aphothem'; did you mean 'polygon\.apothem'"),
        ({"triangulation": {"constants": [12, 0, 1, 5, 2, 3]}}, None),
        ({"lens": {"k1": 1.0}}, r"\[polygon\] needs a point sensor"),
        (
            {"triangulation": {"homography": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}},
            r"\[polygon\] needs a point sensor: a triangulation with H of u alone",
        ),
    ],
)
def test_files(changes: dict[str, Any], message: str | None) -> None:
    described = table(**changes.get("polygon", {})) | {key: each for key, each in changes.items() if key != "polygon"}
    if "constants" in changes.get("triangulation", {}):
        described["triangulation"] = changes["triangulation"]
    section = Section(described, "sensor.toml")
    if message is None:
        assert Sensor.from_section(section).polygon is not None
        return
    with pytest.raises(DescriptionError, match=message) as raised:
        Sensor.from_section(section)
    assert "\n" not in str(raised.value)


def test_only_strips_look_through_a_polygon() -> None:
    from_camera = {"kind": "camera", "line": {}, "frame": {"columns": 8, "rows": 8}}
    described = {name: each for name, each in table().items() if name != "psd"} | from_camera
    with pytest.raises(DescriptionError, match=r"unknown key 'polygon'"):
        Sensor.from_section(Section(described, "sensor.toml"))


def test_a_simulation_has_no_polygon(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"needs a sheet of light, this one is a point sensor behind a polygon mirror"):
        require_light(sensor())
