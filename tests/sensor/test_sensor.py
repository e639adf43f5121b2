"""Sensor files: operations from files; errors with key, unit and range."""

from __future__ import annotations

import copy
import math
import re
import tomllib
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.formats.camera_file import write_lens
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdNoise, PsdReadout
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.schema import DescriptionError, Section, read_preset
from gpuvision.sensor.sensor import Sensor

SHIPPED = sorted(Path(each.name).stem for each in resources.files("gpuvision").joinpath("presets", "sensors").iterdir())


def table_of(name: str) -> dict[str, Any]:
    return tomllib.loads(
        resources.files("gpuvision").joinpath("presets", "sensors", f"{name}.toml").read_text(encoding="utf-8")
    )


TABLES = {name: table_of(name) for name in SHIPPED}
SIGMAS = ("focal_length_px", "principal_point_px", "axis_point", "sheet_offset", "axis_direction", "sheet_normal")
SIGMAS += ("first_angle", "angle_scale")


def sensor_of(table: dict[str, Any]) -> Sensor:
    return Sensor.from_section(Section(table, "sensor.toml"))


def changed(name: str, **values: Any) -> dict[str, Any]:
    """Return a shipped table with changed values; double underscores are dots in the keys, None removes a key."""
    table = copy.deepcopy(TABLES[name])
    for dotted, value in values.items():
        *way, key = dotted.split("__")
        place = table
        for each in way:
            place = place.setdefault(each, {})
        if value is None:
            del place[key]
        else:
            place[key] = value
    return table


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_sensors_load_by_name_and_as_files(name: str) -> None:
    path = resources.files("gpuvision").joinpath("presets", "sensors", f"{name}.toml")
    with resources.as_file(path) as file:
        assert Sensor.load(file) == Sensor.load(name)
    assert Sensor.load(name).kind == ("psd" if name.startswith("psd") else "camera")


def test_values_reach_the_operations() -> None:
    camera, psd, corner = (Sensor.load(name) for name in ("camera_line", "psd_line", "corner_scene"))
    assert isinstance(camera.readout, LineReadout)
    assert (camera.readout.window, camera.readout.threshold, camera.readout.ambiguity) == (4, 16.0, 0.4)
    assert camera.readout.axes.position_pitch == -1.0
    assert camera.readout.triangulation is not None
    assert camera.readout.triangulation.lens is not None
    # Rows 0 to 63 are u = 48 to -15, columns 0 to 479 are v = -239.5 to 239.5.
    assert camera.readout.triangulation.region == ((-15.0, 48.0), (-239.5, 239.5))
    assert isinstance(psd.readout, PsdReadout)
    assert (psd.readout.ampere, psd.readout.dark, psd.frame) == (50e-12, (2e-9, 2e-9), (96, 2))
    assert psd.readout.noise == PsdNoise(independent=0.2e-9, bandwidth=20e3, spot=25e-6, dark_current=4e-9)
    assert psd.readout.applied_margin == pytest.approx(75e-6)
    assert isinstance(psd.transport, StraightTransport)
    assert psd.transport.step == 0.25e-3
    assert isinstance(corner.transport, RotatingSheet)
    assert corner.transport.along == corner.readout.along == "rows"
    assert math.degrees(corner.transport.transport(128)[-1]) == pytest.approx(13.0, abs=1e-9)
    assert corner.output.limits[2] == (-0.1, 3.0)


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("psd_line", "psd__strips", 1),
        ("psd_line", "psd__ampere", 1.0),
        ("psd_line", "psd__dark", [0.0, 0.0]),
        ("psd_line", "psd__right_gain", 1.0),
        ("psd_line", "psd__load_resistance", 0.0),
        ("psd_line", "psd__minimum_total", 0.0),
        ("psd_line", "triangulation__horizon", 1e-3),
        ("psd_line", "transport__start", 0.0),
        ("psd_line", "output__max_gap", 0.75e-3),  # three cells
        ("psd_line", "output__max_step", math.inf),
        ("psd_line", "output__fold_tolerance", 0.0),
        ("psd_line", "output__folded", "drop"),
        ("psd_line", "output__ambiguous", "drop"),
        ("psd_line", "light__blur", 0.0),
        ("psd_line", "light__bins", 64),
        ("psd_line", "light__responsivity", 0.4),
        ("psd_line", "light__ambient", 0.0),
        ("psd_line", "light__modulated", "no"),
        ("camera_line", "recording__channel", "grey"),
        ("camera_line", "line__along", "columns"),
        ("camera_line", "light__exposure", 1e-3),
        ("camera_line", "light__full_well", 20_000.0),
        ("camera_line", "light__read_noise", 0.0),
        ("corner_scene", "transport__sheet_offset", 0.0),
        ("corner_scene", "transport__horizon", 1e-4),
        ("corner_scene", "transport__scene_axes", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        ("corner_scene", "transport__scene_origin", [0.0, 0.0, 0.0]),
        ("corner_scene", "transport__jitter", 0.0),
        *(("corner_scene", f"transport__sigma__{key}", 0.0) for key in SIGMAS),
        *(("psd_line", f"psd__noise__{key}", 0.0) for key in ("independent", "opposed", "spot", "dark_current")),
        *(("psd_line", f"axes__{end}_origin", 0.0) for end in ("position", "sample")),
        *(("psd_line", f"axes__{end}_pitch", 1.0) for end in ("position", "sample")),
        ("psd_line", "recording__damaged", "drop"),
        ("psd_line", "light__thickness", 0.0),
        ("psd_line", "light__sub_sheets", 1),
        ("psd_line", "light__nodes", [1.0, 1.0]),
        ("psd_line", "transport__jitter", 0.0),
        ("psd_line", "transport__g_axis", [1.0, 0.0, 0.0]),
        ("psd_line", "transport__h_axis", [0.0, 0.0, 1.0]),
        ("psd_line", "transport__direction", [0.0, 1.0, 0.0]),
        ("psd_line", "transport__origin", [0.0, 0.0, 0.0]),
    ],
)
def test_a_key_that_is_left_out_has_its_default(name: str, key: str, value: Any) -> None:
    stated = changed(name, transport__sigma__angle_scale=0.1) if "sigma" in key else changed(name)
    place = stated
    *way, last = key.split("__")
    for each in way:
        place = place.setdefault(each, {})
    place[last] = value
    expected = sensor_of(copy.deepcopy(stated))
    del place[last]
    assert sensor_of(stated) == expected


