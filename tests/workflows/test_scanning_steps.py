"""Steps of a scan by themselves: directions, outputs of a readout, limits of a grid, entries of the report."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host.sources import PacedSource
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.range_image import RangePoints
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import Status
from gpuvision.workflows import scanning

CAMERA, PSD, TURNING = (Sensor.load(name) for name in ("camera_line", "psd_line", "corner_scene"))


@pytest.mark.parametrize("sample", ["x", "-x", "y", "-y"])
@pytest.mark.parametrize("profile", ["x", "-x", "y", "-y"])
def test_directions_of_samples_and_profiles(sample: str, profile: str) -> None:
    """By the median steps: single jumps and holes do not count; a part of each step along the other axis neither."""
    if sample[-1] == profile[-1]:
        return
    steps = {
        "x": np.array([1.0, 0.2]),
        "-x": np.array([-1.0, 0.2]),
        "y": np.array([0.2, 1.0]),
        "-y": np.array([0.2, -1.0]),
    }
    place = np.multiply.outer(np.arange(6.0), steps[profile])[:, None] + np.multiply.outer(
        np.arange(7.0), steps[sample]
    )
    place = 1e-3 * place
    place[2, 3] += 50.0
    place[4] = np.nan
    assert scanning._directions(place[..., 0], place[..., 1]) == (sample, profile)


def test_directions_where_both_axes_have_one_step() -> None:
    diagonal = np.add.outer(np.arange(4.0), np.arange(5.0))
    assert scanning._directions(diagonal, diagonal) == ("x", "y")
    assert scanning._directions(-diagonal, -diagonal) == ("-x", "-y")
    unknown = np.full((1, 1), np.nan)
    assert scanning._directions(unknown, unknown) == ("x", "y")


def with_noise(sensor: Sensor, known: bool) -> Sensor:
    return dataclasses.replace(sensor, noise_known=known)


@pytest.mark.parametrize(
    ("sensor", "known", "outputs"),
    [
        (CAMERA, False, ("g", "h", "peak", "status")),
        (PSD, False, ("g", "h", "total", "status")),
        (TURNING, False, ("position", "peak", "status")),
        (TURNING, True, ("position", "peak", "status", "width", "total", "sigma")),
        (CAMERA, True, ("g", "h", "peak", "status", "position", "width", "total", "sigma", "sigma_g", "sigma_h")),
        (PSD, True, ("g", "h", "total", "status", "sigma", "sigma_g", "sigma_h")),
    ],
)
def test_outputs_that_a_scan_needs(sensor: Sensor, known: bool, outputs: tuple[str, ...]) -> None:
    readout = scanning.range_readout(with_noise(sensor, known))
    systematic = {"systematic_g", "systematic_h"}
    assert tuple(each for each in readout.outputs or () if each not in systematic) == outputs


@pytest.mark.parametrize(("asked", "expected"), [(None, "double"), ("single", "single"), ("double", "double")])
def test_precision_of_a_readout(asked: Any, expected: str) -> None:
    readout: Any = dataclasses.replace(CAMERA.readout, precision="double")
    sensor = dataclasses.replace(CAMERA, readout=readout)
    assert scanning.range_readout(sensor, asked).precision == expected


@pytest.mark.parametrize("ambiguous", ["drop", "keep"])
def test_ambiguous_points_are_dropped_where_the_sensor_says_so(ambiguous: str) -> None:
    sensor: Any = SimpleNamespace(output=SimpleNamespace(ambiguous=ambiguous))
    x, y, z = np.ones((3, 1, 4))
    status = np.array([[0, Status.AMBIGUOUS, Status.SATURATED, Status.AMBIGUOUS | Status.SATURATED]], np.uint8)
    scanning._drop_ambiguous(sensor, RangePoints(x, y, z, status))
    expected = [1.0, np.nan, 1.0, np.nan] if ambiguous == "drop" else [1.0] * 4
    for each in (x, y, z):
        np.testing.assert_array_equal(each[0], expected)


@pytest.mark.parametrize("fits", [True, False])
def test_a_map_may_have_exactly_the_largest_number_of_cells(fits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps beyond the range of a float32 become its largest number."""
    made: list[Any] = []

    class Fake:
        def __init__(self, **how: Any) -> None:
            made.append(how)

        def __call__(self, *given: Any, device: Any) -> str:
            made.append((given, device))
            return "heights"

    grid = SimpleNamespace(rows=6, columns=7)
    asked: list[Any] = []
    monkeypatch.setattr(scanning, "Regrid", Fake)
    monkeypatch.setattr(scanning.Grid, "covering", staticmethod(lambda *given: asked.append(given) or grid))
    output = SimpleNamespace(cell=1e-3, max_gap=5e-3, max_step=1e300, fold_tolerance=2e-3, folded="mean")
    sensor: Any = SimpleNamespace(output=output)
    z = np.zeros((2, 3))
    x, y = np.meshgrid(np.arange(3.0), np.arange(2.0))
    points = RangePoints(x, y, z, np.zeros(z.shape, np.uint8))
    device: Any = "a device"
    if not fits:
        with pytest.raises(ValueError, match=r"the points span 7 x 6 cells of 0\.001 m; give \[output\] a larger cell"):
            scanning.resample_heights(sensor, points, z, device, max_cells=41)
        return
    found: Any = scanning.resample_heights(sensor, points, z + 5.0, device, max_cells=42, sigma=z + 7.0)
    assert found == ("heights", grid)
    how, (given, used) = made
    assert how == {
        "grid": grid,
        "max_gap": 5e-3,
        "max_step": float(np.finfo(np.float32).max),
        "fold_tolerance": 2e-3,
        "folded": "mean",
        "along": "x",
        "across": "y",
        "sigma": True,
    }
    assert used == "a device"
    for one, other in zip(given, (x, y, z, z + 5.0, points.status, z + 7.0), strict=True):
        np.testing.assert_array_equal(one, other)
    assert asked[0][2] == 1e-3
    scanning.resample_heights(sensor, points, z, device)
    assert (made[2]["sigma"], made[3][0][-1]) == (False, None)


