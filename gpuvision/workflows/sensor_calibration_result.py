"""Result of the calibration of a laser sensor: report, picture and sensor file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.calibration import Calibration
from gpuvision.formats.json import json_tree, report_text
from gpuvision.formats.sensor_file import sensor_text
from gpuvision.host.channels import Channel
from gpuvision.host.files import write_text_atomic
from gpuvision.host.outputs import Outputs
from gpuvision.plots.sensor_calibration import SensorPicture, draw_sensor_calibration
from gpuvision.ranging.sensor_geometry import SensorGeometry
from gpuvision.ranging.sheet_readings import Along
from gpuvision.ranging.sheet_result import SheetFit
from gpuvision.ranging.transport_calibration import TransportFit
from gpuvision.workflows.laser_images import LineImage
from gpuvision.workflows.sensor_camera import KnownCamera, known_grid

Float64 = npt.NDArray[np.float64]

# Every n-th reading serves for the covariance of the triangulation, which is smooth over the image.
_EVERY = 16


@dataclass(frozen=True, kw_only=True)
class SensorCalibration:
    """Calibrated laser sensor with the images that were used.

    Attributes
    ----------
    name : str
        Name of the sensor.
    calibration : Calibration or KnownCamera
        Camera with its target views: first the views of `lines`, then the transport views.
    geometry : SensorGeometry
        Camera, sheet of light and transport with their covariance.
    along : {"columns", "rows"}
        Image axis along which the laser line runs.
    channel : str
        Channel of colour images that holds the laser.
    lines : tuple of LineImage or None
        Laser line of each target view; None without a laser image.
    other_lines : tuple of LineImage
        Laser lines on a stepped block, or known points.
    cell : float
        Cell of the height map for scans [m].
    warnings : tuple of str
        Doubts about the camera, then about sheet and transport.
    """

    name: str
    calibration: Calibration | KnownCamera
    geometry: SensorGeometry
    along: Along
    channel: Channel
    lines: tuple[LineImage | None, ...]
    other_lines: tuple[LineImage, ...]
    cell: float
    warnings: tuple[str, ...]

    @property
    def readings(self) -> tuple[LineImage, ...]:
        """All laser lines, in the order of the sheet's residuals."""
        return (*(each for each in self.lines if each is not None), *self.other_lines)

    def summary(self) -> str:
        """Return one line: readings, residual, bend and step."""
        sheet, geometry = self.geometry.sheet, self.geometry
        used = len(self.readings)
        readings = sum(map(len, sheet.residuals))
        shape = "flat" if sheet.bend is None else "bent by " + ", ".join(f"{each:.3g}" for each in sheet.bend) + " /m"
        how = "given" if geometry.transport is None else f"+- {self.step_sigma * 1e9:.2g} nm"
        return (
            f"laser line in {used} images, {readings} readings ({sheet.outliers} rejected): residual "
            f"{sheet.rms_px:.3g} px rms, sheet {shape}; step {geometry.step * 1e6:.6g} um ({how}); relative sigma of "
            f"heights {self.scale_sigma[0]:.1e}, of x and y {self.scale_sigma[1]:.1e} without the error of the pitch"
        )

    @cached_property
    def scale_sigma(self) -> tuple[float, float]:
        """Relative standard deviations of the scales of heights and of lateral lengths by the calibration."""
        return self.geometry.scale_sigma(self.some_pixels())

    def some_pixels(self) -> Float64:
        """Return readings of the laser lines, (n, 2), spread over the calibrated part of the image."""
        return np.concatenate([each.points for each in self.readings])[::_EVERY]

    @property
    def step_sigma(self) -> float:
        """Standard deviation of the step [m]; 0 if the step was given."""
        transport = self.geometry.transport
        if transport is None:
            return 0.0
        covariance = transport.covariance(self.geometry.camera_covariance)
        return float(math.sqrt(transport.direction @ covariance @ transport.direction))

    def report(self) -> dict[str, Any]:
        """Return the calibration as a tree of numbers and strings for JSON."""
        geometry = self.geometry
        return {
            "name": self.name,
            "camera": self.calibration.report(),
            "along": self.along,
            "channel": self.channel,
            "sheet": _sheet_report(geometry.sheet, geometry.camera_covariance),
            "laser_images": [
                {"name": each.image.name, "readings": len(each.points), "threshold": each.threshold, "note": each.note}
                for each in self.readings
            ],
            "transport": None if geometry.transport is None else self._transport_report(geometry.transport),
            "step_m": geometry.step,
            "scale_sigma": {"height": self.scale_sigma[0], "lateral": self.scale_sigma[1]},
            "cell_m": self.cell,
            "scene": {"axes": geometry.scene_axes.tolist(), "origin": geometry.scene_origin.tolist()},
            "covariance": {"names": list(geometry.names), "matrix": geometry.covariance.tolist()},
            "warnings": list(self.warnings),
        }

    def _transport_report(self, transport: TransportFit) -> dict[str, Any]:
        return {
            "step_m": transport.step.tolist(),
            "step_sigma_m": self.step_sigma,
            "residuals": transport.residuals.tolist(),
            "rotations": transport.rotations.tolist(),
            "view_ratio": transport.view_ratio,
        }


