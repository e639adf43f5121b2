"""Speed-accuracy curves: summary of errors, Pareto front, order of measured errors, pictures and command."""

from __future__ import annotations

import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from typer.testing import CliRunner

from gpuvision.cli import curves as command
from gpuvision.cli.main import application
from gpuvision.host.errors import GpuVisionError
from gpuvision.profiling import curves, machine
from gpuvision.profiling.curves import (
    board_image,
    curve,
    deposits,
    field_pose,
    line_fit,
    line_irradiance,
    plot,
    rays,
    undistort_points,
)

NUMBERS = st.lists(st.tuples(*[st.integers(0, 4).map(float)] * 3), min_size=1, max_size=8)


def test_errors_leave_out_samples_without_a_value():
    errors = curve.Errors([3.0, -4.0, math.nan, 0.0])
    assert errors.rms == pytest.approx(math.sqrt(25.0 / 3.0))
    assert errors.largest == 4.0
    assert errors.p95 == pytest.approx(3.9)
    assert errors.lost == 0.25


def test_errors_of_nothing_are_nan():
    errors = curve.Errors([math.nan, math.nan])
    assert errors.lost == 1.0
    assert all(math.isnan(each) for each in (errors.rms, errors.p95, errors.largest))


@given(NUMBERS)
def test_every_setting_is_on_the_front_or_beaten_by_one_on_it(settings):
    best = curve.pareto_front(settings)
    front = [each for each, is_best in zip(settings, best, strict=True) if is_best]
    assert front
    for each, is_best in zip(settings, best, strict=True):
        beaten = any(other != each and all(np.less_equal(other, each)) for other in front)
        assert is_best != beaten


def test_a_setting_without_a_value_is_not_on_the_front():
    assert curve.pareto_front([(1.0, math.nan, 1.0), (2.0, 3.0, 0.0)]) == [False, True]


def test_operations_are_the_modules_of_the_package():
    files = {path.stem for path in Path(curves.__file__).parent.glob("*.py")} - {"__init__", "curve", "plot"}
    assert set(curve.OPERATIONS) == files


def test_an_unknown_operation_is_named_before_another_one_is_measured(device):
    lines = []
    with pytest.raises(ValueError, match="no curves of 'lines'; expected some of psd, line"):
        curve.measure_curves(["pose", "lines"], [device], progress=lines.append)
    assert lines == []