def test_entries_of_the_report_about_recording_and_replay() -> None:
    source: Any = SimpleNamespace(damaged_frames=lambda: frozenset({7, 2}))
    found = scanning._metadata("r.npy", CAMERA, None, source)
    readout: Any = CAMERA.readout
    assert found == {
        "recording": "r.npy",
        "sensor": CAMERA.name,
        "kind": "camera",
        "background": str(CAMERA.recording.background),
        "threshold": readout.threshold,
        "readout": {name: getattr(readout, name) for name in ("method", "window", "fir_length", "precision")},
        "sensor_rate": CAMERA.recording.rate,
        "rate": None,
        "encoder": None,
        "damaged_frames": [2, 7],
        "late": None,
    }
    assert isinstance(CAMERA.readout, LineReadout)
    assert isinstance(PSD.readout, PsdReadout)
    paced: Any = object.__new__(PacedSource)
    paced.late, paced._source = 2_500_000, source
    found = scanning._metadata("r.npy", PSD, 90.0, paced)
    assert (found["threshold"], found["readout"], found["rate"], found["late"]) == (None, None, 90.0, 2.5e-3)


@pytest.mark.parametrize("per_sample", [False, True])
@pytest.mark.parametrize("with_encoder", [False, True])
def test_each_frame_has_the_transport_of_its_number(
    with_encoder: bool, per_sample: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames 1, 2 and 4 of a recording; the encoder did not advance at frames 0 and 2."""
    asked: list[Any] = []
    monkeypatch.setattr(scanning, "assemble_points", lambda *given: asked.append(given) or "points")
    monkeypatch.setattr(scanning, "predict_errors", lambda *given: asked.append(given) or "errors")
    encoder = SimpleNamespace(not_advancing=lambda: np.array([True, False, True, False, False, False]))
    polygon = SimpleNamespace(sample_transports=lambda lengths, samples: np.outer(lengths, np.arange(1.0, samples + 1)))
    sensor: Any = SimpleNamespace(
        transports=lambda profiles: 0.5 * np.arange(profiles),
        encoder=encoder if with_encoder else None,
        polygon=polygon if per_sample else None,
        transport=StraightTransport(),
    )
    status = np.zeros((3, 2), np.uint8)
    fields = {"g": np.full((3, 2), 1.0), "h": np.full((3, 2), 2.0), "status": status}
    device: Any = "a device"
    numbers = np.array([1, 2, 4])
    found: Any = scanning.measure_points(sensor, fields, numbers, device)
    assert found == ("points", None)
    ((_, positions, transports, flags, used),) = asked
    np.testing.assert_array_equal(positions, [fields["g"], fields["h"]])
    np.testing.assert_array_equal(transports, np.outer([0.5, 1.0, 2.0], [1.0, 2.0]) if per_sample else [0.5, 1.0, 2.0])
    expected = np.zeros((3, 2), np.uint8)
    expected[1] = Status.NOT_INVERTIBLE if with_encoder else 0
    np.testing.assert_array_equal(flags, expected)
    assert used == "a device"
    turning = {"position": np.zeros((3, 2)), "status": status, "sigma": np.zeros((3, 2))}
    found = scanning.measure_points(sensor, turning, numbers, device)
    assert found == ("points", "errors")
    assert len(asked[1][1]) == 1
    assert asked[2][1] is turning
