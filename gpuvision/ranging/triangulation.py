"""Laser triangulation: a light position on the sensor becomes a point in the sheet of light.

Sensor coordinates follow F. de Jong, Figure 3.4: **u is the measured coordinate**, along which the light moves when the
height H changes, and **v runs along the profile**. Both have the same unit, pixels or metres.

- Camera whose laser line runs along the columns axis (``along="columns"``): one row per column; u = row, v = column.
- Camera whose laser line runs along the rows axis (``along="rows"``): one column per row; u = column, v = row.
- PSD: u is the position on a strip and v the place of the strip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.host import Device, Launch, LaunchBuilder, Precision, Tunable, Variant, flags, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.ranging import homography
from gpuvision.ranging.homography import DEFAULT_LIMITS, HomographyLimits, Model
from gpuvision.ranging.homography_fit import fit_models
from gpuvision.ranging.sheet import SheetPoints
from gpuvision.ranging.triangulation_model import Along, in_sensor_order, linear_part
from gpuvision.ranging.triangulation_table import TriangulationTable
from gpuvision.validation import check_keys, finite, numbers

# Lanes of a vector and work-items of a work-group (speed only; the kernel's build options).
_LANES, _GROUP = 16, 64
# Points of a strip in the vector variant. Long strips keep the hardware prefetchers running; several strips per core
# balance the load.
_SHORTEST_STRIP, _LONGEST_STRIP, _STRIPS_PER_CORE = 1024, 65536, 8
_KEYS = ("homography", "region", "model", "along", "lens", "camera", "polynomial", "covariance", "sigma", "horizon")


@dataclass(frozen=True, kw_only=True)
class Triangulation(TriangulationTable, VisionOperation[SheetPoints]):
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
        Kernel variant: vectors of 16 (CPU runtimes) or one work-item per 4 points (GPUs); ``"auto"`` follows the
        device.

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
    # Not the variant: the variants round differently.
    tunable: ClassVar[Tunable | None] = Tunable(
        strips=(512, 1024, 2048, 4096, 8192, 16384, 65536), groups=(32, 64, 128, 256)
    )

    precision: Precision = None
    variant: Variant = "auto"

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="coordinates u and v")
        points = math.prod(shape)
        share = build.share(points, per_core=_STRIPS_PER_CORE, multiple=_LANES)
        each = min(max(share, _SHORTEST_STRIP), _LONGEST_STRIP)
        work = build.work(points, each=each, group=_GROUP, least=_LANES, grouping="strided")
        spread = None if self.sigma is None else shape
        return build.launch(
            "triangulation/triangulation.cl",
            "triangulate",
            work=work,
            more_inputs=[(shape, dtype)],
            outputs=build.outputs({"g": shape, "h": shape, "status": shape, "sigma_g": spread, "sigma_h": spread}),
            defines={
                **self.defines(build.real),
                **type_defines("INPUT", dtype, 2, 4, 16),
                **flags(SHEET_SIGMAS=self.sigma is not None),
            },
            arguments=[
                np.uint64(points),
                np.uint64(work.each),
                self.packed(build.real),
                *map(build.real.type, self.sigma or (0.0, 0.0)),
            ],
            passes_once=work.vectors,
            streams=True,
            by_team=True,
        )

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
        along, lens, camera : {"columns", "rows"}, Lens or None, Camera or None
            As in the class.
        limits : HomographyLimits, optional
            Limits of rank, rounding and, with ``sigma``, of the residuals.

        Raises
        ------
        ValueError
            Shapes differ, a point is not finite or lies beyond the fold of the lens, the points do not determine the
            model, the residuals are far larger than ``sigma``, or both a lens and a camera are given.

        Notes
        -----
        Sheet points that are all mirrored, or all have G and H swapped, fit as well as the right ones: the map to
        mirrored axes is a homography, too. Check the sign of H on a part of known height.
        """
        sensor = np.asarray(sensor_points, dtype=np.float64)
        fits = fit_models(
            sensor,
            sheet_points,
            sigma=sigma,
            models=None if model is None else (model,),
            symmetry=symmetry,
            region=region,
            distortion=in_sensor_order(camera if lens is None else lens, along),
            limits=limits,
        )
        chosen = next(each for each in fits if each.p_value >= significance or each is fits[-1])
        if sigma is not None and chosen.rms > limits.max_rms:
            raise ValueError(
                f"Triangulation.fit: the root mean square residual is {chosen.rms:.3g} times sigma, expected at most "
                f"{limits.max_rms:g}; check the order of the points in both lists, the lens, and sigma"
            )
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
            Sheet in the world: directions of G and H, and the point G = H = 0 [m]. Defaults ``(1.0, 0.0, 0.0)``,
            ``(0.0, 0.0, 1.0)`` and ``(0.0, 0.0, 0.0)``.
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
        return cls(**{"region": (u, v), **more, "homography": linear_part(polynomial), "polynomial": polynomial})

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