def test_errors_of_points_are_distances():
    distances = curve.distance([[3.0, 4.0], [math.nan, 0.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    assert distances[[0, 2]].tolist() == [5.0, 0.0]
    assert math.isnan(distances[1])


def errors_of(operation, device):
    return {(each.data, *each.parameters.items()): each.errors for each in operation.settings(device)}


# Their settings compile many kernels.
NIGHTLY = {"blob", "board_pose", "line", "line_irradiance", "rays", "ruler", "undistort_image", "undistort_points"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "operation",
    [pytest.param(each, marks=[pytest.mark.nightly] * (each in NIGHTLY)) for each in curve.OPERATIONS],
)
def test_settings_are_distinct_and_measure_most_samples(operation, device):
    settings = list(importlib.import_module(f"gpuvision.profiling.curves.{operation}").settings(device))
    if operation == "occluded_irradiance" and not device.has_double:
        assert not settings
        return
    assert len({(each.data, *each.parameters.items()) for each in settings}) == len(settings) > 3
    for each in settings:
        assert each.operation == operation
        assert math.isfinite(each.errors.rms)
        assert each.errors.lost < 0.8


def test_a_lens_model_with_all_coefficients_leaves_rounding_only(device, monkeypatch):
    models = ("k1", "14 coefficients")  # each model is a build of the kernel
    monkeypatch.setattr(undistort_points, "_MODELS", {name: undistort_points._MODELS[name] for name in models})
    errors = errors_of(undistort_points, device)
    data = "lens of 14 coefficients"
    worst = [errors[data, ("model", model), ("precision", "single")].largest for model in models]
    assert worst[0] > 1.0
    assert worst[1] < 1e-3  # a few units in the last place of 1280 px
    if device.has_double:
        assert errors[data, ("model", "14 coefficients"), ("precision", "double")].largest < 1e-9


def test_the_robust_loss_pays_with_outliers_only(device, monkeypatch):
    # Each loss is a build of the kernel.
    changes = ({"loss": "least_squares"}, {"loss": "tukey", "max_trials": 64})
    assert all(each in line_fit._CHANGES for each in changes)
    monkeypatch.setattr(line_fit, "_CHANGES", changes)
    errors = errors_of(line_fit, device)

    def rms(data, loss):
        parameters = (("max_trials", 64), ("max_iterations", 12), ("loss", loss), ("precision", "single"))
        return errors[data, *parameters].rms

    # Least squares on points with noise of 0.05 px: standard deviation 0.05 / sqrt(20) px at the middle; u is not
    # centred, which adds a little.
    assert rms("0% outliers", "least_squares") == pytest.approx(0.05 / math.sqrt(20.0), rel=0.1)
    assert rms("30% outliers", "least_squares") > 1.0 > 20.0 * rms("30% outliers", "tukey")


def rms_of(settings, **chosen):
    """Return the root mean squares of the settings with chosen parameters."""
    return [each.errors.rms for each in settings if chosen.items() <= dict(each.parameters).items()]


def test_more_sub_poses_are_closer_to_the_exposure(device, monkeypatch):
    monkeypatch.setattr(board_image, "_MOTIONS", {"motion of 8 px": 8e-5})
    found = rms_of(board_image.settings(device), dtype="float32")
    assert np.all(np.diff(found) < 0.0)
    assert found[-1] < 1e-2 * found[0]


def test_twice_the_segments_of_an_arc_have_a_quarter_of_the_error(device, monkeypatch):
    monkeypatch.setattr(line_irradiance, "_DISTANCES", {"near": (1.0, 3.0)})
    monkeypatch.setattr(line_irradiance, "_RECEIVERS", 10)
    monkeypatch.setattr(line_irradiance, "_COUNTS", (4, 8, 16))  # each count is a build of the kernel
    found = np.array(rms_of(line_irradiance.settings(device), precision="single"))
    assert np.all((found[:-1] > 3.0 * found[1:]) & (found[:-1] < 5.0 * found[1:]))


def test_the_threshold_at_half_of_the_height_measures_the_area(device):
    found = rms_of(deposits.settings(device), precision="single")
    assert np.argmin(found) == 2
    assert found[2] < 0.1 * min(found[0], found[-1])


def test_shadow_rays_need_a_clearance_that_is_below_the_gaps(device, monkeypatch):
    monkeypatch.setattr(rays, "_RAYS", 60)
    errors = [each.errors.rms for each in rays.settings(device) if "clearance" in each.parameters]
    assert errors[0] > 0.1
    assert max(errors[1:3]) == 0.0


def test_a_finer_map_finds_a_robot_better(device):
    found = list(field_pose.settings(device))
    search = [each.errors.rms for each in found if "cell" in each.parameters]
    assert search == sorted(search)
    steps = rms_of(found, max_iterations=1) + rms_of(found, max_iterations=40)
    assert steps[1] < 0.5 * steps[0]


def test_a_picture_for_each_operation(tmp_path):
    common = {"operation": "psd", "unit": "m", "seconds_low": 1e-5, "seconds_high": 3e-5, "device": "pocl"}
    points = [
        curve.Point(**common, data=data, parameters={"least": k}, seconds=2e-5 * k, rms=1e-6 / k, p95=2e-6,
                    largest=3e-6, lost=0.0, best=k > 1)
        for data in ("dim", "bright") for k in (1, 2, 3)
    ]  # fmt: skip
    assert plot.draw_curves(tmp_path / "plots", points) == ["curve-psd.png"]
    assert (tmp_path / "plots" / "curve-psd.png").read_bytes().startswith(b"\x89PNG")


def test_a_point_is_described_by_the_parameters_that_differ():
    common = {
        "operation": "psd", "data": "dim", "device": "pocl", "unit": "m", "seconds": 1.0, "seconds_low": 1.0,
        "seconds_high": 1.0, "rms": 1.0, "p95": 1.0, "largest": 1.0, "lost": 0.0, "best": True,
    }  # fmt: skip
    points = [curve.Point(**common, parameters={"window": 3, "method": each}) for each in ("ml", "fir")]
    assert plot.describe(points[0], points) == "method ml"


@pytest.mark.slow
def test_the_command_writes_points_and_pictures(device, tmp_path):
    options = ["--device", device.label, "--seconds", "0.01", "--json", str(tmp_path / "points.json")]
    result = CliRunner().invoke(application(), ["curves", "pose", *options, "--plots", str(tmp_path / "plots")])
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "points.json").read_text())
    assert list(report["machine"]["devices"]) == [device.label]
    assert {point["operation"] for point in report["points"]} == {"pose"}
    assert any(point["best"] for point in report["points"])
    assert (tmp_path / "plots" / "curve-pose.png").exists()


def points_of(setting):
    """Return two settings of psd on dim light and one on bright light."""
    return [
        curve.Point("psd", data, {"least": least}, "pocl", seconds, 1e-5, 1e-4, unit, 1.25e-6, 2.6e-6, 3e-6, lost, best)
        for data, least, seconds, unit, lost, best in setting
    ]


SETTINGS = (
    ("dim", 1, 1.5e-5, "m", 0.25, True),
    ("dim", 2, 2.5e-5, "m", 0.0, False),
    ("bright", 1, 3.5e-5, "px", 1, True),
)


@pytest.mark.parametrize("written", [False, True])
def test_the_command_shows_or_prints_what_was_measured(written, tmp_path, monkeypatch):
    calls = []

    def measure(operations, devices, *, seconds, progress):
        progress("measures")
        calls.append((operations, devices, seconds))
        return points_of(SETTINGS)

    monkeypatch.setattr(curve, "measure_curves", measure)
    monkeypatch.setattr(machine, "describe_machine", lambda devices: {"devices": devices})
    monkeypatch.setattr(command, "devices_of", lambda labels: labels or ["all"])
    monkeypatch.setattr(plot, "write_png", lambda figure, path: path.touch())
    plots = tmp_path / "plots"
    chosen = ["psd", "--device", "pocl", "--json", "-"] if written else []
    ran = CliRunner().invoke(application(), ["curves", *chosen, "--seconds", "0.5", "--plots", str(plots)])
    assert ran.exit_code == 0, ran.output
    assert calls == [(["psd"], ["pocl"], 0.5) if written else (curve.OPERATIONS, ["all"], 0.5)]
    assert ran.stderr.splitlines() == ["measures", f"look at {plots / 'curve-psd.png'}"]
    assert (plots / "curve-psd.png").exists()
    if written:
        points = [each.to_dict() for each in points_of(SETTINGS)]
        assert json.loads(ran.stdout) == {"machine": {"devices": ["pocl"]}, "points": points}
        return
    lines = [line.strip() for line in ran.stdout.splitlines() if line.strip(" ─")]
    heading = ["setting", "time", "[µs]", "rms", "p95", "lost", "best"]
    assert lines[0] == "psd, dim, pocl"
    assert [line.split() for line in lines[1:4]] == [
        heading,
        ["least", "1", "15", "1.25e-06", "m", "2.6e-06", "25.0%", "*"],
        ["least", "2", "25", "1.25e-06", "m", "2.6e-06", "0.0%"],
    ]
    assert lines[4] == "psd, bright, pocl"
    assert [line.split() for line in lines[5:]] == [heading, ["35", "1.25e-06", "px", "2.6e-06", "100.0%", "*"]]


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(GpuVisionError, match="the package numba is missing; install it: pip install"):
        CliRunner().invoke(application(), ["curves", "psd"], catch_exceptions=False)