@pytest.mark.parametrize(
    ("name", "key", "accepted", "refused"),
    [
        ("psd_line", "triangulation__tilt", [-1.5, 1.5], [-1.6, 1.6]),
        ("psd_line", "triangulation__baseline", [1e-9], [0.0]),
        ("psd_line", "triangulation__stand_off", [1e-9], [0.0]),
        ("psd_line", "triangulation__focal_distance", [1e-9], [0.0]),
        ("psd_line", "triangulation__horizon", [1e-9, 0.9], [0.0, 1.0]),
        ("psd_line", "psd__strips", [1], [0]),
        ("psd_line", "psd__strip_length", [1e-3], [0.0]),
        ("psd_line", "psd__ampere", [1e-12], [0.0]),
        ("psd_line", "psd__right_gain", [1e-3], [0.0]),
        ("psd_line", "psd__minimum_total", [0.0], [-1e-12]),
        ("psd_line", "transport__jitter", [0.0], [-1e-12]),
        ("psd_line", "output__cell", [1e-6], [0.0]),
        ("psd_line", "output__max_gap", [0.25e-3], [0.249e-3]),
        ("psd_line", "output__fold_tolerance", [0.0], [-1e-12]),
        ("psd_line", "light__aperture", [1e-6], [0.0]),
        ("psd_line", "light__blur", [0.0], [-1e-12]),
        ("psd_line", "light__bins", [2], [1]),
        ("psd_line", "light__ambient", [0.0], [-1e-12]),
        ("camera_line", "line__threshold", [0.0], [-1.0]),
        ("camera_line", "line__window", [1, 180], [0, 181]),
        ("camera_line", "light__exposure", [1e-9], [-1e-9]),
        ("camera_line", "light__full_well", [1e-3], [0.0]),
        ("camera_line", "light__read_noise", [0.0], [-1e-9]),
        ("corner_scene", "transport__horizon", [1e-9, 0.9], [0.0, 1.0]),
        ("corner_scene", "transport__jitter", [0.0], [-1e-12]),
        ("corner_scene", "transport__first_angle", [6.28, -6.28], [6.29, -6.29]),
        ("corner_scene", "transport__angle_step", [], [3.15, -3.15]),
        ("corner_scene", "transport__focal_length_px", [1.0], [0.0]),
        ("corner_scene", "transport__encoder_bits", [2, 52], [1, 53]),
        *(("corner_scene", f"transport__sigma__{key}", [0.0], [-1e-12]) for key in SIGMAS),
        ("camera_line", "frame__columns", [2], [0]),
        ("camera_line", "frame__rows", [2], [0]),
        ("camera_line", "line__minimum_peak", [16.0], [-1e-9]),
        ("camera_line", "line__minimum_width", [1], [0]),
        ("camera_line", "line__maximum_width", [1], [0]),
        ("camera_line", "line__saturation", [100.0], [0.0]),
        ("camera_line", "line__ambiguity", [1e-9, 1.0], [0.0, 1.001]),
        ("camera_line", "line__fir_length", [4, 8], [3, 9]),
        ("camera_line", "line__read_noise", [0.0], [-1e-9]),
        ("camera_line", "line__gain", [0.0], [-1e-9]),
        ("camera_line", "line__speckle", [0.0], [-1e-9]),
        ("camera_line", "recording__rate", [1e-9], [0.0]),
        ("camera_line", "output__max_step", [1e-9], [0.0]),
        ("psd_line", "psd__margin", [0.0], [-1e-12]),
        ("psd_line", "psd__saturation", [1e-6], [0.0]),
        ("psd_line", "psd__load_resistance", [0.0], [-1e-12]),
        ("psd_line", "psd__interelectrode_resistance", [1e-3], [0.0]),
        *(
            ("psd_line", f"psd__noise__{key}", [0.0], [-1e-12])
            for key in ("independent", "opposed", "spot", "dark_current", "background")
        ),
        ("psd_line", "psd__noise__bandwidth", [1e-3], [-1e-12]),
        ("psd_line", "light__power", [1e-9], [0.0]),
        ("psd_line", "light__thickness", [0.0], [-1e-12]),
        ("psd_line", "light__sub_sheets", [1], [0]),
        ("psd_line", "light__patch_size", [1e-9], [0.0]),
        ("psd_line", "light__responsivity", [1e-9], [0.0]),
        ("psd_line", "light__nodes", [[1.0, 1.0]], [[0.0, 1.0], [1.0, 0.0], [1.0, 1.5]]),
    ],
)
def test_numbers_of_a_file_are_accepted_up_to_their_limits(
    name: str, key: str, accepted: list[float], refused: list[float]
) -> None:
    for value in accepted:
        sensor_of(changed(name, **{key: value}))
    for value in refused:
        with pytest.raises(DescriptionError, match=re.escape(f"sensor.toml: {key.replace('__', '.')} is {value}")):
            sensor_of(changed(name, **{key: value}))


