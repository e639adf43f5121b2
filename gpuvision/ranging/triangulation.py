"""Triangulation: a light position on the sensor becomes a point in the sheet of light.

Sensor coordinates follow the thesis' Figure 3.4: **u is the measured coordinate**, along which the light
moves when the height H changes, and **v runs along the profile**. Both are in one unit, pixels or metres. A
camera whose profile runs along its columns axis measures a row for every column (``along="columns"``: u =
row, v = column); one whose profile runs along the rows measures a column for every row (``along="rows"``: u
= column, v = row). On a PSD u is the position on a strip and v the place of the strip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.host import Device, Launch, LaunchBuilder, Precision, Variant, flags, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.ranging import homography
from gpuvision.ranging.homography import Model
from gpuvision.validation import check_keys, finite, numbers

Along = Literal["columns", "rows"]
Matrix = tuple[tuple[float, float, float], ...]
Float64 = npt.NDArray[np.float64]

_LANES, _GROUP = 16, 256
# Points of a strip: long ones keep the prefetchers running, several per core keep the cores even.
_SHORTEST_STRIP, _LONGEST_STRIP, _STRIPS_PER_CORE = 1024, 16384, 8
_KEYS = ("homography", "region", "model", "along", "lens", "covariance", "sigma", "horizon")


class SheetPoints(NamedTuple):
    """Points in the sheet of light, each array of the input's shape.

    Attributes
    ----------
    g, h
        Along the sheet and up in it [m]; NaN where the status is not OK.
    status
        uint8 `Status` flags: NOT_FINITE (u or v is not, or lies a million half regions away), NOT_INVERTIBLE (beyond
        the fold of the lens polynomial), HORIZON (the ray does not meet the sheet, or too far away to mean anything).
    sigma_g, sigma_h
        Their standard deviations [m]; None unless the triangulation knows the sensor's ``sigma``.
    """

    g: Any
    h: Any
    status: Any
    sigma_g: Any = None
    sigma_h: Any = None


@dataclass(frozen=True, kw_only=True)
class SampleAxes:
    """Where a readout's samples lie on the sensor: u = position_origin + position_pitch position, v likewise.

    The default says that a readout's position and sample index are the sensor's coordinates themselves. A
    region of interest that begins at column 100 has ``sample_origin=100``; a PSD of 64 strips 0.1 mm apart,
    in metres about the middle, has ``sample_pitch=1e-4, sample_origin=-31.5e-4``.
    """

    sample_origin: float = 0.0
    sample_pitch: float = 1.0
    position_origin: float = 0.0
    position_pitch: float = 1.0

    def __post_init__(self) -> None:
        for name in ("sample_origin", "sample_pitch", "position_origin", "position_pitch"):
            finite(getattr(self, name), f"SampleAxes.{name}")
        if self.sample_pitch == 0.0 or self.position_pitch == 0.0:
            raise ValueError("SampleAxes: a pitch is 0, expected the distance between samples in sensor units")


@dataclass(frozen=True, kw_only=True)
class Triangulation(VisionOperation[SheetPoints]):
    """Sensor coordinates (u, v) to sheet coordinates (G, H), with the lens undone in the same pass.

    ``(G, H, 1) ~ homography (u, v, 1)``, a plane-plane homography: it holds for any pinhole sensor however
    it is tilted (a Scheimpflug sensor is one), since both the sensor and the sheet are planes.

    Parameters
    ----------
    homography
        3 x 3, from *undistorted* sensor coordinates to metres in the sheet; its scale does not matter.
    region
        ((u_min, u_max), (v_min, v_max)) of the sensor, in sensor coordinates. It conditions the arithmetic
        and says which side of the horizon is in front of the sensor: the middle of the region must see the
        sheet.
    model
        What the homography was fitted as; see `fit`.
    along
        Which sensor axis v is; only a lens, whose centre is (column, row), needs to know.
    lens
        Radial lens, undone in the coordinates; without one no lens code is compiled.
    covariance
        8 x 8 covariance of (g0, gx, gy, h0, hx, hy, dx, dy), the parameters of the displacement form over
        ``region`` (see `conditioned`); it adds to the sigmas.
    sigma
        (sigma_u, sigma_v) of the sensor coordinates; asks for the outputs sigma_g and sigma_h.
    horizon
        Smallest denominator, relative to the one in the middle of the region: a point further away than about
        1/horizon times the usual distance is flagged HORIZON.
    precision
        Of the arithmetic and the outputs; None follows the input.
    variant
        "vector" (16-wide vectors, for CPU runtimes), "work_item" (a work-item per point, for GPUs), or "auto".

    Raises
    ------
    ValueError
        If the homography is singular (the sheet is seen edge-on), if the middle of the region lies on the
        horizon, or if a parameter is out of range.
    """

    Result: ClassVar[type[Any]] = SheetPoints

    homography: Matrix
    region: tuple[tuple[float, float], tuple[float, float]]
    model: Model = "H8"
    along: Along = "columns"
    lens: Lens | None = None
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
        if not 0.0 < self.horizon < 1.0:
            raise ValueError(f"Triangulation.horizon is {self.horizon}, expected a number between 0 and 1")
        if self.sigma is not None and min(self.sigma) < 0.0:
            raise ValueError(f"Triangulation.sigma is {self.sigma}, expected (sigma_u, sigma_v), neither negative")
        self.conditioned()

    # ---- what the kernels take -----------------------------------------------------------------------------

    @property
    def defines(self) -> dict[str, None]:
        """What ``kernels/common/sheet.h`` has to compile for this triangulation."""
        lens = {} if self.lens is None else self.lens.defines
        return lens if self.covariance is None else {**lens, "SHEET_COVARIANCE": None}

    def packed(self, real: npt.DTypeLike, axes: SampleAxes | None = None) -> npt.NDArray[Any]:
        """Return the parameter table of ``kernels/common/sheet.h``: what its device functions take as ``sheet``.

        Parameters
        ----------
        real
            float32 or float64, the kernel's real type. Origins and scales are rounded to it *before* the
            rest is computed from them, so that their rounding costs no accuracy.
        axes
            Where the kernel's positions and sample indices lie on the sensor; folded in at no cost.
        """
        real, axes = np.dtype(real), SampleAxes() if axes is None else axes
        middle, half = self._middle_and_half()
        pitch = np.array([axes.position_pitch, axes.sample_pitch])
        first = np.array([axes.position_origin, axes.sample_origin])
        origin = ((middle - first) / pitch).astype(real).astype(np.float64)
        scale = (pitch / half).astype(real).astype(np.float64)
        start = first + pitch * origin
        terms = self._displacement(start, pitch / scale)
        lens = np.zeros(5)
        if self.sensor_lens is not None:
            # The two scales differ by a rounding only, which moves a distorted point by less than a rounding.
            lens = self.sensor_lens.packed(start, 1.0 / half[0])
        g0, gx, gy, h0, hx, hy, dx, dy = terms
        head = [origin[0], scale[0], origin[1], scale[1], self.horizon, dx, dy, g0, gx, gy, h0, hx, hy]
        with np.errstate(over="ignore"):
            return np.concatenate([head, lens, *self._factors()]).astype(real)

    def conditioned(self) -> Float64:
        """(g0, gx, gy, h0, hx, hy, dx, dy) of the displacement form over ``region``.

        ``G = g0 + (gx x + gy y) / (1 + dx x + dy y)``, H likewise, with x and y the undistorted u and v
        shifted and scaled to about -1 to 1: x = (u - u_middle) / half the region's extent (the larger one,
        for both).
        """
        return self._displacement(*self._middle_and_half())

    def _middle_and_half(self) -> tuple[Float64, Float64]:
        return homography.middle_and_half(self.region)

    def _displacement(self, origin: Float64, unit: Float64) -> Float64:
        """Return the eight parameters for u = origin + unit x."""
        matrix = np.array(self.homography) @ homography.shift_and_scale(origin, unit)
        return homography.to_displacement(matrix, rank=2 if self.model == "C3" else 3)

    def _factors(self) -> tuple[Float64, Float64]:
        """Return triangular factors of the parameters' covariance as G and as H see it."""
        if self.covariance is None:
            return np.zeros(15), np.zeros(15)
        covariance = np.array(self.covariance)
        seen_by_g, seen_by_h = (0, 1, 2, 6, 7), (3, 4, 5, 6, 7)
        return homography.packed_factor(covariance, seen_by_g), homography.packed_factor(covariance, seen_by_h)

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
                **self.defines,
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

    # ---- on the host: simulators, planners, error budgets --------------------------------------------------

    def to_sensor(self, points: npt.ArrayLike) -> Float64:
        """Measured sensor coordinates (u, v) of sheet points, shape (..., 2): the inverse.

        NaN for points behind the sensor's horizon, and for those that the lens cannot show.
        """
        points = np.asarray(points, dtype=np.float64)
        origin, unit = self._middle_and_half()
        g0, gx, gy, h0, hx, hy, dx, dy = self.conditioned()
        matrix = np.array([[gx + g0 * dx, gy + g0 * dy, g0], [hx + h0 * dx, hy + h0 * dy, h0], [dx, dy, 1.0]])
        if self.model == "C3":
            # A beam has no v: report the region's middle.
            matrix[0], points = (0.0, 1.0, 0.0), points * (0.0, 1.0)
        inverse = np.linalg.inv(matrix)
        lifted = points @ inverse[:, :2].T + inverse[:, 2]
        middle = inverse @ matrix[:, 2]
        lifted[lifted[..., 2] * middle[2] <= 0.0] = np.nan
        straight: Float64 = origin + unit * lifted[..., :2] / lifted[..., 2:]
        return straight if self.sensor_lens is None else self.sensor_lens.distort(straight)

    def covariance_at(self, points: npt.ArrayLike) -> Float64:
        """Covariance of (G, H) at measured points (u, v): (..., 2) to (..., 2, 2); NaN beyond the horizon.

        ``J diag(sigma_u^2, sigma_v^2) J'``, with J over lens and homography, and the parameters' own part.

        Raises
        ------
        ValueError
            If neither ``sigma`` nor ``covariance`` is known.
        """
        if self.sigma is None and self.covariance is None:
            raise ValueError("Triangulation knows neither sigma nor covariance; give it one of them")
        points = np.asarray(points, dtype=np.float64)
        origin, unit = self._middle_and_half()
        x = ((points if self.sensor_lens is None else self.sensor_lens.undistort(points)) - origin) / unit
        _, gx, gy, _, hx, hy, dx, dy = self.conditioned()
        w = 1.0 + x @ np.array([dx, dy])
        w = np.where(w > self.horizon, w, np.nan)
        p = x / w[..., None]
        values = p @ np.array([[gx, hx], [gy, hy]])
        slopes = np.array([[gx, gy], [hx, hy]]) - values[..., None] * np.array([dx, dy])
        bend = np.eye(2) if self.sensor_lens is None else self.sensor_lens.jacobian(points)
        slopes = (slopes / w[..., None, None]) @ bend / unit
        spread = slopes * np.array(self.sigma or (0.0, 0.0))
        total: Float64 = spread @ np.swapaxes(spread, -1, -2)
        if self.covariance is None:
            return total
        design = np.zeros((*points.shape[:-1], 2, 8))
        for row in (0, 1):
            design[..., row, 3 * row] = 1.0
            design[..., row, 3 * row + 1 : 3 * row + 3] = p
        design[..., 6:] = -values[..., None] * p[..., None, :]
        total += design @ np.array(self.covariance) @ np.swapaxes(design, -1, -2)
        return total

    @property
    def sensor_lens(self) -> Lens | None:
        """The lens for points in (u, v) order; None without one."""
        return _in_sensor_order(self.lens, self.along)

    # ---- where one comes from ------------------------------------------------------------------------------

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
    ) -> Triangulation:
        """Fit calibration points; take the smallest model of the family that suffices.

        A normalised direct linear transform starts Levenberg-Marquardt on the *sensor* residuals, where the
        noise is: the sheet points are taken as exact. See `homography` for the family.

        Parameters
        ----------
        sensor_points, sheet_points
            Measured (u, v) and known (G, H) [m], each (n, 2).
        sigma
            Standard deviation of the sensor coordinates: a number, (sigma_u, sigma_v), or one per point and
            coordinate, (n, 2). None: equal, and estimated from the residuals.
        model
            "C3", "C4", "D6" or "H8"; None takes the smallest one which the F test against the largest does
            not refute.
        significance
            A model is refuted where residuals so much larger have a smaller probability than this.
        symmetry
            v of the plane of symmetry, for C4.
        region
            Of the sensor; None: the box around the points.
        along, lens
            As in the class.

        Raises
        ------
        ValueError
            If shapes differ, a point is not finite or lies beyond the lens' fold, or the points do not fix
            the model.
        """
        sensor = np.asarray(sensor_points, dtype=np.float64)
        fits = homography.compare(
            sensor,
            sheet_points,
            sigma=sigma,
            models=None if model is None else (model,),
            symmetry=symmetry,
            region=region,
            lens=_in_sensor_order(lens, along),
        )
        chosen = next(each for each in fits if each.p_value >= significance or each is fits[-1])
        known = np.ravel([] if sigma is None else sigma)
        return cls(
            homography=numbers(chosen.homography, (3, 3), "Triangulation.homography"),
            covariance=None
            if chosen.covariance is None
            else numbers(chosen.covariance, (8, 8), "Triangulation.covariance"),
            region=homography.box(sensor) if region is None else region,
            model=chosen.model,
            along=along,
            lens=lens,
            sigma=(float(known[0]), float(known[-1])) if known.size in (1, 2) else None,
        )

    @classmethod
    def from_camera(
        cls,
        camera_matrix: npt.ArrayLike,
        rotation: npt.ArrayLike,
        translation: npt.ArrayLike,
        *,
        g_axis: npt.ArrayLike = (1.0, 0.0, 0.0),
        h_axis: npt.ArrayLike = (0.0, 0.0, 1.0),
        origin: npt.ArrayLike = (0.0, 0.0, 0.0),
        along: Along = "columns",
        **more: Any,
    ) -> Triangulation:
        """Build one from a camera's matrix and pose and the place of the sheet.

        Parameters
        ----------
        camera_matrix
            3 x 3, (column, row, 1) ~ camera_matrix (X, Y, Z); any invertible one, a tilted sensor's too.
        rotation, translation
            World to camera, (3, 3) and (3,) [m].
        g_axis, h_axis, origin
            The sheet in the world: G along the first, H along the second, from the third [m].
        along, **more
            The other parameters of the class; ``region`` is needed.
        """
        to_sensor = homography.seen_by_camera(camera_matrix, rotation, translation, (g_axis, h_axis, origin))
        if along == "columns":
            to_sensor = to_sensor[[1, 0, 2]]
        matrix = numbers(homography.inverse(to_sensor), (3, 3), "Triangulation.homography")
        return cls(homography=matrix, along=along, **more)

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
        """Build the thesis' triangulation setup (Figure 3.4): a sheet straight down, a lens beside it.

        The optical axis meets the sheet at H = 0, G = 0, where u = v = 0; u grows with H. With t the angle
        between the axis and the sheet, tan t = baseline / stand_off, and D the distance along the axis:
        ``u = f' H sin t / (D cos a - H cos(t - a))``, ``v = f' G cos a / (D cos a - H cos(t - a))``.

        Parameters
        ----------
        baseline
            From the sheet to the lens, b [m].
        stand_off
            From H = 0 up to the lens, Z0 [m].
        focal_distance
            From the lens to the sensor along the axis, f' [m]; in pixels, u and v are pixels.
        tilt
            Angle a of the sensor [rad]; None takes Scheimpflug's, which holds the whole sheet in focus:
            tan a = f' / (D tan t). ``focal_distance`` must then be in metres.
        **more
            The other parameters of the class; ``region`` is needed.

        Raises
        ------
        ValueError
            If a length is not positive, or the tilt is not within a right angle.
        """
        to_sensor = homography.seen_from_beside(baseline, stand_off, focal_distance, tilt)
        matrix = numbers(homography.inverse(to_sensor), (3, 3), "Triangulation.homography")
        return cls(homography=matrix, model="C4", **more)

    # ---- constants and tables ------------------------------------------------------------------------------

    @classmethod
    def from_constants(cls, constants: Sequence[float], **more: Any) -> Triangulation:
        """Build one from De Bakker's constants or the extended ones; their number names the model.

        3: ``H = (c1 u + c2)/(c3 u + 1)``, G = 0. 4: ``H = (C1 u + C2)/(u + C3)``, ``G = C4 v/(u + C3)``.
        6: ``H = (D1 u + D2)/(u + D3)``, ``G = (D4 v + D5 u + D6)/(u + D3)``. 8: the homography's rows, its
        last element 1.

        Raises
        ------
        ValueError
            If there are not 3, 4, 6 or 8.
        """
        rows, model = homography.of_constants(tuple(finite(each, "constants") for each in constants))
        return cls(homography=rows, model=model, **more)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, as TOML holds them; what is None is left out."""
        table: dict[str, Any] = {"homography": [list(row) for row in self.homography]}
        table["region"] = [list(bounds) for bounds in self.region]
        table |= {"model": self.model, "along": self.along, "horizon": self.horizon}
        if self.covariance is not None:
            table["covariance"] = [list(row) for row in self.covariance]
        if self.sigma is not None:
            table["sigma"] = list(self.sigma)
        if self.lens is not None:
            table["lens"] = self.lens.to_dict()
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], *, precision: Precision = None) -> Triangulation:
        """Build a triangulation from such a table; ``homography`` and ``region`` are needed.

        Raises
        ------
        ValueError, TypeError
            If a key is unknown or missing, or a value is not what it must be.
        """
        values = dict(check_keys(table, _KEYS, ("homography", "region"), "triangulation"))
        if "lens" in values:
            values["lens"] = Lens.from_dict(values["lens"])
        return cls(**values, precision=precision)


def _in_sensor_order(lens: Lens | None, along: Along) -> Lens | None:
    return lens.swapped() if lens is not None and along == "columns" else lens
