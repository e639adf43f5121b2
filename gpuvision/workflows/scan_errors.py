"""Predicted and measured errors of a scan: standard deviations of its points, and the error budget of the report.

Random errors differ from sample to sample or from profile to profile: the noise of the readout, the jitter of the
transport. Systematic errors are the same in all profiles: the calibration. The error by the phase of the line in its
pixel is the same wherever the line has the same place. The three stay apart in the files of a scan; `measured.ratio` of
the budget and the merge of scans combine the first and the last.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.normal_distribution import MAD_TO_SIGMA
from gpuvision.ranging.focus_stack import FocusPeak, FocusStack
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.line_phase import estimate_line_shape, phase_error
from gpuvision.ranging.polygon_scan import PolygonScan
from gpuvision.ranging.range_image import RangeImage, RangePoints
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.transports import Transport
from gpuvision.status import Status

Array = npt.NDArray[Any]

_PROFILES = 256  # largest number of profiles that determine the measured scatter. Chosen: its cost stays below 0.1 s
_FEWEST = 100  # smallest number of samples that determine a median absolute deviation, to about 12 %
_PLANE_SHARE = 8.0 / 9.0  # variance of a sample's residual from the plane through its 3 x 3 samples, over its variance
_HARMONICS = (1, 2)  # of the error over the phase: a threshold cuts two flanks


class PointSigma(NamedTuple):
    """Standard deviations of points.

    Attributes
    ----------
    x, y, z
        Of each coordinate [m], (profiles, samples); NaN where they are unknown.
    """

    x: Array
    y: Array
    z: Array


@dataclass(frozen=True, kw_only=True)
class ScanErrors:
    """Predicted errors of the points of a scan.

    Attributes
    ----------
    position : numpy.ndarray
        Standard deviation of the readout's positions, (profiles, samples): pixels of a camera, metres of a PSD.
    readout : PointSigma
        Random error by the noise of the readout.
    transport : PointSigma
        Random error by the jitter of the transport, the same for all samples of a profile.
    random : PointSigma
        Both together.
    systematic : PointSigma, optional
        Systematic error by the covariance of the calibration; None if the sensor file gives no covariance.
    map_systematic : numpy.ndarray, optional
        Systematic error of the height map [m], over the cells.
    phase : PointSigma, optional
        Systematic error of a camera's readout by the place of the line in its pixel: the same in all profiles that have
        the line at one place, see `gpuvision.ranging.line_phase.phase_error`. Not part of ``systematic``.
    map_phase : numpy.ndarray, optional
        ``phase`` of the height map [m], over the cells.
    phase_scatter : float
        Share of the variance of ``phase`` that scatters about a local plane, 0 to 1, see `phase_scatter`. Default 0.
    """

    position: Array
    readout: PointSigma
    transport: PointSigma
    random: PointSigma
    systematic: PointSigma | None
    map_systematic: Array | None = None
    phase: PointSigma | None = None
    map_phase: Array | None = None
    phase_scatter: float = 0.0


def sigma_outputs(sensor: Sensor) -> tuple[str, ...]:
    """Return the outputs of a readout from which `predict_errors` works; none if the sensor file gives no noise."""
    if not sensor.noise_known:
        return ()
    if not isinstance(sensor.transport, StraightTransport):
        return ("sigma",)
    sheet = getattr(sensor.readout, "triangulation", None)
    systematic = ("systematic_g", "systematic_h") if sheet is not None and sheet.covariance is not None else ()
    return ("sigma", "sigma_g", "sigma_h", *systematic)


def predict_errors(
    sensor: Sensor, fields: Mapping[str, Array], points: RangePoints, transports: Array, device: Device
) -> ScanErrors:
    """Predict the errors of the points of a scan.

    Parameters
    ----------
    sensor : Sensor
        Gives the geometry and the jitter of the transport.
    fields : mapping of str to numpy.ndarray
        Outputs of the readout by name, (profiles, samples); `sigma_outputs` lists the needed standard deviations.
    points : RangePoints
        Points of the scan.
    transports : numpy.ndarray
        Transport of each profile, (profiles,).
    device : Device
        Device of the computation.

    Returns
    -------
    ScanErrors

    Notes
    -----
    First order. g and h err together. For straight transport the error of a coordinate is taken as the sum of both
    parts: exact where the coordinate depends on one of g and h, else an upper bound. The bend of a sheet, a small part
    of the slope, is left out. Behind a polygon mirror the reading moves the spot along the beam, at twice the rotation
    of the mirror; errors of the mirror are left out. Systematic errors of a rotating sheet are its displacements by
    each standard deviation of ``sensor.rotating_sigma``.
    """
    if isinstance(sensor.transport, StraightTransport):
        axes = sensor.transport
        spread = _along_axes if sensor.polygon is None else partial(_along_beam, sensor.polygon)
        readout = spread(axes, fields["sigma_g"], fields["sigma_h"])
        shifts = [abs(each) * _jitter(sensor) for each in axes.direction]
        transport = PointSigma(*(np.full_like(each, shift) for each, shift in zip(readout, shifts, strict=True)))
        systematic = None
        if "systematic_g" in fields:
            systematic = spread(axes, fields["systematic_g"], fields["systematic_h"])
        systematic = _with_transport(axes, systematic, transports, points)
    else:
        position, sigma = fields["position"], fields["sigma"]
        readout = _displacement(sensor.transport, points, position + sigma, transports, device)
        transport = _displacement(sensor.transport, points, position, transports + _jitter(sensor), device)
        systematic = _rotating_systematic(sensor, sensor.transport, points, position, transports, device)
    random = PointSigma(*(np.hypot(*each) for each in zip(readout, transport, strict=True)))
    phase = _phase(sensor, fields, readout, device)
    return ScanErrors(
        position=fields["sigma"],
        readout=readout,
        transport=transport,
        random=random,
        systematic=systematic,
        phase=phase,
        phase_scatter=0.0 if phase is None else phase_scatter(fields["position"]),
    )


def focus_errors(sensor: Sensor, stack: FocusStack, peak: FocusPeak, points: RangePoints) -> ScanErrors:
    """Predict the random errors of the points of a focus stack.

    Parameters
    ----------
    sensor : Sensor
        Gives the directions in the scene.
    stack : FocusStack
    peak : FocusPeak
        Sharpest frames with their standard deviations.
    points : RangePoints
        Points of the scan.

    Returns
    -------
    ScanErrors
        Displacements of the points by one standard deviation of the frame number: first order.
    """
    assert isinstance(sensor.transport, StraightTransport)  # the reader of [focus] gives no other
    assert peak.sigma is not None  # the caller checks that
    everywhere = ((-math.inf, math.inf),) * 3
    x, y, z = (stack.points(peak, sensor.transport, everywhere, np.float64))[:3]
    moved = stack.points(peak._replace(frame=peak.frame + peak.sigma), sensor.transport, everywhere, np.float64)
    dtype = to_numpy(points.z).dtype
    known = np.isfinite(to_numpy(points.z))
    steps = (np.abs(to_numpy(new) - to_numpy(old)) for new, old in zip(moved[:3], (x, y, z), strict=True))
    readout = PointSigma(*(np.where(known, step, np.nan).astype(dtype) for step in steps))
    transport = PointSigma(*(np.where(known, 0.0, np.nan).astype(dtype) for _ in "xyz"))
    return ScanErrors(position=peak.sigma, readout=readout, transport=transport, random=readout, systematic=None)


def _phase(sensor: Sensor, fields: Mapping[str, Array], readout: PointSigma, device: Device) -> PointSigma | None:
    """Return the errors by the place of the line in its pixel: they move a point as the noise of the readout does."""
    if not isinstance(sensor.readout, LineReadout) or not {"position", "width"} <= fields.keys():
        return None
    good = fields["status"] == Status.OK
    peak, width, total = (fields[name][good] for name in ("peak", "width", "total"))
    shape = estimate_line_shape(peak, width, total, sensor.readout.threshold)
    error = None if shape is None else phase_error(sensor.readout, shape, fields["peak"], device)
    if error is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        share = error / fields["sigma"]
    return PointSigma(*((share * each).astype(each.dtype) for each in readout))


def _jitter(sensor: Sensor) -> float:
    """Return the standard deviation of the transport of a profile, with the quantisation of an encoder."""
    quantisation = 0.0 if sensor.encoder is None else abs(sensor.encoder.scale) / math.sqrt(12.0)
    return math.hypot(sensor.transport.jitter, quantisation)


def _along_axes(axes: StraightTransport, sigma_g: Array, sigma_h: Array) -> PointSigma:
    parts = [abs(g) * sigma_g + abs(h) * sigma_h for g, h in zip(axes.g_axis, axes.h_axis, strict=True)]
    return PointSigma(*parts)


def _along_beam(polygon: PolygonScan, axes: StraightTransport, sigma_g: Array, sigma_h: Array) -> PointSigma:
    """Return the errors of points behind a polygon mirror: an error of the reading moves a spot along its beam."""
    turned = 2.0 * polygon.rotations(sigma_h.shape[-1])
    along = zip(axes.g_axis, axes.h_axis, strict=True)
    shares = [np.abs(-g * np.sin(turned) + h * np.cos(turned)) for g, h in along]
    return PointSigma(*((share * sigma_h).astype(sigma_h.dtype) for share in shares))


def _with_transport(
    axes: StraightTransport, systematic: PointSigma | None, transports: Array, points: RangePoints
) -> PointSigma | None:
    """Add the error of the transport, which grows with the distance from L = 0, to the errors of the sheet."""
    if axes.covariance is None:
        return systematic
    distance = np.abs(transports if transports.ndim == 2 else transports[:, None])
    moved = [distance * math.sqrt(axes.covariance[i][i]) for i in range(3)]
    sheet = (np.zeros(1),) * 3 if systematic is None else systematic
    known = [np.isfinite(to_numpy(each)) for each in points[:3]]
    total = [np.where(at, np.hypot(a, b), np.nan) for at, a, b in zip(known, moved, sheet, strict=True)]
    return PointSigma(*(each.astype(to_numpy(points.x).dtype) for each in total))


def _rotating_systematic(
    sensor: Sensor, sheet: RotatingSheet, points: RangePoints, position: Array, angles: Array, device: Device
) -> PointSigma | None:
    """Return the root of the sum of the squared displacements by each error of the calibration."""
    if sensor.rotating_sigma is None:
        return None
    total = [np.zeros(position.shape) for _ in range(3)]
    varied = [(other, angles) for other in sensor.rotating_sigma.sheets(sheet)]
    varied += [(sheet, other) for other in sensor.rotating_sigma.angles(sheet, angles)]
    for geometry, turned in varied:
        moved = _displacement(geometry, points, position, turned, device)
        total = [held + by.astype(np.float64) ** 2 for held, by in zip(total, moved, strict=True)]
    return PointSigma(*(np.sqrt(each).astype(position.dtype) for each in total))


def _displacement(
    geometry: Transport, points: RangePoints, position: Array, transports: Array, device: Device
) -> PointSigma:
    """Return by how much the points move for another geometry, position or transport."""
    assemble = RangeImage(geometry=geometry)
    status = np.zeros(position.shape, np.uint8)
    moved = assemble(position, transports.astype(position.dtype), status, device=device)
    return PointSigma(*(np.abs(to_numpy(new) - to_numpy(old)) for new, old in zip(moved[:3], points[:3], strict=True)))


def scatter_about_plane(z: Array) -> float:
    """Return the robust standard deviation of heights about the plane through the 3 x 3 samples around each.

    Parameters
    ----------
    z : numpy.ndarray
        Heights of an organised range image [m], (profiles, samples); NaN in holes.

    Returns
    -------
    float
        Standard deviation [m]; NaN if fewer than 100 samples have eight neighbours.

    Notes
    -----
    For noise that is independent from sample to sample. Correlated noise (speckle larger than a sample) scatters less
    about the plane. The median absolute deviation ignores edges; a curved surface adds its curvature.
    """
    middles = _middles(len(z))
    rows = [z[middles + step].astype(np.float64) for step in (-1, 0, 1)]
    columns = rows[0] + rows[1] + rows[2]
    mean = (columns[:, :-2] + columns[:, 1:-1] + columns[:, 2:]) / 9.0
    residuals = (rows[1][:, 1:-1] - mean).ravel()
    residuals = residuals[np.isfinite(residuals)]
    if residuals.size < _FEWEST:
        return math.nan
    deviation = np.median(np.abs(residuals - np.median(residuals)))
    return float(MAD_TO_SIGMA * deviation / math.sqrt(_PLANE_SHARE))


def phase_scatter(position: Array) -> float:
    """Return the share of the phase's variance that scatters about the plane through 3 x 3 samples.

    Parameters
    ----------
    position : numpy.ndarray
        Line positions [px], (profiles, samples); NaN without a line.

    Returns
    -------
    float
        0 where neighbouring samples have the line at one place in the pixel, 1 where they have it at any place.

    Notes
    -----
    A harmonic ``exp(2 pi i k p)`` of the error, where the position p has the slopes a and b [px per profile and per
    sample], deviates from the plane by ``1 - (1 + 2 cos(2 pi k a)) (1 + 2 cos(2 pi k b)) / 9``. Of two harmonics the
    larger share counts. The slopes are means over the 3 x 3 samples, so that noise of the positions has little effect.
    """
    middles = _middles(len(position))
    above, here, below = (position[middles + step].astype(np.float64) for step in (-1, 0, 1))
    along = (below - above) / 2.0
    along = (along[:, :-2] + along[:, 1:-1] + along[:, 2:]) / 3.0
    across = (above + here + below) / 3.0
    across = (across[:, 2:] - across[:, :-2]) / 2.0
    shares = [0.0]
    for harmonic in _HARMONICS:
        a, b = (1.0 + 2.0 * np.cos(2.0 * math.pi * harmonic * each) for each in (along, across))
        deviation = 1.0 - a * b / 9.0
        known = np.isfinite(deviation)
        if known.any():
            shares.append(float(np.median(deviation[known] ** 2)) / _PLANE_SHARE)
    return min(max(shares), 1.0)


def _middles(profiles: int) -> npt.NDArray[np.int_]:
    """Return the numbers of profiles between two others: all, or `_PROFILES` that are spread evenly."""
    return np.linspace(1, profiles - 2, min(max(profiles - 2, 0), _PROFILES)).astype(int)


def error_budget(errors: ScanErrors | None, z: Array, map_sigma: Array | None, *, camera: bool) -> dict[str, Any]:
    """Return the error budget of a scan for its report: medians [m], None where they are unknown.

    Parameters
    ----------
    errors : ScanErrors or None
        Predicted errors; None without a noise model.
    z : numpy.ndarray
        Heights of the organised range image [m].
    map_sigma : numpy.ndarray or None
        Random standard deviation of the height map [m].
    camera : bool
        Whether positions are pixels.

    Returns
    -------
    dict
        ``random``: ``readout``, ``transport`` and ``total``, each with x, y and z; ``systematic``: ``calibration``;
        ``phase``: of the line in its pixel, with x, y and z; ``map``: ``random``, ``systematic`` and ``phase`` of the
        heights; ``position``: of the readout [px or m]; ``measured``:
        ``scatter`` of z about a local plane, its ``ratio`` to the predicted one (the noise of the readout, and the
        part of the phase that differs between neighbours), and ``speckle``, the value of ``[line] speckle`` [px] that
        explains a ratio above 1. It is None where noise and phase together explain the scatter.
    """
    scatter = _finite(scatter_about_plane(z))
    measured: dict[str, Any] = {"scatter": scatter, "ratio": None, "speckle": None}
    if errors is None:
        return {
            "random": None,
            "systematic": None,
            "phase": None,
            "map": None,
            "position": None,
            "measured": measured,
        }
    predicted, position = _median(errors.readout.z), _median(errors.position)
    if scatter is not None and predicted and position is not None:
        phase = 0.0 if errors.phase is None else _median(errors.phase.z) or 0.0
        moving = phase * math.sqrt(errors.phase_scatter)
        explained = math.hypot(predicted, moving)
        measured["ratio"] = scatter / explained
        # The scatter is a median absolute deviation: of a sine it exceeds the root mean square by this factor.
        if camera and scatter > math.hypot(predicted, MAD_TO_SIGMA * moving):
            measured["speckle"] = position * math.sqrt(scatter**2 - explained**2) / predicted
    return {
        "random": {
            "readout": _medians(errors.readout),
            "transport": _medians(errors.transport),
            "total": _medians(errors.random),
        },
        "systematic": None if errors.systematic is None else {"calibration": _medians(errors.systematic)},
        "phase": None if errors.phase is None else _medians(errors.phase),
        "map": {
            "random": _median(map_sigma),
            "systematic": _median(errors.map_systematic),
            "phase": _median(errors.map_phase),
        },
        "position": position,
        "measured": measured,
    }


def budget_line(budget: Mapping[str, Any]) -> str:
    """Return one line about the heights of an error budget; empty if nothing is known about them."""
    scatter, ratio = budget["measured"]["scatter"], budget["measured"]["ratio"]
    parts: Sequence[str] = ()
    if budget["random"] is not None and budget["random"]["total"]["z"] is not None:
        random = {name: each["z"] for name, each in budget["random"].items()}
        parts = (
            f"sigma of z {_micrometres(random['total'])} random (readout {_micrometres(random['readout'])}, transport "
            f"{_micrometres(random['transport'])})",
            "systematic unknown: no covariance"
            if budget["systematic"] is None
            else f"{_micrometres(budget['systematic']['calibration']['z'])} systematic",
        )
        if budget["phase"] is not None:
            parts = (*parts, f"{_micrometres(budget['phase']['z'])} by the phase of the line in its pixel")
    if scatter is not None:
        compared = "" if ratio is None else f" ({ratio:.2f} times the predicted)"
        parts = (*parts, f"z scatters by {_micrometres(scatter)} about a local plane{compared}")
    return "; ".join(parts)


def _micrometres(length: float | None) -> str:
    return "unknown" if length is None else f"{1e6 * length:.3g} um"


def _medians(sigma: PointSigma) -> dict[str, float | None]:
    return {name: _median(each) for name, each in zip("xyz", sigma, strict=True)}


def _median(values: Array | None) -> float | None:
    known = np.empty(0) if values is None else values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