def test_every_value_of_a_file_reaches_its_field() -> None:
    """A different number for every key."""
    line = {"method": "gauss3", "threshold": 17.0, "window": 5, "peak_selection": "last", "minimum_peak": 41.0}
    line |= {"minimum_width": 2, "maximum_width": 9, "saturation": 250.0, "ambiguity": 0.3, "fir_length": 4}
    line |= {"read_noise": 1.5, "gain": 0.05, "speckle": 0.7}
    axes = {"position_origin": 47.0, "position_pitch": -1.5, "sample_origin": -230.0, "sample_pitch": 2.0}
    recording = {"channel": "red", "key": "frames", "rate": 900.0, "background": "median", "damaged": "keep"}
    light = {"lens": [0.1, 0.2, 0.3], "aperture": 4e-3, "power": 2.0, "thickness": 5e-5, "source": [0.0, 0.4]}
    light |= {"width": [-0.1, 0.2], "profile": [[-0.1, 0.5], [0.2, 0.7]], "sub_sheets": 3, "blur": 0.9, "bins": 65}
    light |= {"nodes": [2, 3], "patch_size": 1e-3, "responsivity": 0.5, "ambient": 1e-9, "modulated": "yes"}
    light |= {"exposure": 2e-3, "full_well": 1e4, "read_noise": 11.0}
    transport = {"kind": "straight", "step": 3e-4, "start": 0.1, "jitter": 1e-5, "g_axis": [0.0, 1.0, 0.0]}
    transport |= {"h_axis": [1.0, 0.0, 0.0], "direction": [0.0, 0.6, 0.8], "origin": [0.1, -0.2, 0.3]}
    transport |= {"covariance": [[1e-8, 0.0, 1e-9], [0.0, 2e-8, 0.0], [1e-9, 0.0, 3e-8]]}
    output = {"cell": 2e-4, "max_gap": 5e-4, "max_step": 6e-4, "fold_tolerance": 1e-4, "folded": "top"}
    output |= {"ambiguous": "keep", "x": [-1.0, 2.0], "y": [-3.0, 4.0], "z": [-5.0, 6.0]}
    tables = {"line": line, "axes": axes, "recording": recording, "light": light, "output": output}
    sensor = sensor_of(TABLES["camera_line"] | tables | {"transport": transport})
    assert isinstance(sensor.readout, LineReadout)
    assert {key: getattr(sensor.readout, key) for key in line} == line
    assert {key: getattr(sensor.readout.axes, key) for key in axes} == axes
    assert {key: getattr(sensor.recording, key) for key in recording} == recording
    assert sensor.light is not None
    assert {key: as_lists(getattr(sensor.light, key)) for key in light} == light | {"modulated": True}
    del transport["kind"]
    assert {key: as_lists(getattr(sensor.transport, key)) for key in transport} == transport
    assert sensor.output.limits == ((-1.0, 2.0), (-3.0, 4.0), (-5.0, 6.0))
    of_output = [key for key in output if key not in "xyz"]
    assert [getattr(sensor.output, key) for key in of_output] == [output[key] for key in of_output]
    # Columns 0 to 479 and rows 0 to 63, mirrored along u; v has a pitch of 2.
    assert sensor.readout.triangulation is not None
    assert sensor.readout.triangulation.region == ((-47.5, 47.0), (-230.0, 728.0))
    assert sensor.noise_known


def test_every_value_of_a_psd_and_of_a_rotating_sheet_reaches_its_field() -> None:
    psd = {"strip_length": 7e-3, "ampere": 2e-12, "dark": [1e-9, 3e-9], "right_gain": 1.1, "minimum_total": 6e-8}
    psd |= {"interelectrode_resistance": 1e5, "load_resistance": 100.0, "saturation": 3e-6, "margin": 1e-4}
    psd |= {"linearity": [[-1e-3, 0.0], [1e-3, 1e-5]]}
    noise = {"independent": 1e-10, "opposed": 2e-10, "spot": 3e-5, "bandwidth": 1e4, "dark_current": 5e-9}
    noise |= {"background": 7e-9}
    sensor = sensor_of(TABLES["psd_line"] | {"psd": psd | {"strips": 95, "noise": noise}})
    assert isinstance(sensor.readout, PsdReadout)
    assert {key: as_lists(getattr(sensor.readout, key)) for key in psd} == psd
    assert sensor.readout.noise == PsdNoise(**noise)
    assert sensor.frame == (95, 2)
    assert sensor.noise_known
    # The strip from end to end, and 95 strips.
    assert sensor.readout.triangulation is not None
    assert sensor.readout.triangulation.region == ((-3.5e-3, 3.5e-3), pytest.approx((-5.9375e-3, 5.8125e-3)))
    assert not sensor_of(changed("psd_line", psd__noise=None)).noise_known

    rotating = {"focal_length_px": 2000.0, "principal_point_px": [500.0, 900.0], "axis_point": [0.1, 0.2, 0.3]}
    rotating |= {"axis_direction": [0.0, 0.6, 0.8], "sheet_normal": [1.0, 0.0, 0.0], "sheet_offset": 0.01}
    rotating |= {"first_angle": -0.2, "jitter": 1e-4, "angle_step": 3e-3, "scene_origin": [1.0, 2.0, 3.0]}
    rotating |= {"scene_axes": [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], "horizon": 1e-3}
    sigma = {key: 0.001 * number for number, key in enumerate(SIGMAS, 1)}
    sensor = sensor_of(TABLES["corner_scene"] | {"transport": rotating | {"kind": "rotating", "sigma": sigma}})
    assert {key: as_lists(getattr(sensor.transport, key)) for key in rotating} == rotating
    assert {key: getattr(sensor.rotating_sigma, key) for key in sigma} == sigma
    assert sensor_of(TABLES["corner_scene"]).rotating_sigma is None
    assert not sensor.noise_known


def as_lists(value: Any) -> Any:
    """Return a value of a field as a file has it."""
    return [as_lists(each) for each in value] if isinstance(value, tuple) else value


