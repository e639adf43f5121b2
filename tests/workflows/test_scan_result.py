"""Report, summary and arrays of a scan: each number from the part of the scan that it stands for."""

from __future__ import annotations

import dataclasses
import math
from importlib.metadata import version
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.ranging.range_image import RangePoints
from gpuvision.status import Status
from gpuvision.workflows.scan_errors import PointSigma, ScanErrors
from gpuvision.workflows.scan_result import Scan

GRID = Grid(left=1.0, top=2.0, cell_x=1e-3, cell_y=2e-3, columns=4, rows=3)
METADATA = {"recording": "r.npy", "rate": None, "late": None, "encoder": None, "damaged_frames": []}


class Stall(str):
    """Text of a stall."""


def stream_of(**changes: Any) -> Any:
    values: dict[str, Any] = {
        "frames": 1200,
        "dropped": 0,
        "throughput": 2500.0,
        "seconds": 0.75,
        "longest_stall": Stall("7 ms, most of it in the consumer"),
    } | changes
    extra = {"latency": {"p50": 1.0}, "stages": {"wait": {}}, "batch": 4}
    return SimpleNamespace(**values, to_dict=lambda: values | extra)


def scan_of(**changes: Any) -> Scan:
    """Return a scan of 3 profiles of 5 samples, of which 6 have a point."""
    x, y, z = np.arange(45.0).reshape(3, 3, 5)
    z[0], z[1, :4] = np.nan, np.nan
    status = np.zeros((3, 5), np.uint8)
    status[0], status[1, :2], status[1, 2] = Status.LOW_SIGNAL, Status.AMBIGUOUS | Status.SATURATED, Status.AMBIGUOUS
    map_z = np.zeros(GRID.shape)
    map_z[0, :3] = np.nan
    values: dict[str, Any] = {
        "sensor": SimpleNamespace(kind="camera", name="cam", recording=SimpleNamespace(rate=1000.0), files=()),
        "points": RangePoints(x, y, z, status),
        "intensity": np.full((3, 5), 7.0),
        "heights": HeightMap(map_z, np.ones(GRID.shape), np.zeros(GRID.shape, np.uint8)),
        "grid": GRID,
        "frame_numbers": np.array([0, 2, 3]),
        "device": SimpleNamespace(label="pocl", name="CPU", driver="3.1"),
        "stream": stream_of(),
        "seconds": {"assemble": 0.25, "resample": 0.5},
        "metadata": METADATA,
    }
    return Scan(**(values | changes))


def test_report_of_a_scan() -> None:
    done = scan_of()
    counts = {"OK": 7, "LOW_SIGNAL": 5, "AMBIGUOUS": 3, "SATURATED": 2}
    counts |= {str(flag.name): 0 for flag in Status if 0 < flag < Status.NOT_CONVERGED and flag.name not in counts}
    assert done.valid_fraction == 0.4
    assert done.counts() == counts
    assert done.report() == {
        "gpuvision": version("gpuvision"),
        **METADATA,
        "device": {"label": "pocl", "name": "CPU", "driver": "3.1"},
        "precision": "double",
        "frames": 1200,
        "dropped": 0,
        "samples_per_frame": 5,
        "valid_fraction": 0.4,
        "ambient_level": None,
        "status": counts,
        "throughput": 2500.0,
        "latency": {"p50": 1.0},
        "stages": {"wait": {}},
        "seconds": {"stream": 0.75, "assemble": 0.25, "resample": 0.5},
        "stream": {"frames": 1200, "longest_stall": done.stream.longest_stall, "batch": 4},
        "map": dataclasses.asdict(GRID) | {"valid_fraction": 0.75},
        "error_budget": done.error_budget(),
    }
    focus = SimpleNamespace(kind="focus", name="", recording=SimpleNamespace(rate=None), files=())
    single = RangePoints(*(each.astype(np.float32) for each in done.points[:3]), done.points.status)
    report = scan_of(sensor=focus, points=single).report()
    assert (report["samples_per_frame"], report["precision"]) == (15, "single")


@pytest.mark.parametrize(("throughput", "expected"), [(2500.0, 2500.0), (0.0, 1600.0), (math.nan, 1600.0)])
def test_throughput_of_a_scan(throughput: float, expected: float) -> None:
    """Without one, frames over the whole time: 1200 in 0.75 s."""
    assert scan_of(stream=stream_of(throughput=throughput)).throughput == expected


