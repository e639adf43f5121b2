"""Machine files: TOML with camera, calibration, axes, controller, delay and tolerances of a placement machine.

The package contains the machines in `MACHINES`; ``docs/reference/machine_files.md`` lists the keys.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import tomli_w

from gpuvision.camera.camera import Camera
from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.lens import Lens
from gpuvision.formats.camera_file import check_calibrated_size, read_calibrated_size, read_lens
from gpuvision.formats.cmos_sensor_file import CMOS_SENSORS, read_cmos_sensor
from gpuvision.host.files import atomic_write
from gpuvision.host.reading import reason_of
from gpuvision.schema import Section, read_preset, read_toml
from gpuvision.servoing.axis import Axis, FineStage
from gpuvision.servoing.frames import CAMERA, PIPETTE, Transform
from gpuvision.servoing.placement.control import CONTROLLERS, OBSERVERS, RULES, Control, Settling
from gpuvision.servoing.placement.machine import Machine, PlacementCamera, ThermalDrift, Tolerance

MACHINES = ("look_while_place",)
"""Names of the machines in the package."""

_NO_COVARIANCE = ((0.0, 0.0, 0.0),) * 3
_LARGEST_PIXEL = 1e-3  # size of a pixel on the board [m] (chosen): a track is narrower
_AXES = {"x": "m", "y": "m", "theta": "rad"}


def read_machine(path: str | Path, *, rate: float | None = None) -> Machine:
    """Read a placement machine.

    Parameters
    ----------
    path : str or Path
        Path of a file, or one of `MACHINES`.
    rate : float, optional
        Frames per second instead of the rate of the file.

    Returns
    -------
    Machine

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key is missing, unknown or has a wrong value, or the file of the sensor or of the lens cannot be read; the
        message names the key.
    """
    return _machine(read_preset(path, "machines", "machine"), rate)


def named_files(path: str | Path) -> tuple[Path, ...]:
    """Return the files that a machine file names: its camera file (lens), and its sensor preset, if not in the package.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        The file is not valid TOML, or the key of the sensor is missing or has a wrong value.
    """
    if str(path) in MACHINES:
        return ()
    camera = read_toml(Path(path)).section("camera")
    if camera.word("sensor", CMOS_SENSORS) is None:
        camera.file("sensor")
    if "lens" in camera:
        camera.file("lens")
    return camera.files


def write_settings(source: str | Path, machine: Machine, path: str | Path) -> None:
    """Write a machine file with other settings.

    These are camera window, frame rate, control, times of the stages, and of the release the tolerance, the fixed wait
    and the vibration.

    Parameters
    ----------
    source : str or Path
        Machine file, or one of `MACHINES`, with everything else. Files that it names are named by their absolute paths.
    machine : Machine
        Machine with the settings.
    path : str or Path
        File to write; it must not exist.

    Raises
    ------
    OSError
        The source cannot be read, or the file cannot be written.
    DescriptionError
        The source is not valid TOML.
    """
    table, control = read_preset(source, "machines", "machine").to_dict(), machine.control
    camera, loop, tolerance = table["camera"], table["loop"], table["tolerance"]
    camera["window"] = list(machine.camera.window)
    for key in ("sensor", "lens"):
        if key in camera and camera[key] not in CMOS_SENSORS:
            camera[key] = str((Path(source).parent / camera[key]).resolve())
    given: dict[str, Any] = {
        "rate": machine.rate,
        "observer": control.observer,
        "controller": control.controller,
        "gain": machine.loop_gain,
        "integral": control.integral,
        "derivative": control.derivative,
        "motion_sigma": None if control.motion_sigma is None else list(control.motion_sigma),
    }
    table["loop"] = {key: each for key, each in (loop | given).items() if each is not None}
    table["delay"] = {**table.get("delay", {}), **machine.stages}
    tolerance |= {"position": machine.tolerance.position, "angle": machine.tolerance.angle}
    settling = machine.settling
    found = {"wait": settling.wait, "frequency": settling.frequency, "damping": settling.damping}
    if found := {key: each for key, each in found.items() if each is not None}:
        table["settling"] |= found
    with atomic_write(path) as file:
        tomli_w.dump(table, file)


def _machine(top: Section, rate: float | None) -> Machine:
    top.text("name", "")
    camera, calibration = _camera(top.section("camera")), _calibration(top.section("calibration"))
    axes = top.optional_section("axes")
    loop, delay = top.section("loop"), top.optional_section("delay")
    given_rate = loop.number("rate", "Hz", above=0.0)
    control, settling = _control(loop), top.optional_section("settling")
    transfer, landing, stages = (0.0, 0.0, {}) if delay is None else _delay(delay)
    tolerance, drift = _tolerance(top.section("tolerance")), top.optional_section("drift")
    machine_drift = ThermalDrift() if drift is None else _drift(drift)
    release = Settling() if settling is None else _settling(settling)
    machine_axes, swing = ((Axis(), Axis(), Axis()), (0.0, 0.0, 0.0)) if axes is None else _axes(axes)
    top.finish()
    with top.checking():
        return Machine(
            camera=camera,
            pipette_in_camera=calibration,
            tolerance=tolerance,
            axes=machine_axes,
            rate=given_rate if rate is None else rate,
            transfer=transfer,
            stages=stages,
            landing=landing,
            control=control,
            settling=release,
            drift=machine_drift,
            swing=swing,
        )


def _camera(table: Section) -> PlacementCamera:
    name = table.word("sensor", CMOS_SENSORS)
    file = table.file("sensor") if name is None else name
    try:
        sensor = read_cmos_sensor(file)
    except OSError as error:
        raise table.error(f"camera.sensor: {reason_of(error)}") from error
    window = table.numbers("window", "px", (2,))
    pixel = table.number("pixel", "m", above=0.0, at_most=_LARGEST_PIXEL)
    exposure = table.number("exposure", "s", above=0.0)
    electrons = table.number("electrons", "electrons", None, above=0.0)
    blur_px = table.number("blur_px", "px", 0.5, at_least=0.0)
    lens = _lens(table, sensor)
    table.finish()
    with table.checking():
        if any(each != int(each) for each in window):
            raise ValueError(f"window is {list(window)}, expected whole numbers of rows and columns")
        rows, columns = (int(each) for each in window)
        return PlacementCamera(
            sensor=sensor,
            pixel=pixel,
            window=(rows, columns),
            exposure=exposure,
            electrons=electrons,
            blur_px=blur_px,
            lens=lens,
        )


def _lens(table: Section, sensor: CmosSensor) -> Lens | Camera | None:
    """Return the lens in pixels of an image of the whole sensor; None without a lens."""
    has_file = table.text("lens", None) is not None
    k1, k2 = table.number("k1", "px^-2", None), table.number("k2", "px^-4", None)
    if (has_file and k1 is not None) or (k1 is None and k2 is not None):
        raise table.error("camera: give lens, or k1 with k2 or without it")
    rows, columns = sensor.shape
    with table.checking():
        if k1 is not None:
            return Lens(k1=k1, k2=k2 or 0.0, centre=((columns - 1) / 2.0, (rows - 1) / 2.0))
    if not has_file:
        return None
    path = table.file("lens")
    try:
        model, size = read_lens(path), read_calibrated_size(path)
    except OSError as error:
        raise table.error(f"camera.lens: {reason_of(error)}") from error
    with table.checking():
        check_calibrated_size(path, (columns, rows), size, hint="calibrate with images of the whole sensor")
    return model


def _calibration(table: Section) -> Transform:
    pose = table.numbers("pipette", "m, m, rad", (3,))
    covariance = table.rows("pipette_covariance", "m^2, m rad, rad^2", 3, _NO_COVARIANCE)
    if len(covariance) != 3:
        raise table.error(f"{table.dotted('pipette_covariance')} has {len(covariance)} rows, expected 3")
    table.finish()
    with table.checking():
        return Transform.rigid(PIPETTE, CAMERA, pose, covariance)


def _control(table: Section) -> Control:
    observer = table.choice("observer", OBSERVERS, "latest")
    controller = table.choice("controller", CONTROLLERS, "p")
    gain = table.number("gain", "", None, above=0.0)
    integral = table.number("integral", "s", None, above=0.0)
    derivative = table.number("derivative", "s", None, at_least=0.0)
    motion_sigma = table.numbers("motion_sigma", "m, m, rad", (3,), None)
    watchdog = table.number("watchdog", "frames", None, above=1.0)
    table.finish()
    with table.checking():
        return Control(
            observer=observer,
            controller=controller,
            gain=gain,
            integral=integral,
            derivative=derivative,
            motion_sigma=_three(motion_sigma),
            watchdog=math.inf if watchdog is None else watchdog,
        )


def _settling(table: Section) -> Settling:
    rule = table.choice("rule", RULES)
    wait = table.number("wait", "s", None, above=0.0)
    frequency = table.numbers("frequency", "Hz", (3,), None)
    damping = table.numbers("damping", "", (3,), None)
    miss = table.number("miss_probability", "", 0.0027, above=0.0, at_most=1.0)
    window = table.integer("window", 24, at_least=4)
    lead = table.number("lead", "s", 0.0, at_least=0.0)
    table.finish()
    with table.checking():
        return Settling(
            rule=rule,
            wait=wait,
            frequency=_three(frequency),
            damping=_three(damping),
            miss_probability=miss,
            window=window,
            lead=lead,
        )


def _three(values: tuple[float, ...] | None) -> tuple[float, float, float] | None:
    return None if values is None else (values[0], values[1], values[2])


def _axes(table: Section) -> tuple[tuple[Axis, Axis, Axis], tuple[float, float, float]]:
    """Return the axes and the largest amplitudes of their vibration after the long move."""
    sections = {name: table.optional_section(name) for name in _AXES}
    table.finish()
    found = [(Axis(), 0.0) if each is None else _axis(each, _AXES[name]) for name, each in sections.items()]
    (x, swing_x), (y, swing_y), (theta, swing_theta) = found
    return (x, y, theta), (swing_x, swing_y, swing_theta)


def _axis(table: Section, unit: str) -> tuple[Axis, float]:
    fine = table.optional_section("fine")
    values = {
        "lag": table.number("lag", "s", 0.0, at_least=0.0),
        "viscous": table.number("viscous", "1/s", 0.0, at_least=0.0),
        "coulomb": table.number("coulomb", f"{unit}/s^2", 0.0, at_least=0.0),
        "acceleration": _limit(table, "acceleration", f"{unit}/s^2"),
        "speed": _limit(table, "speed", f"{unit}/s"),
        "resonance": 2.0 * math.pi * table.number("resonance", "Hz", 0.0, at_least=0.0),
        "damping": table.number("damping", "", 0.05, at_least=0.0, at_most=1.0),
        "encoder": table.number("encoder", unit, 0.0, at_least=0.0),
    }
    swing = table.number("swing", unit, 0.0, at_least=0.0)
    stage = None if fine is None else _fine(fine, unit)
    table.finish()
    with table.checking():
        return Axis(**values, fine=stage), swing


def _limit(table: Section, key: str, unit: str) -> float:
    """Return a limit; infinite without the key."""
    value = table.number(key, unit, None, above=0.0)
    return math.inf if value is None else value


def _fine(table: Section, unit: str) -> FineStage:
    values = {
        "lag": table.number("lag", "s", above=0.0),
        "stroke": table.number("stroke", unit, above=0.0),
        "recentring": table.number("recentring", "1/s", 20.0, at_least=0.0),
    }
    table.finish()
    return FineStage(**values)


def _delay(table: Section) -> tuple[float, float, dict[str, float]]:
    transfer = table.number("transfer", "s", 0.0, at_least=0.0)
    landing = table.number("landing", "s", 0.0, at_least=0.0)
    stages = {key: table.number(key, "s", 0.0, at_least=0.0) for key in ("vision", "control", "drive")}
    table.finish()
    return transfer, landing, {name: time for name, time in stages.items() if time}


def _tolerance(table: Section) -> Tolerance:
    values = {
        "position": table.number("position", "m", above=0.0),
        "angle": table.number("angle", "rad", above=0.0),
        "landing_zone": table.number("landing_zone", "m", above=0.0),
        "landing_angle": table.number("landing_angle", "rad", above=0.0),
        "max_time": table.number("max_time", "s", 1.0, above=0.0),
    }
    refused = table.integer("max_refused", 20, at_least=1)
    table.finish()
    return Tolerance(**values, max_refused=refused)


def _drift(table: Section) -> ThermalDrift:
    expansion = table.numbers("expansion", "m/K", (2,))
    sigma = table.number("temperature_sigma", "K", at_least=0.0)
    table.finish()
    return ThermalDrift(expansion=(expansion[0], expansion[1]), temperature_sigma=sigma)