def test_background_of_a_psd_is_its_ambient_light() -> None:
    """The photocurrent of the ambient light is the default of the background; margin and background can be stated."""

    def readout(**values: Any) -> PsdReadout:
        made = sensor_of(changed("psd_line", **values)).readout
        assert isinstance(made, PsdReadout)
        assert made.noise is not None
        return made

    ambient = {"light__ambient": 20e-6, "light__responsivity": 0.3}
    assert readout(**ambient).noise.background == pytest.approx(6e-6)
    assert readout(**ambient, psd__noise__background=1e-6).noise.background == 1e-6
    assert readout(**ambient, psd__noise__background=0.0).noise.background == 0.0
    assert readout(**ambient, psd__noise__bandwidth=0.0, psd__noise__dark_current=0.0).noise.background == 0.0
    assert readout(light=None).noise.background == 0.0
    assert readout(psd__margin=0.0).applied_margin == 0.0
    assert readout(psd__margin=0.2e-3).applied_margin == 0.2e-3


def test_ways_to_say_the_same_triangulation_agree() -> None:
    by_setup = sensor_of(TABLES["camera_line"]).readout.triangulation
    assert by_setup is not None
    G, H = (each.ravel() for each in np.meshgrid(np.linspace(-0.02, 0.02, 5), np.linspace(0.0, 0.005, 4)))
    points = np.column_stack([G, H])
    sensor = by_setup.to_sensor(points)
    h = np.array(by_setup.homography) / by_setup.homography[2][2]
    b, z0 = 0.08, 0.15
    d = math.hypot(b, z0)
    empty = changed("camera_line", triangulation=None)
    tables = {
        "homography": {"homography": h.tolist()},
        "constants": {"constants": h.ravel()[:8].tolist()},
        "points": {"points": np.column_stack([sensor, points]).tolist()},
    }
    for name, table in tables.items():
        triangulation = sensor_of(empty | {"triangulation": table}).readout.triangulation
        assert triangulation is not None
        np.testing.assert_allclose(triangulation.to_sensor(points), sensor, rtol=0, atol=1e-6, err_msg=name)
    # Without [axes], u and v are the columns and rows of the camera.
    posed = changed("camera_line", triangulation=None, axes=None, lens=None) | {
        "triangulation": {
            "focal_length_px": 1600.0,
            "principal_point_px": [239.5, 48.0],
            # In the camera's frame (x right, y down, z forward): the sheet's origin lies on the axis, H points up.
            "sheet_origin": [0.0, 0.0, d],
            "g_axis": [1.0, 0.0, 0.0],
            "h_axis": [0.0, -b / d, -z0 / d],
        }
    }
    triangulation = sensor_of(posed).readout.triangulation
    straight = sensor_of(changed("camera_line", lens=None)).readout.triangulation
    assert triangulation is not None
    assert straight is not None
    u, v = straight.to_sensor(points).T
    np.testing.assert_allclose(
        triangulation.to_sensor(points), np.column_stack([48.0 - u, v + 239.5]), rtol=0, atol=1e-9
    )