def _sheet_report(sheet: SheetFit, camera_covariance: Float64) -> dict[str, Any]:
    test = sheet.bend_test
    sigmas = np.sqrt(np.diag(sheet.covariance(camera_covariance)))
    return {
        "origin": sheet.origin.tolist(),
        "g_axis": sheet.g_axis.tolist(),
        "h_axis": sheet.h_axis.tolist(),
        "bend": None if sheet.bend is None else list(sheet.bend),
        "bend_test": None if test is None else test._asdict(),
        "sigma": dict(zip(sheet.names, sigmas.tolist(), strict=True)),
        "sigma_px": sheet.sigma_px,
        "rms_px": sheet.rms_px,
        "readings": sum(map(len, sheet.residuals)),
        "outliers": sheet.outliers,
        "view_ratio": sheet.view_ratio,
    }


def sensor_calibration_files(path: Path) -> tuple[Path, Path, Path]:
    """Return the files that `write_sensor_calibration` writes: sensor file, report and picture."""
    return path, path.with_suffix(".json"), path.with_suffix(".png")


def write_sensor_calibration(
    calibration: SensorCalibration, path: Path, *, inputs: Sequence[Path] = (), overwrite: bool = False
) -> None:
    """Write sensor file (TOML), report (.json) and picture (.png) into one folder; after an error no file is written.

    Parameters
    ----------
    calibration : SensorCalibration
        Result of `calibrate_sensor`.
    path : Path
        Sensor file to write.
    inputs : sequence of Path
        Files and folders that were read and are never replaced, besides the images of the calibration.
    overwrite : bool
        Whether files may be replaced that no earlier calibration wrote. Default False.

    Raises
    ------
    FileExistsError
        A file is an input; or it exists, and is not an unchanged output of an earlier calibration.
    """
    used = calibration.calibration
    images = [each.image for each in used.detected_targets] + [each for each, _ in used.skipped_images]
    images += [each.image for each in calibration.readings]
    images += [used.file] if isinstance(used, KnownCamera) else []
    text = sensor_text(
        calibration.geometry,
        name=calibration.name,
        size=used.image_size,
        along=calibration.along,
        channel=calibration.channel,
        cell=calibration.cell,
        pixels=calibration.some_pixels(),
    )
    report = report_text(json_tree(calibration.report()))
    outputs = Outputs("calibrate", inputs=[*images, *inputs], overwrite=overwrite)
    with outputs.folder(path.parent) as inside:
        sensor_file, report_file, picture = sensor_calibration_files(inside / path.name)
        write_text_atomic(report_file, report)
        draw_sensor_calibration(picture, _picture(calibration))
        write_text_atomic(sensor_file, text)


def _picture(calibration: SensorCalibration) -> SensorPicture:
    """Return the plain data of the picture; its image is the laser image with the most readings, on a target if any."""
    grids = {
        line.image: known_grid(target)
        for target, line in zip(calibration.calibration.detected_targets, calibration.lines, strict=True)
        if line is not None
    }
    line = max(calibration.readings, key=lambda each: (each.image in grids, len(each.points)))
    first = calibration.calibration.detected_targets[0]
    is_image = bool(grids) or not math.isnan(line.threshold)
    sheet = calibration.geometry.sheet
    return SensorPicture(
        title=f"{calibration.calibration.summary()}\n{calibration.summary()}",
        image=line.image if is_image else first.image,
        grid=grids.get(line.image, np.zeros((0, 0, 2)) if is_image else known_grid(first)),
        line=line.points,
        lines=tuple(each.points for each in calibration.readings),
        coordinates=sheet.coordinates,
        residuals=sheet.residuals,
        sigma_px=sheet.sigma_px,
    )
