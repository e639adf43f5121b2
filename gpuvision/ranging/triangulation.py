"""Laser triangulation: a light position on the sensor becomes a point in the sheet of light.

Sensor coordinates follow F. de Jong, Figure 3.4: **u is the measured coordinate**, along which the light moves when the
height H changes, and **v runs along the profile**. Both have the same unit, pixels or metres.

- Camera whose laser line runs along the columns axis (``along="columns"``): one row per column; u = row, v = column.
- Camera whose laser line runs along the rows axis (``along="rows"``): one column per row; u = column, v = row.
- PSD: u is the position on a strip and v the place of the strip.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.distortion import Distortion, ExchangedAxes
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.camera.profile_correction import ProfileCorrection, profile_correction
from gpuvision.host import (
    Define,
    Device,
    Launch,
    LaunchBuilder,
    Precision,
    Variant,
    flags,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.ranging import homography
from gpuvision.ranging.homography import DEFAULT_LIMITS, HomographyLimits, Model
from gpuvision.ranging.homography_fit import fit_models
from gpuvision.ranging.sheet import SampleAxes, SheetPoints, SheetTable
from gpuvision.validation import check_keys, finite, numbers

Along = Literal["columns", "rows"]
Matrix = tuple[tuple[float, float, float], ...]
Float64 = npt.NDArray[np.float64]

# Lanes of a vector and work-items of a work-group (speed only; the kernel's build options).
_LANES, _GROUP = 16, 256
# Points of a strip in the vector variant. Long strips keep the hardware prefetchers running; several strips per core
# balance the load.
_SHORTEST_STRIP, _LONGEST_STRIP, _STRIPS_PER_CORE = 1024, 16384, 8
# Largest error of a tabulated correction, relative to a rounding of the corrected coordinate. Chosen.
_SHARE_OF_ROUNDING = 0.25
_KEYS = ("homography", "region", "model", "along", "lens", "camera", "polynomial", "covariance", "sigma", "horizon")


@dataclass(frozen=True, kw_only=True)
class Triangulation(VisionOperation[SheetPoints]):
    """Triangulation of sensor coordinates (u, v) to sheet coordinates (G, H), with correction of the distortion.

    ``(G, H, 1) ~ homography (u, v, 1)``. Sensor and sheet of light are planes, so the plane-to-plane homography holds
    for every pinhole sensor, tilted ones included (Scheimpflug). Before it, a lens or a calibrated camera is undone.

    Called as ``triangulation(u, v)`` with float32 or float64 arrays of one shape; returns `SheetPoints`.

    Parameters
    ----------
    homography : (3, 3) array_like
        From *undistorted* sensor coordinates to the sheet [m]; its scale is free.
    region : ((u_min, u_max), (v_min, v_max))
        Region of the sensor [sensor unit]. It conditions the arithmetic. Its middle must see the sheet: this defines
        the side of the horizon that is in front of the sensor.
    model : {"C3", "C4", "D6", "H8"}
        Model that the homography was fitted as, default ``"H8"``; see `fit`.
    along : {"columns", "rows"}
        Sensor axis of v, default ``"columns"``. A lens or a camera needs it, since their points are (column, row).
    lens : Lens, optional
        Radial lens distortion, corrected before the homography.
    camera : Camera, optional
        Calibrated camera, instead of a lens: its lens terms and the tilt of its sensor are corrected before the
        homography, which then starts from ideal pixels (of the same camera matrix). u and v are pixels.
    polynomial : PlanePolynomial, optional
        Polynomials from (c, r) = (v, u) to (G, H), instead of lens and camera; ``homography`` is their linear part. Use
        `from_polynomial`.
    covariance : (8, 8) array_like, optional
        Covariance of (g0, gx, gy, h0, hx, hy, dx, dy), the parameters of the displacement form over ``region`` (see
        `conditioned`). It is added to the sigmas.
    sigma : (sigma_u, sigma_v), optional
        Standard deviations of the sensor coordinates [sensor unit]; requests the outputs sigma_g and sigma_h.
    horizon : float
        Smallest denominator of the homography, relative to the denominator in the middle of the region, 0 to 1, default
        1e-3. A point further away than about 1/horizon times the usual distance has the flag HORIZON.
    precision : {"single", "double", None}
        Precision of the arithmetic and of the outputs; ``None`` follows the input.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: vectors of 16 (CPU runtimes) or one work-item per point (GPUs); ``"auto"`` follows the device.

    Raises
    ------
    ValueError
        The homography is singular (the sensor sees the sheet edge-on), the middle of the region lies on the horizon,
        several of lens, camera and polynomial are given, or a parameter is out of range.

    Notes
    -----
    Error: a few roundings of the size of the measuring range, since the arithmetic uses displacements from the middle
    of the region. A camera adds 1e-6 of its correction (4e-15 in double precision), see
    `gpuvision.camera.undistort_points.UndistortPoints`.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 2.3.3, 3.3.2
    and 3.3.3 (lens).
    """

    Result: ClassVar[type[Any]] = SheetPoints

    homography: Matrix
    region: tuple[tuple[float, float], tuple[float, float]]
    model: Model = "H8"
    along: Along = "columns"
    lens: Lens | None = None
    camera: Camera | None = None
    polynomial: PlanePolynomial | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    sigma: tuple[float, float] | None = None
    horizon: float = 1e-3
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(self, "homography", numbers(self.homography, (3, 3), "Triangulation.homography"))
        object.__setattr__(self, "region", numbers(self.region, (2, 2), "Triangulation.region"))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", numbers(self.covariance, (8, 8), "Triangulation.covariance"))
        if self.sigma is not None:
            object.__setattr__(self, "sigma", numbers(self.sigma, (2,), "Triangulation.sigma"))
        self._check()

    def _check(self) -> None:
        (u_min, u_max), (v_min, v_max) = self.region
        if not (u_min < u_max and v_min <= v_max):
            raise ValueError(f"Triangulation.region is {self.region}, expected ((u_min, u_max), (v_min, v_max))")
        if self.model not in homography.MODELS:
            raise ValueError(f"Triangulation.model is {self.model!r}, expected one of {', '.join(homography.MODELS)}")
        if self.along not in ("columns", "rows"):
            raise ValueError(f"Triangulation.along is {self.along!r}, expected 'columns' or 'rows'")
        if self.lens is not None and self.camera is not None:
            raise ValueError("Triangulation has a lens and a camera; the camera includes a lens, give one of them")
        if self.polynomial is not None:
            if self.lens is not None or self.camera is not None:
                raise ValueError("Triangulation has a polynomial and a lens or camera; the polynomial includes them")
            if self.homography != _linear_part(self.polynomial):
                raise ValueError("Triangulation.homography is no linear part of the polynomial; use from_polynomial")
            if self.covariance is not None:
                raise ValueError("Triangulation.covariance is that of a homography; a polynomial has one itself")
        if not 0.0 < self.horizon < 1.0:
            raise ValueError(f"Triangulation.horizon is {self.horizon}, expected a number between 0 and 1")
        if self.sigma is not None and min(self.sigma) < 0.0:
            raise ValueError(f"Triangulation.sigma is {self.sigma}, expected (sigma_u, sigma_v), neither negative")
        self.conditioned()

    # ---- parameters of the kernels -------------------------------------------------------------------------

    def profile_correction(
        self, real: npt.DTypeLike, axes: SampleAxes, length: int, samples: int
    ) -> ProfileCorrection | None:
        """Return the camera's correction as a table for a readout of ``samples`` profiles of ``length`` positions.

        None without a distorting camera, in double precision, and where polynomials do not reach a quarter of a
        rounding: the kernel then computes the correction.
        """
        if self.camera is None or not self.camera.distorts or np.dtype(real) != np.float32:
            return None
        assert self.distortion is not None
        _, _, first, pitch, unit = self._kernel_axes(np.dtype(real), axes)
        tolerance = _SHARE_OF_ROUNDING * float(np.finfo(np.float32).eps)
        return profile_correction(
            self.distortion, first=first, pitch=pitch, length=length, samples=samples, unit=unit, tolerance=tolerance
        )

    def defines(self, real: npt.DTypeLike, profiles: ProfileCorrection | None = None) -> dict[str, Define]:
        """Return the build options of ``kernels/common/sheet.h`` for a kernel with the real type ``real``.

        ``profiles`` is the result of `profile_correction`.
        """
        options: dict[str, Define] = {} if self.covariance is None else {"SHEET_COVARIANCE": None}
        if self.lens is not None:
            options |= self.lens.defines
        if self.camera is not None and self.camera.distorts:
            _, half = self._centre_and_half_extent()
            options |= (
                self.camera.correction_defines(real, float(half[0]), self._image_region)
                if profiles is None
                else {**self.camera.defines(), "CAMERA_PROFILES": profiles.terms.shape[1]}
            )
            options |= flags(SHEET_ROWS=self.along == "rows")
        return options if self.polynomial is None else {**options, **self.polynomial.defines}

    def packed(
        self, real: npt.DTypeLike, axes: SampleAxes | None = None, profiles: ProfileCorrection | None = None
    ) -> npt.NDArray[Any]:
        """Return the parameter table of the device functions of ``kernels/common/sheet.h`` (`SheetTable`).

        Parameters
        ----------
        real : dtype
            float32 or float64, the real type of the kernel. Origins and scales are rounded to it *before* the other
            numbers are computed from them, so that their rounding costs no accuracy.
        axes : SampleAxes, optional
            Map from the positions and sample indices of the kernel to sensor coordinates; it is folded into the table.
        profiles : ProfileCorrection, optional
            Result of `profile_correction`.
        """
        real, axes = np.dtype(real), SampleAxes() if axes is None else axes
        _, half = self._centre_and_half_extent()
        origin, scale, first, pitch, unit = self._kernel_axes(real, axes)
        start = first + pitch * origin
        terms = self._displacement(start, unit)
        lens, camera = np.zeros(Lens.TABLE_SIZE), np.zeros(0)
        if self.sensor_lens is not None:
            # The two scales differ by a rounding only, which moves a distorted point by less than a rounding.
            lens = self.sensor_lens.packed(start.tolist(), 1.0 / half[0])
        if self.camera is not None and self.camera.distorts:
            to_image = [1, 0] if self.along == "columns" else [0, 1]
            camera = self.camera.packed_correction(
                real,
                first[to_image],
                pitch[to_image],
                unit[to_image],
                self._image_region,
                None if profiles is None else (profiles.middle, profiles.scale),
            )
        plane: dict[str, Float64] = {}
        if self.polynomial is not None:
            plane_middle, plane_half, displacement = self.polynomial.displacement
            plane = {
                "plane_origin": (plane_middle - first[::-1]) / pitch[::-1],
                "plane_scale": pitch[::-1] / plane_half,
                "plane_unit": plane_half / unit[::-1],
                "plane_terms": displacement.ravel(),
            }
        g0, gx, gy, h0, hx, hy, dx, dy = terms
        factor_g, factor_h = self._factors()
        table = SheetTable(
            position_origin=origin[0],
            position_scale=scale[0],
            sample_origin=origin[1],
            sample_scale=scale[1],
            horizon=self.horizon,
            w_terms=(dx, dy),
            g_terms=(g0, gx, gy),
            h_terms=(h0, hx, hy),
            lens=lens,
            factor_g=factor_g,
            factor_h=factor_h,
            camera=camera,
            **plane,
        )
        with np.errstate(over="ignore"):
            return np.hstack(table).astype(real)

    def _kernel_axes(self, real: np.dtype[Any], axes: SampleAxes) -> tuple[Float64, Float64, Float64, Float64, Float64]:
        """Return origin and scale of the kernel's positions and samples, first, pitch, and the units of x and y."""
        middle, half = self._centre_and_half_extent()
        pitch = np.array([axes.position_pitch, axes.sample_pitch])
        first = np.array([axes.position_origin, axes.sample_origin])
        origin = ((middle - first) / pitch).astype(real).astype(np.float64)
        scale = (pitch / half).astype(real).astype(np.float64)
        return origin, scale, first, pitch, pitch / scale

    def conditioned(self) -> Float64:
        """(g0, gx, gy, h0, hx, hy, dx, dy) of the displacement form over ``region``.

        ``G = g0 + (gx x + gy y) / (1 + dx x + dy y)``, and the same form for H. x and y are the undistorted u and v,
        shifted and scaled to about -1 to 1: ``x = (u - u_middle) / half``, where ``half`` is half of the larger extent
        of the region.
        """
        return self._displacement(*self._centre_and_half_extent())

    @property
    def _image_region(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Region of the sensor as ranges of columns and rows."""
        u, v = self.region
        return (v, u) if self.along == "columns" else (u, v)

    def _centre_and_half_extent(self) -> tuple[Float64, Float64]:
        return homography.centre_and_half_extent(self.region)

    def _displacement(self, origin: Float64, unit: Float64) -> Float64:
        """Return the eight parameters for u = origin + unit x."""
        matrix = np.array(self.homography) @ homography.shift_and_scale(origin, unit)
        return homography.to_displacement(matrix, rank=2 if self.model == "C3" else 3)

    def _factors(self) -> tuple[Float64, Float64]:
        """Return triangular factors of the covariance of the parameters of G, and of the parameters of H."""
        if self.covariance is None:
            return np.zeros(15), np.zeros(15)
        covariance = np.array(self.covariance)
        # Displacement parameters on which G and H depend.
        of_g, of_h = (0, 1, 2, 6, 7), (3, 4, 5, 6, 7)
        factor_g, factor_h = (homography.packed_covariance_factor(covariance, which) for which in (of_g, of_h))
        return factor_g, factor_h

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="coordinates u and v")
        points = math.prod(shape)
        share = build.share(points, per_core=_STRIPS_PER_CORE, multiple=_LANES)
        each = min(max(share, _SHORTEST_STRIP), _LONGEST_STRIP)
        work = build.work(points, each=each, group=_GROUP, least=_LANES, grouping="fitted")
        spread = None if self.sigma is None else shape
        return build.launch(
            "triangulation/triangulation.cl",
            "triangulate",
            work=work,
            more_inputs=[(shape, dtype)],
            outputs=build.outputs({"g": shape, "h": shape, "status": shape, "sigma_g": spread, "sigma_h": spread}),
            defines={
                **self.defines(build.real),
                **type_defines("INPUT", dtype, 16),
                **flags(SHEET_SIGMAS=self.sigma is not None),
            },
            arguments=[
                np.uint64(points),
                np.uint64(work.each),
                self.packed(build.real),
                *map(build.real.type, self.sigma or (0.0, 0.0)),
            ],
            passes_once=work.vectors,
        )

    # ---- host computations for simulators, planners and error budgets --------------------------------------

    def to_sensor(self, points: npt.ArrayLike) -> Float64:
        """Compute the measured sensor coordinates (u, v) of sheet points (G, H), both of shape (..., 2): the inverse.

        NaN for points behind the horizon of the sensor and for points that the lens does not image.
        """
        points = np.asarray(points, dtype=np.float64)
        origin, unit = self._centre_and_half_extent()
        g0, gx, gy, h0, hx, hy, dx, dy = self.conditioned()
        matrix = np.array([[gx + g0 * dx, gy + g0 * dy, g0], [hx + h0 * dx, hy + h0 * dy, h0], [dx, dy, 1.0]])
        if self.model == "C3":
            # A single beam has no v: return the middle of the region.
            matrix[0], points = (0.0, 1.0, 0.0), points * (0.0, 1.0)
        inverse = np.linalg.inv(matrix)
        lifted = points @ inverse[:, :2].T + inverse[:, 2]
        middle = inverse @ matrix[:, 2]
        lifted[lifted[..., 2] * middle[2] <= 0.0] = np.nan
        straight: Float64 = origin + unit * lifted[..., :2] / lifted[..., 2:]
        return straight if self.distortion is None else self.distortion.distort(straight)

    def covariance_at(self, points: npt.ArrayLike) -> Float64:
        """Compute the covariance (..., 2, 2) of (G, H) at measured points (u, v) (..., 2); NaN beyond the horizon.

        ``J diag(sigma_u^2, sigma_v^2) J'`` with the Jacobian J of distortion and homography, plus the contribution of
        the covariance of the parameters.

        Raises
        ------
        ValueError
            Neither ``sigma`` nor ``covariance`` is known.
        """
        if self.sigma is None and self.covariance is None:
            raise ValueError("Triangulation knows neither sigma nor covariance; give it one of them")
        points = np.asarray(points, dtype=np.float64)
        p, values, w = self._at(points)
        unit = self._centre_and_half_extent()[1]
        _, gx, gy, _, hx, hy, dx, dy = self.conditioned()
        slopes = np.array([[gx, gy], [hx, hy]]) - values[..., None] * np.array([dx, dy])
        distortion_slopes = np.eye(2) if self.distortion is None else self.distortion.jacobian(points)
        slopes = (slopes / w[..., None, None]) @ distortion_slopes / unit
        scaled = slopes * np.array(self.sigma or (0.0, 0.0))
        total: Float64 = scaled @ np.swapaxes(scaled, -1, -2)
        if self.covariance is not None:
            design = homography.displacement_design(p, values)
            total += design @ np.array(self.covariance) @ np.swapaxes(design, -1, -2)
        return total

    def parameter_derivatives(self, points: npt.ArrayLike) -> Float64:
        """Return the derivatives (..., 2, 8) of (G, H) at measured points (u, v) (..., 2) by the parameters.

        `conditioned` returns the parameters, and ``covariance`` is their covariance. NaN beyond the horizon.
        """
        return homography.displacement_design(*self._at(np.asarray(points, dtype=np.float64))[:2])

    def _at(self, points: Float64) -> tuple[Float64, Float64, Float64]:
        """Return ``(x, y) / w``, the displacements (G - g0, H - h0) and the denominator w at measured points (u, v)."""
        origin, unit = self._centre_and_half_extent()
        x = ((points if self.distortion is None else self.distortion.undistort(points)) - origin) / unit
        _, gx, gy, _, hx, hy, dx, dy = self.conditioned()
        w = 1.0 + x @ np.array([dx, dy])
        w = np.where(w > self.horizon, w, np.nan)
        p = x / w[..., None]
        return p, p @ np.array([[gx, hx], [gy, hy]]), w

    def check_systematic(self, outputs: Iterable[str], operation: str) -> None:
        """Check that an operation that computes systematic errors has the covariance for them.

        Raises
        ------
        ValueError
            ``outputs`` has a systematic error, and the triangulation has no covariance.
        """
        for name in outputs:
            if name.startswith("systematic") and self.covariance is None:
                raise ValueError(
                    f"{operation}.outputs has {name!r}, but its triangulation has no covariance; "
                    "give Triangulation.covariance"
                )

    @property
    def sensor_lens(self) -> Lens | None:
        """Lens for points in (u, v) order; None without a lens."""
        return self.lens.swapped() if self.lens is not None and self.along == "columns" else self.lens

    @property
    def distortion(self) -> Distortion | None:
        """Lens, camera or higher terms of the polynomial for points in (u, v) order; None without them."""
        if self.polynomial is not None:
            return ExchangedAxes(self.polynomial)
        return _in_sensor_order(self.camera if self.lens is None else self.lens, self.along)

    # ---- construction --------------------------------------------------------------------------------------

    @classmethod
    def fit(
        cls,
        sensor_points: npt.ArrayLike,
        sheet_points: npt.ArrayLike,
        *,
        sigma: npt.ArrayLike | None = None,
        model: Model | None = None,
        significance: float = 0.01,
        symmetry: float = 0.0,
        region: tuple[tuple[float, float], tuple[float, float]] | None = None,
        along: Along = "columns",
        lens: Lens | None = None,
        camera: Camera | None = None,
        limits: HomographyLimits = DEFAULT_LIMITS,
    ) -> Triangulation:
        """Calibrate: fit calibration points, and select the smallest sufficient model of the family.

        Levenberg-Marquardt minimises the *sensor* residuals, where the noise is; the sheet points are taken as exact. A
        normalised direct linear transform gives the start values. `gpuvision.ranging.homography` describes the models.

        Parameters
        ----------
        sensor_points, sheet_points : (n, 2) array_like
            Measured (u, v) [sensor unit] and known (G, H) [m].
        sigma : float, (2,) or (n, 2) array_like, optional
            Standard deviation of the sensor coordinates [sensor unit]: one number, (sigma_u, sigma_v), or one number
            per point and coordinate. ``None``: the same for all, estimated from the residuals.
        model : {"C3", "C4", "D6", "H8"}, optional
            Model to fit. ``None`` selects the smallest model that the F test against the largest model does not reject.
        significance : float
            Probability (p-value of the F test) below which a model is rejected, default 0.01.
        symmetry : float
            v of the plane of symmetry for C4 [sensor unit], default 0.
        region : ((u_min, u_max), (v_min, v_max)), optional
            Region of the sensor; ``None``: the bounding box of the points.
        along, lens, camera
            As in the class.
        limits : HomographyLimits, optional
            Limits of rank and rounding.

        Raises
        ------
        ValueError
            Shapes differ, a point is not finite or lies beyond the fold of the lens, the points do not determine the
            model, or both a lens and a camera are given.
        """
        sensor = np.asarray(sensor_points, dtype=np.float64)
        fits = fit_models(
            sensor,
            sheet_points,
            sigma=sigma,
            models=None if model is None else (model,),
            symmetry=symmetry,
            region=region,
            distortion=_in_sensor_order(camera if lens is None else lens, along),
            limits=limits,
        )
        chosen = next(each for each in fits if each.p_value >= significance or each is fits[-1])
        known = np.ravel([] if sigma is None else sigma)
        return cls(
            homography=numbers(chosen.homography, (3, 3), "Triangulation.homography"),
            covariance=None
            if chosen.covariance is None
            else numbers(chosen.covariance, (8, 8), "Triangulation.covariance"),
            region=homography.bounding_box(sensor) if region is None else region,
            model=chosen.model,
            along=along,
            lens=lens,
            camera=camera,
            sigma=(float(known[0]), float(known[-1])) if known.size in (1, 2) else None,
        )

    @classmethod
    def from_camera(
        cls,
        camera: Camera | npt.ArrayLike,
        rotation: npt.ArrayLike | None = None,
        translation: npt.ArrayLike = (0.0, 0.0, 0.0),
        *,
        g_axis: npt.ArrayLike = (1.0, 0.0, 0.0),
        h_axis: npt.ArrayLike = (0.0, 0.0, 1.0),
        origin: npt.ArrayLike = (0.0, 0.0, 0.0),
        along: Along = "columns",
        **more: Any,
    ) -> Triangulation:
        """Build a triangulation from a camera, its pose, and the pose of the sheet of light.

        Parameters
        ----------
        camera : Camera or (3, 3) array_like
            Calibrated camera, with its distortion and the tilt of its sensor; or the matrix of a camera without
            distortion, ``(column, row, 1) ~ camera (X, Y, Z)``, any invertible matrix.
        rotation, translation : (3, 3) and (3,) array_like
            World to camera; the translation in metres. Default: the world is the camera frame.
        g_axis, h_axis, origin : (3,) array_like
            Sheet in the world: directions of G and H, and the point G = H = 0 [m].
        along, **more
            Other parameters of the class; ``region`` is required.

        Examples
        --------
        A sheet of light in the frame of a tilted camera (x right, y down, z forward):

        >>> camera = Camera(
        ...     matrix=((1700, 0, 640), (0, 1700, 400), (0, 0, 1)), distortion=(-0.1, *(0.0,) * 11, 0.25, 0.0)
        ... )
        >>> sheet = Triangulation.from_camera(
        ...     camera,
        ...     origin=(0, 0, 0.3),
        ...     g_axis=(1, 0, 0),
        ...     h_axis=(0, -0.6, -0.8),
        ...     region=((0, 799), (0, 1279)),
        ... )
        """
        calibrated, matrix = (camera, camera.matrix) if isinstance(camera, Camera) else (None, camera)
        rotation = np.eye(3) if rotation is None else rotation
        to_sensor = homography.camera_homography(matrix, rotation, translation, (g_axis, h_axis, origin))
        if along == "columns":
            to_sensor = to_sensor[[1, 0, 2]]
        inverse = numbers(homography.inverse(to_sensor), (3, 3), "Triangulation.homography")
        return cls(homography=inverse, along=along, camera=calibrated, **more)

    @classmethod
    def from_polynomial(cls, polynomial: PlanePolynomial, **more: Any) -> Triangulation:
        """Build a triangulation from polynomials between the sensor and the plane of the sheet.

        Parameters
        ----------
        polynomial : PlanePolynomial
            From (c, r) = (v, u) to (G, H). Positions outside of its region have the flag OUT_OF_RANGE. Its covariance
            is not in the sigmas of the triangulation, see `PlanePolynomial.covariance_at`.
        **more
            Other parameters of the class. Default of ``region``: the region of the polynomial.
        """
        (v, u) = polynomial.region
        return cls(**{"region": (u, v), **more, "homography": _linear_part(polynomial), "polynomial": polynomial})

    @classmethod
    def from_stand_off(
        cls,
        *,
        baseline: float,
        stand_off: float,
        focal_distance: float,
        tilt: float | None = None,
        **more: Any,
    ) -> Triangulation:
        """Build a triangulation from baseline and stand-off: a sheet of light straight down, a lens beside the sheet.

        The optical axis meets the sheet at G = H = 0, where u = v = 0; u grows with H. With t the angle between the
        axis and the sheet, ``tan t = baseline / stand_off``, and D the distance along the axis: ``u = f' H sin t / (D
        cos a - H cos(t - a))``, ``v = f' G cos a / (D cos a - H cos(t - a))``.

        Parameters
        ----------
        baseline : float
            Distance from the sheet to the lens, b [m], positive.
        stand_off : float
            Distance from H = 0 up to the lens, Z0 [m], positive.
        focal_distance : float
            Distance from the lens to the sensor along the axis, f' [m], positive. If it is in pixels, u and v are
            pixels.
        tilt : float, optional
            Angle a of the sensor [rad], between -pi/2 and pi/2. ``None``: the Scheimpflug angle,
            ``tan a = f' / (D tan t)``, with the whole sheet in focus; ``focal_distance`` must then be in metres.
        **more
            Other parameters of the class; ``region`` is required.

        Raises
        ------
        ValueError
            A length is not positive, or the tilt is not between -pi/2 and pi/2.

        References
        ----------
        F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.2 and
        Figure 3.4.
        """
        to_sensor = homography.triangulation_homography(baseline, stand_off, focal_distance, tilt)
        matrix = numbers(homography.inverse(to_sensor), (3, 3), "Triangulation.homography")
        return cls(homography=matrix, model="C4", **more)

    # ---- constants and tables ------------------------------------------------------------------------------

    @classmethod
    def from_constants(cls, constants: Sequence[float], **more: Any) -> Triangulation:
        """Build a triangulation from constants; their number selects the model.

        3: ``H = (c1 u + c2)/(c3 u + 1)``, G = 0. 4: ``H = (C1 u + C2)/(u + C3)``, ``G = C4 v/(u + C3)``.
        6: ``H = (D1 u + D2)/(u + D3)``, ``G = (D4 v + D5 u + D6)/(u + D3)``. 8: the homography's rows, its
        last element 1.

        Raises
        ------
        ValueError
            If there are not 3, 4, 6 or 8.
        """
        rows, model = homography.homography_from_constants(tuple(finite(each, "constants") for each in constants))
        return cls(homography=rows, model=model, **more)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, as in a TOML file; parameters that are None are omitted."""
        table: dict[str, Any] = {"homography": [list(row) for row in self.homography]}
        table["region"] = [list(bounds) for bounds in self.region]
        table |= {"model": self.model, "along": self.along, "horizon": self.horizon}
        if self.covariance is not None:
            table["covariance"] = [list(row) for row in self.covariance]
        if self.sigma is not None:
            table["sigma"] = list(self.sigma)
        if self.lens is not None:
            table["lens"] = self.lens.to_dict()
        if self.camera is not None:
            table["camera"] = self.camera.to_dict()
        if self.polynomial is not None:
            table["polynomial"] = self.polynomial.to_dict()
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], *, precision: Precision = None) -> Triangulation:
        """Build a triangulation from a table as `to_dict` makes it; ``homography`` and ``region`` are required.

        Raises
        ------
        ValueError, TypeError
            A key is unknown or missing, or a value has the wrong type or shape.
        """
        values = dict(check_keys(table, _KEYS, ("homography", "region"), "triangulation"))
        if "lens" in values:
            values["lens"] = Lens.from_dict(values["lens"])
        if "camera" in values:
            values["camera"] = Camera.from_dict(values["camera"])
        if "polynomial" in values:
            values["polynomial"] = PlanePolynomial.from_dict(values["polynomial"])
        return cls(**values, precision=precision)


def _linear_part(polynomial: PlanePolynomial) -> Matrix:
    """Return the homography of the polynomial without its higher terms, for points in (u, v) order."""
    rows: Matrix = numbers([*polynomial.affine[:, [1, 0, 2]], (0.0, 0.0, 1.0)], (3, 3), "Triangulation.homography")
    return rows


def _in_sensor_order(model: Lens | Camera | None, along: Along) -> Distortion | None:
    """Return a distortion model for points in (u, v) order."""
    if along == "rows" or model is None:
        return model
    return model.swapped() if isinstance(model, Lens) else ExchangedAxes(model)