WRONG = [
    ("camera_line", {"line__treshold": 3}, r"unknown key 'line.treshold'; did you mean 'line.threshold'\?"),
    ("camera_line", {"colour": "red"}, r"unknown key 'colour'; known: kind, name, "),
    ("camera_line", {"psd": {}}, r"unknown key 'psd'"),
    ("camera_line", {"transport__step": None}, r"'transport.step' is missing, expected a number \[m per profile\]"),
    (
        "camera_line",
        {"transport__step": None, "transport__stp": 1e-3},
        r"'transport.step' is missing.*is it 'transport.stp'\?",
    ),
    ("camera_line", {"frame": None}, r"the table \[frame\] with columns and rows \[pixel\] is missing"),
    ("camera_line", {"output__cell": 0}, r"output.cell is 0 m, expected a number \[m\] above 0"),
    ("camera_line", {"output__cell": -0.5}, r"output.cell is -0.5 m, expected a number \[m\] above 0"),
    ("camera_line", {"output__cell": "1 mm"}, r"output.cell is '1 mm', expected a number \[m\] above 0"),
    ("camera_line", {"output__cell": True}, r"output.cell is True, expected a number"),
    ("camera_line", {"output__cell": math.nan}, r"output.cell is nan m, expected a number"),
    (
        "camera_line",
        {"output__max_gap": 1e-5},
        r"output.max_gap is 1e-05 m, expected a number \[m\] of at least 0.0001",
    ),
    ("camera_line", {"output__x": [1.0, -1.0]}, r"output.x is \[1.0, -1.0\], expected the lowest below the highest"),
    ("camera_line", {"line__method": "gauss"}, r'line.method is \'gauss\', expected one of .*did you mean "gauss3"\?'),
    ("camera_line", {"line__window": 2.5}, r"line.window is 2.5, expected a whole number of at least 1 and of at most"),
    ("camera_line", {"line__ambiguity": 1.5}, r"line.ambiguity is 1.5 share of the peak, expected .* of at most 1"),
    ("camera_line", {"line__fir_length": 5}, r"LineReadout.fir_length is 5"),
    (
        "camera_line",
        {"triangulation__tilt": 2.0},
        r"triangulation.tilt is 2.0 rad, expected .*\[rad\] above -1.5708 and",
    ),
    ("camera_line", {"triangulation__constants": [1, 2, 3]}, r"\[triangulation\] has constants and baseline at once"),
    ("camera_line", {"triangulation": {}}, r"\[triangulation\] has no geometry, expected one of homography, constants"),
    ("camera_line", {"triangulation": {"homography": [[1, 0], [0, 1]]}}, r"homography is .*rows of 3 numbers"),
    (
        "camera_line",
        {"triangulation": {"homography": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}},
        r"sees the sheet of light edge-on",
    ),
    ("camera_line", {"triangulation": {"points": []}}, r"points is \[\].*, expected a list of rows of 4 numbers"),
    ("camera_line", {"triangulation": {"points": [[]]}}, r"points is \[\[\]\].*, expected a list of rows of 4 numbers"),
    ("camera_line", {"lens__k1": 1e308}, r"lens.k1 is 1e\+308 sensor unit\^-2, expected a size of at most 1e\+20"),
    ("camera_line", {"lens__k1": 1e19}, r"Lens.k1 is 1e\+19, expected a size of at most 1e\+10"),
    ("camera_line", {"transport__step": 1e308}, r"step is 1e\+308 m per profile, expected a size of at most 1000"),
    ("camera_line", {"transport__step": -(10**400)}, r"step is -10+ \.\.\., expected a size of at most 1000"),
    ("camera_line", {"line__minimum_peak": 1e308}, r"minimum_peak is 1e\+308 grey levels, expected a size of at most"),
    ("camera_line", {"line__minimum_peak": 10**400}, r"minimum_peak is 10+ \.\.\., expected a size of at most"),
    (
        "camera_line",
        {"line__minimum_width": 10**400},
        r"minimum_width is 10+ \.\.\., expected a whole number of at most",
    ),
    ("camera_line", {"transport__origin": [0, 0, 1e30]}, r"transport.origin is 1e\+30 m, expected a size of at most"),
    ("camera_line", {"transport": 3}, r"transport is 3, expected a table \[transport\]"),
    ("camera_line", {"transport__direction": [1, 0]}, r"transport.direction is \[1, 0\], expected a list of 3 numbers"),
    ("camera_line", {"transport__direction": [1, 0, 0]}, r"sensor.toml: StraightTransport: .*one plane"),
    ("camera_line", {"recording__channel": "infrared"}, r"recording.channel is 'infrared', expected one of"),
    ("camera_line", {"kind": "radar"}, r"kind is 'radar', expected one of \"camera\", \"psd\""),
    ("camera_line", {"kind": "psd"}, r"the key 'psd' is missing, expected a table"),
    ("psd_line", {"psd__strips": 0}, r"psd.strips is 0, expected a whole number of at least 1"),
    ("psd_line", {"psd__strip_length": None}, r"'psd.strip_length' is missing, expected a number \[m\] above 0"),
    ("psd_line", {"psd__noise__indepedent": 1e-9}, r"'psd.noise.indepedent'; did you mean 'psd.noise.independent'"),
    ("psd_line", {"psd__noise__bandwidth": 0.0}, r"PsdNoise.dark_current needs bandwidth \[Hz\]"),
    ("psd_line", {"psd__margin": 3.1e-3}, r"PsdReadout.margin is 0.0031 m; expected 0 or more, and below half a strip"),
    ("psd_line", {"psd__margin": -1e-3}, r"psd.margin is -0.001 m, expected a number \[m\] of at least 0"),
    ("psd_line", {"psd__load_resistance": 50.0}, r"load_resistance needs interelectrode_resistance"),
    ("psd_line", {"transport__kind": "rotating"}, r'transport.kind is \'rotating\', expected one of "straight"'),
    ("corner_scene", {"transport__angle_step": 4.0}, r"transport.angle_step is 4.0 rad per profile, expected"),
    ("corner_scene", {"triangulation": {}}, r"unknown key 'triangulation'"),
    ("corner_scene", {"transport__sheet_normal": [0, 1, 0]}, r"the sheet's normal lies along the axis"),
]


@pytest.mark.parametrize(
    ("name", "values", "message"), WRONG, ids=[f"{n}-{'+'.join(v)}-{i}" for i, (n, v, _) in enumerate(WRONG)]
)
def test_what_a_file_cannot_say(name: str, values: dict[str, Any], message: str) -> None:
    with pytest.raises(DescriptionError, match=message) as caught:
        sensor_of(changed(name, **values))
    assert str(caught.value).startswith("sensor.toml: ")
    assert "\n" not in str(caught.value)