@pytest.mark.parametrize(
    ("changes", "metadata", "text"),
    [
        ({}, {}, "1200 frames at 2,500 frames/s on pocl (2.5 times the sensor's rate), 40.0 % of the samples valid"),
        ({"dropped": 3}, {}, "1200 frames (3 dropped) at 2,500 frames/s"),
        ({}, {"rate": 900.0}, "on pocl, 40.0 % of the samples valid, 4 x 3 cells; longest stall 7 ms, most of it in"),
        ({"longest_stall": None}, {"rate": 900.0, "late": 0.01}, "valid, 4 x 3 cells"),
        ({"longest_stall": None}, {"rate": 900.0, "late": 0.0104}, "4 x 3 cells; frames were read up to 10 ms late"),
        ({}, {"encoder": {"not_advancing": 0}}, "valid, 4 x 3 cells"),
        ({}, {"encoder": {"not_advancing": 2}}, "4 x 3 cells; 2 profiles do not advance"),
        ({}, {"damaged_frames": [5]}, "4 x 3 cells; 1 damaged frame"),
        ({}, {"damaged_frames": [5, 6]}, "4 x 3 cells; 2 damaged frames"),
    ],
)
def test_summary_of_a_scan(changes: dict[str, Any], metadata: dict[str, Any], text: str) -> None:
    found = scan_of(stream=stream_of(**changes), metadata=METADATA | metadata).summary()
    assert text in found
    assert found.startswith(text) or found.endswith((text, "the consumer"))


def test_advice_where_less_than_half_of_the_samples_have_a_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpuvision.workflows.scan_result.scan_advice", lambda status, sensor: (sensor.name,))
    done = scan_of()
    assert done.advice() == ("cam",)
    x, y, z, status = (each[:2, :4].copy() for each in done.points)
    for count, advice in ((4, ()), (3, ("cam",))):
        z[:] = np.nan
        z.ravel()[:count] = 0.0
        assert scan_of(points=RangePoints(x, y, z, status)).advice() == advice


def test_arrays_and_units_of_a_scan() -> None:
    """Without a noise model there are no standard deviations; each present group has its own."""
    arrays, units = scan_of()._arrays()
    names = ["x", "y", "z", "status", "intensity", "frame"]
    names += [f"map_{each}" for each in ("x", "y", "z", "status", "intensity")]
    assert list(arrays) == list(units) == names
    assert [units[name] for name in names] == ["m", "m", "m", "flags", "grey level", "", *"mmm", "flags", "grey level"]
    np.testing.assert_array_equal(arrays["map_x"], GRID.x)
    np.testing.assert_array_equal(arrays["map_y"], GRID.y)

    def sigma(first: float) -> PointSigma:
        return PointSigma(*(np.full((3, 5), first + k) for k in range(3)))

    errors = ScanErrors(
        position=np.zeros((3, 5)),
        readout=sigma(0.0),
        transport=sigma(10.0),
        random=sigma(20.0),
        systematic=sigma(30.0),
        map_systematic=np.full(GRID.shape, 40.0),
        phase=sigma(50.0),
        map_phase=np.full(GRID.shape, 60.0),
    )
    heights = scan_of().heights._replace(sigma=np.full(GRID.shape, 70.0))
    psd = SimpleNamespace(kind="psd", name="", recording=SimpleNamespace(rate=None), files=())
    arrays, units = scan_of(errors=errors, heights=heights, sensor=psd)._arrays()
    found = {name: float(arrays[name].ravel()[0]) for name in arrays if name not in names}
    points = {f"{kind}_{axis}": first + k for kind, first in (("sigma", 20.0), ("systematic", 30.0), ("phase", 50.0))
              for k, axis in enumerate("xyz")}  # fmt: skip
    assert found == points | {"map_sigma": 70.0, "map_systematic": 40.0, "map_phase": 60.0}
    assert {units[name] for name in found} == {"m"}
    assert units["intensity"] == units["map_intensity"] == "A"
    partial = dataclasses.replace(errors, systematic=None, phase=None, map_systematic=None, map_phase=None)
    assert [name for name in scan_of(errors=partial)._arrays()[0] if name not in names] == [
        "sigma_x",
        "sigma_y",
        "sigma_z",
    ]