def places(table: dict[str, Any], way: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Yield all tables of a description."""
    inner = [places(value, (*way, key)) for key, value in table.items() if isinstance(value, dict)]
    return [way, *(each for found in inner for each in found)]


@given(data=st.data(), key=st.from_regex(r"\A[a-z][a-z_]{0,11}\Z"))
def test_an_unknown_key_is_refused_wherever_it_stands(data: st.DataObject, key: str) -> None:
    name = data.draw(st.sampled_from(SHIPPED))
    path = data.draw(st.sampled_from(places(TABLES[name])))
    table = copy.deepcopy(TABLES[name])
    place = table
    for each in path:
        place = place[each]
    key = f"x_{key}"
    place[key] = 1
    with pytest.raises(DescriptionError, match=f"unknown key '{'.'.join((*path, key))}'"):
        sensor_of(table)


@given(data=st.data())
def test_a_missing_table_or_key_never_is_more_than_a_line(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(SHIPPED))
    path = data.draw(st.sampled_from(places(TABLES[name])))
    table = copy.deepcopy(TABLES[name])
    place = table
    for each in path:
        place = place[each]
    del place[data.draw(st.sampled_from(sorted(place)))]
    message = ""
    try:
        sensor_of(table)
    except DescriptionError as error:
        message = str(error)
    assert "\n" not in message


def test_files_that_are_no_sensor(tmp_path: Path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_text("kind = camera\n")
    with pytest.raises(DescriptionError, match=r"broken.toml: not valid TOML: .*line 1"):
        Sensor.load(broken)
    broken.write_bytes(b"\xff\xfe")
    with pytest.raises(DescriptionError, match=r"broken.toml: not valid TOML"):
        Sensor.load(broken)
    with pytest.raises(FileNotFoundError, match=r"no sensor file .*corner.toml; did you mean 'corner_scene'\?"):
        Sensor.load(tmp_path / "corner.toml")
    with pytest.raises(FileNotFoundError, match="give a file or one of camera_line, corner_scene, psd_line"):
        Sensor.load(tmp_path / "nothing")


def test_frames_of_another_sensor_are_refused() -> None:
    camera, psd = Sensor.load("camera_line"), Sensor.load("psd_line")
    camera.check_frame((64, 480), "here")
    psd.check_frame((96, 2), "here")
    with pytest.raises(
        ValueError, match=r"here: frames have shape \(480, 64\).*expects \(rows, columns\) = \(64, 480\)"
    ):
        camera.check_frame((480, 64), "here")
    with pytest.raises(ValueError, match=r"expects \(strips, 2\) = \(96, 2\)"):
        psd.check_frame((96,), "here")


LIGHT = """
[light]
aperture = 8e-3
power = 0.5
thickness = 40e-6
source = [0.0, 0.3]
width = [-0.02, 0.02]
profile = [[-0.02, 0.5], [0.0, 1.0], [0.02, 0.5]]
nodes = [2, 1]
modulated = "yes"
"""


def test_a_setup_in_metres_says_where_the_lens_is(tmp_path):
    path = tmp_path / "sensor.toml"
    brought = resources.files("gpuvision").joinpath("presets", "sensors", "psd_line.toml").read_text(encoding="utf-8")
    path.write_text(brought.split("[light]")[0] + LIGHT)
    light = Sensor.load(path).light
    assert light is not None
    assert light.lens == (0.0, 0.08, 0.15)
    assert (light.aperture, light.power, light.thickness, light.source) == (8e-3, 0.5, 40e-6, (0.0, 0.3))
    assert (light.width, light.nodes, light.modulated, light.bins) == ((-0.02, 0.02), (2, 1), True, 64)
    assert light.profile == ((-0.02, 0.5), (0.0, 1.0), (0.02, 0.5))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[light]\npower = 1.0", "light.aperture' is missing"),
        ("[light]\naperture = 1.0\npower = 0.0", "light.power is 0.0 W/m, expected a number .W/m. above 0"),
        ("[light]\naperture = 1.0\npower = 1.0\nnodes = [1.5, 1]", "two whole numbers"),
        ("[light]\naperture = 1.0\npower = 1.0\nsigma = 1", "unknown key 'light.sigma'"),
    ],
)
def test_what_a_light_cannot_be(tmp_path, text, words):
    path = tmp_path / "sensor.toml"
    brought = resources.files("gpuvision").joinpath("presets", "sensors", "psd_line.toml").read_text(encoding="utf-8")
    path.write_text(brought.split("[light]")[0] + text)
    with pytest.raises(DescriptionError, match=words):
        Sensor.load(path)


@pytest.mark.parametrize("key", ["baseline", "foo"])
def test_a_rotating_sheet_with_a_light_has_no_triangulation(key: str) -> None:
    light = {"aperture": 1e-3, "power": 1.0}
    with pytest.raises(DescriptionError, match=r"sensor\.toml: unknown key 'triangulation'"):
        sensor_of({**changed("corner_scene"), "light": light, "triangulation": {key: 0.1}})
    assert sensor_of({**changed("corner_scene"), "light": light}).light is not None


@pytest.mark.parametrize("background", ["none", "median", "previous", "dark_after", "dark_before"])
def test_backgrounds_by_name(background: str) -> None:
    sensor = sensor_of(changed("camera_line", recording__background=background))
    assert sensor.recording.background == background


def test_a_background_image_lies_beside_the_sensor_file(tmp_path: Path) -> None:
    table = changed("camera_line", recording__background="dark/scene.png")
    sensor = Sensor.from_section(Section(table, "sensor.toml", folder=tmp_path))
    assert sensor.recording.background == tmp_path / "dark" / "scene.png"
    assert sensor.files == (tmp_path / "dark" / "scene.png",)


@pytest.mark.parametrize("background", [3, "", True, ["median"]])
def test_other_backgrounds_are_refused(background: Any) -> None:
    with pytest.raises(DescriptionError, match=r"sensor\.toml: recording\.background is .*, expected "):
        sensor_of(changed("camera_line", recording__background=background))


def test_strips_have_no_background_of_frames() -> None:
    with pytest.raises(DescriptionError, match=r"unknown key 'recording\.background'"):
        sensor_of(changed("psd_line", recording__background="median"))


def test_an_automatic_threshold() -> None:
    sensor = sensor_of(changed("camera_line", line__threshold="auto"))
    assert sensor.auto_threshold
    assert not Sensor.load("camera_line").auto_threshold
    with pytest.raises(DescriptionError, match=r"line\.threshold is 'automatic', expected a number"):
        sensor_of(changed("camera_line", line__threshold="automatic"))


@pytest.mark.parametrize("content", ["kind = camera\n", 'kind = "psdd"\n', "[[[", "#" * (1 << 20) + "\n"])
def test_messages_show_the_path_as_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str) -> None:
    """Two sensors of the same name in two folders: the base name does not tell them apart."""
    (tmp_path / "left").mkdir()
    (tmp_path / "left" / "sensor.toml").write_text(content)
    monkeypatch.chdir(tmp_path)
    for path in (Path("left") / "sensor.toml", tmp_path / "left" / "sensor.toml"):
        with pytest.raises(DescriptionError) as caught:
            Sensor.load(path)
        assert str(caught.value).startswith(f"{path}: ")


def test_messages_call_a_preset_by_its_name() -> None:
    with pytest.raises(DescriptionError, match=r"^preset camera_line: the key 'nothing' is missing"):
        read_preset("camera_line", "sensors", "sensor").section("nothing")


def test_a_folder_is_no_sensor_file(tmp_path: Path) -> None:
    (tmp_path / "sensor.toml").mkdir()
    with pytest.raises(IsADirectoryError, match=r"sensor\.toml: a folder, expected a TOML file"):
        Sensor.load(tmp_path / "sensor.toml")


# ---- lens of a calibration ----------------------------------------------------------------------------------


PIXEL_LENS = Lens(k1=-3e-8, k2=2e-14, k3=-1e-21, centre=(251.3, 40.2))


def with_lens_file(folder: Path, size: Any = (480, 64), lens: Any = PIXEL_LENS, **values: Any) -> Sensor:
    """Return the shipped camera with the lens of a file; size (columns, rows) of the calibrated images."""
    (folder / "lens.toml").unlink(missing_ok=True)
    write_lens(folder / "lens.toml", lens, {} if size is None else {"image": {"size": list(size)}})
    table = changed("camera_line", lens={"file": "lens.toml"}, **values)
    return Sensor.from_section(Section(table, "sensor.toml", folder=folder))


@pytest.mark.parametrize("pitch", [1.0, -1.0, 3.5e-6])
@pytest.mark.parametrize("window", [(0.0, 0.0), (64.0, 200.0)])
def test_the_lens_of_a_calibration_acts_on_the_pixels_of_the_frames(
    tmp_path: Path, pitch: float, window: tuple[float, float]
) -> None:
    """Undistorted pixels of the calibrated image, mapped to sensor coordinates, against the sensor's lens."""
    size = (480, 64) if window == (0.0, 0.0) else (1920, 1080)
    values = {"lens__window": list(window)} if any(window) else {}
    table = changed("camera_line", lens={"file": "lens.toml"}, axes__sample_pitch=abs(pitch), **values)
    table["axes"]["position_pitch"] = pitch
    write_lens(tmp_path / "lens.toml", PIXEL_LENS, {"image": {"size": list(size)}})
    sensor = Sensor.from_section(Section(table, "sensor.toml", folder=tmp_path))
    lens: Any = sensor.readout.triangulation.lens
    axes = table["axes"]
    pixels = np.random.default_rng(1).uniform((0, 0), (479, 63), (200, 2))
    straight = PIXEL_LENS.undistort(pixels + window) - window

    def mapped(points: Any) -> Any:
        column = axes["sample_origin"] + axes["sample_pitch"] * points[:, 0]
        return np.stack([column, axes["position_origin"] + axes["position_pitch"] * points[:, 1]], axis=1)

    np.testing.assert_allclose(lens.undistort(mapped(pixels)), mapped(straight), rtol=0, atol=1e-9 * abs(pitch) * 480)


def test_the_lens_of_a_calibration_for_other_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"480 x 64 pixels, .* calibrated at 1920 x 1080; give lens\.window"):
        with_lens_file(tmp_path, (1920, 1080))
    with pytest.raises(DescriptionError, match=r"window from \(1500.0, 0.0\) with binning 1 ends at .*, outside"):
        with_lens_file(tmp_path, (1920, 1080), lens__window=[1500.0, 0.0])
    assert with_lens_file(tmp_path, None).readout.triangulation is not None
    with pytest.raises(DescriptionError, match=r"pitches of equal size in \[axes\]"):
        with_lens_file(tmp_path, axes__sample_pitch=2.0)
    with pytest.raises(DescriptionError, match=r"has a table \[camera\], expected \[lens\]"):
        with_lens_file(tmp_path, lens=Camera(matrix=((900.0, 0.0, 240.0), (0.0, 900.0, 32.0), (0.0, 0.0, 1.0))))
    with pytest.raises(DescriptionError, match=r"unknown key 'lens\.k1'"):
        sensor_of(changed("camera_line", lens={"file": "lens.toml", "k1": 0.1}))


# ---- calibrated camera --------------------------------------------------------------------------------------


TILTED_CAMERA = Camera(
    matrix=((905.0, 0.0, 251.0), (0.0, 900.0, 36.0), (0.0, 0.0, 1.0)),
    distortion=(-0.1, 0.05, 1e-3, -2e-3, *(0.0,) * 8, 0.3, -0.05),
)
SHEET_POSE = {"sheet_origin": [0.001, 0.0, 0.3], "g_axis": [1.0, 0.0, 0.0], "h_axis": [0.0, -0.6, -0.8]}


def with_camera(camera: dict[str, Any], folder: Path = Path(), **values: Any) -> Sensor:
    """Return the shipped camera sensor with a table [camera] and the pose of the sheet in the camera frame."""
    table = changed("camera_line", **{"axes": None, "lens": None, "triangulation": SHEET_POSE, **values})
    return Sensor.from_section(Section(table | {"camera": camera}, "sensor.toml", folder=folder))


def test_a_calibrated_camera_by_its_keys_and_by_its_file(tmp_path: Path) -> None:
    """Both ways project a point of the sheet onto the pixel that the camera projects it to."""
    write_lens(tmp_path / "camera.toml", TILTED_CAMERA, {"image": {"size": [480, 64]}, "fit": {"rms_px": 0.1}})
    inline = with_camera(TILTED_CAMERA.to_dict())
    assert with_camera({"file": "camera.toml"}, tmp_path) == inline
    triangulation = inline.readout.triangulation
    assert triangulation is not None
    assert triangulation.camera == TILTED_CAMERA
    assert triangulation.region == ((0.0, 63.0), (0.0, 479.0))
    sheet = np.random.default_rng(1).uniform((-0.05, -0.005), (0.05, 0.005), (50, 2))
    scene = np.array(SHEET_POSE["sheet_origin"]) + sheet @ np.array([SHEET_POSE["g_axis"], SHEET_POSE["h_axis"]])
    np.testing.assert_allclose(triangulation.to_sensor(sheet), TILTED_CAMERA.project(scene)[:, ::-1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("way", ["inline", "file"])
def test_the_window_of_a_calibrated_camera(tmp_path: Path, way: str) -> None:
    write_lens(tmp_path / "camera.toml", TILTED_CAMERA, {"image": {"size": [1920, 1080]}})
    camera: dict[str, Any] = {"file": "camera.toml"} if way == "file" else TILTED_CAMERA.to_dict()
    sensor = with_camera({**camera, "window": [12.0, 7.0]}, tmp_path)
    assert sensor.readout.triangulation is not None
    assert sensor.readout.triangulation.camera == TILTED_CAMERA.in_window((12.0, 7.0))


def test_other_ways_to_give_the_sheet_of_a_calibrated_camera() -> None:
    by_pose = with_camera(TILTED_CAMERA.to_dict()).readout.triangulation
    assert by_pose is not None
    sheet = np.random.default_rng(1).uniform((-0.05, -0.005), (0.05, 0.005), (50, 2))
    sensor = by_pose.to_sensor(sheet)
    ways = {
        "homography": {"homography": [list(row) for row in by_pose.homography]},
        "points": {"points": np.column_stack([sensor, sheet]).tolist()},
    }
    for name, table in ways.items():
        found = with_camera(TILTED_CAMERA.to_dict(), triangulation=table).readout.triangulation
        assert found is not None
        np.testing.assert_allclose(found.to_sensor(sheet), sensor, rtol=0, atol=1e-6, err_msg=name)


def test_the_bend_of_a_sheet_reaches_the_transport() -> None:
    """Its pinhole is the origin of the camera frame, in the coordinates of the sheet."""
    bent = with_camera(TILTED_CAMERA.to_dict(), triangulation=SHEET_POSE | {"bend": [0.2, -0.1, 0.3]})
    assert isinstance(bent.transport, StraightTransport)
    bend = bent.transport.bend
    assert bend is not None
    assert bend.terms == (0.2, -0.1, 0.3)
    # g_axis x h_axis is (0, 0.8, -0.6).
    assert bend.pinhole == pytest.approx((-0.001, 0.24, 0.18), abs=1e-15)
    flat = with_camera(TILTED_CAMERA.to_dict())
    assert bent.readout.triangulation == flat.readout.triangulation
    assert isinstance(flat.transport, StraightTransport)
    assert flat.transport.bend is None
    with pytest.raises(DescriptionError, match=r"triangulation: .* g_axis and h_axis are not two orthonormal"):
        with_camera(
            TILTED_CAMERA.to_dict(), triangulation=SHEET_POSE | {"bend": [0.2, 0.1, 0.3], "g_axis": [1.0, 0.1, 0.0]}
        )
    with pytest.raises(DescriptionError, match=r"unknown key 'triangulation\.bend'"):
        sensor_of(changed("camera_line", triangulation__bend=[0.2, 0.1, 0.3]))


def test_a_calibrated_camera_before_a_rotating_sheet() -> None:
    table = changed("corner_scene", transport__focal_length_px=None, transport__principal_point_px=None)
    shipped = Sensor.load("corner_scene").transport
    assert isinstance(shipped, RotatingSheet)
    sensor = sensor_of(table | {"camera": TILTED_CAMERA.to_dict()})
    expected = replace(shipped, focal_length_px=None, principal_point_px=None, camera=TILTED_CAMERA)
    assert sensor.transport == expected
    with pytest.raises(DescriptionError, match=r"unknown key 'transport\.focal_length_px'"):
        sensor_of(changed("corner_scene") | {"camera": TILTED_CAMERA.to_dict()})


def test_plane_polynomials_of_a_triangulation() -> None:
    """G = p(v, u) and H = q(v, u) in the coordinates of the axes."""
    p = [0.001, 2e-4, 1e-6, 0.0, 1e-8, 0.0, 0.0, 1e-11]
    q = [0.002, -1e-4, 2e-6, 1e-8, 0.0, 0.0, 1e-11, 0.0]
    table = changed("camera_line", lens=None, triangulation={"p": p, "q": q})
    triangulation = sensor_of(table).readout.triangulation
    assert triangulation is not None
    polynomial = PlanePolynomial(p=tuple(p), q=tuple(q), region=((-239.5, 239.5), (-15.0, 48.0)))
    assert triangulation == Triangulation.from_polynomial(polynomial)
    with pytest.raises(DescriptionError, match=r"triangulation: .*has a polynomial and a lens"):
        sensor_of(changed("camera_line", triangulation={"p": p, "q": q}))


def test_errors_of_a_calibrated_camera(tmp_path: Path) -> None:
    camera = TILTED_CAMERA.to_dict()
    write_lens(tmp_path / "camera.toml", TILTED_CAMERA, {"image": {"size": [1920, 1080]}})
    write_lens(tmp_path / "lens.toml", PIXEL_LENS, {})
    with pytest.raises(DescriptionError, match=r"calibrated at 1920 x 1080; give camera\.window"):
        with_camera({"file": "camera.toml"}, tmp_path)
    with pytest.raises(DescriptionError, match=r"has a table \[lens\], expected \[camera\]"):
        with_camera({"file": "lens.toml"}, tmp_path)
    with pytest.raises(DescriptionError, match=r"unknown key 'camera\.k1'"):
        with_camera({"file": "camera.toml", "k1": 0.1}, tmp_path)
    with pytest.raises(DescriptionError, match=r"\[lens\] and \[camera\] exclude each other"):
        with_camera(camera, lens={"k1": 1e-8})
    with pytest.raises(DescriptionError, match=r"\[axes\] and \[camera\] exclude each other"):
        with_camera(camera, axes={"sample_pitch": 2.0})
    with pytest.raises(DescriptionError, match=r"has no geometry, expected one of homography, points, sheet_origin"):
        with_camera(camera, triangulation={"baseline": 0.1, "stand_off": 0.2, "focal_distance": 900.0})
    with pytest.raises(DescriptionError, match=r"unknown key 'camera'"):
        sensor_of(changed("psd_line") | {"camera": camera})
    with pytest.raises(DescriptionError, match=r"camera: Camera.matrix has focal lengths -1"):
        with_camera({"matrix": [[-1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]})
