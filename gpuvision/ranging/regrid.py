"""Resampling of an organised range image (point cloud) to a height map over regular cells in x and y.

A range scan samples a surface at irregular places (F. de Jong, Figure 2.5), while standard image processing needs
regular cells. Resampling runs twice: along the samples of every profile, where the other coordinate is also
interpolated, and then along the profiles. Interpolation between neighbours is linear. Holes remain holes, and height
steps remain steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import pyopencl as cl
import pyopencl.array

from gpuvision.host import (
    Bound,
    Device,
    DeviceArray,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    capacity,
    ceil_div,
    flags,
    group_per_element,
    type_defines,
    vector_work,
)
from gpuvision.host.array_checks import mixed_kinds
from gpuvision.operation import VisionOperation
from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.validation import finite

R = TypeVar("R", bound=tuple[Any, ...])
Direction = Literal["x", "-x", "y", "-y"]
# Work-items of a group on a GPU, an item for each sample of a tile (chosen: a line of 1000 samples is four tiles). Most
# lines of a group: MAX_LINES in kernels/regrid/line_group.h. Least lines of a group where lines are adjacent: eight
# floats fill a sector of 32 bytes.
_GROUP, _MAX_LINES, _LINES_OF_SECTOR = 256, 16, 8
_LANES = 16  # LANES of the vector variant (kernels/common/lanes.h)
_DIRECTIONS = ("x", "-x", "y", "-y")


@dataclass(frozen=True, kw_only=True)
class Regrid:
    """Resampling of an organised range image to heights over regular cells.

    Called as ``op(x, y, z, intensity, status)`` with arrays of shape (profiles, samples), float32 or float64 (uint8
    status), NumPy or device arrays; returns a `HeightMap`. With ``sigma=True`` the standard deviation of z is the last
    argument [m].

    Interpolation is linear between neighbouring good samples, in x and in y. Two samples are neighbours if they are at
    most `max_gap` apart and their heights differ by at most `max_step`; bad samples between them are bridged.

    Where the coordinate along a line runs backwards (dX/di <= 0), two surfaces share the cells: all cells from there to
    the furthest point reached before are NOT_INVERTIBLE. Noise makes a fine sampling run backwards by a little
    everywhere; `fold_tolerance` is the size of this noise.

    Parameters
    ----------
    grid : Grid
        Cells of the height map.
    max_gap, max_step : float
        Largest distance between neighbours along x or y, and largest difference of their heights [m], >= 0.
    along : {"x", "-x", "y", "-y"}
        Scene direction in which the samples of a profile advance, default ``"x"``.
    across : {"x", "-x", "y", "-y"}, optional
        Scene direction in which the profiles advance: along y if the samples advance along x, and vice versa. ``None``:
        the positive direction.
    fold_tolerance : float
        Largest distance that a line may run backwards without being folded [m], >= 0, default 0.
    folded : {"drop", "top"}
        ``"drop"``: NOT_INVERTIBLE cells are NaN. ``"top"``: they keep the highest surface, with the flag.
    sigma : bool
        Whether to compute the standard deviation of the heights, default False.
    precision : {"single", "double", None}
        Precision of the arithmetic and of the outputs; ``None`` follows the input.

    Raises
    ------
    ValueError
        A length is negative or not finite, or the directions are not one of x and one of y.

    Notes
    -----
    Error: linear interpolation of a surface with curvature k between samples at a distance d has an error of at most
    k d^2 / 8. ``sigma`` holds for the interpolation of samples with independent errors of z: between two samples it is
    below the sigma of a sample. Errors of x and y, which move the height on a slope, are not part of it. In single
    precision the place of a cell has an error of 6e-8 of its distance from the origin.
    """

    grid: Grid
    max_gap: float
    max_step: float
    along: Direction = "x"
    across: Direction | None = None
    fold_tolerance: float = 0.0
    folded: Literal["drop", "top"] = "drop"
    sigma: bool = False
    precision: Precision = None

    def __post_init__(self) -> None:
        for name in ("max_gap", "max_step", "fold_tolerance"):
            object.__setattr__(self, name, finite(getattr(self, name), f"Regrid.{name}"))
            if getattr(self, name) < 0.0:
                raise ValueError(f"Regrid.{name} is {getattr(self, name)}, expected metres, 0 or more")
        if self.along not in _DIRECTIONS:
            raise ValueError(f"Regrid.along is {self.along!r}, expected one of {', '.join(_DIRECTIONS)}")
        if self.across is not None and (self.across not in _DIRECTIONS or self.across[-1] == self.along[-1]):
            raise ValueError(f"Regrid.across is {self.across!r}, expected the axis other than along={self.along!r}")
        if self.folded not in ("drop", "top"):
            raise ValueError(f"Regrid.folded is {self.folded!r}, expected 'drop' or 'top'")

    @property
    def directions(self) -> tuple[Direction, Direction]:
        """Scene directions in which the samples and the profiles advance."""
        positive: Direction = "y" if self.along[-1] == "x" else "x"
        return self.along, self.across or positive

    def bind(
        self, device: Device | None, shape: tuple[int, ...], dtype: npt.DTypeLike, *, queue: Any = None
    ) -> BoundRegrid:
        """Prepare for range images of one shape, as `Operation.bind` does."""
        return BoundRegrid(self, Device.best() if device is None else device, shape, np.dtype(dtype), queue)

    def __call__(
        self,
        x: Any,
        y: Any,
        z: Any,
        intensity: Any,
        status: Any,
        sigma: Any = None,
        *,
        device: Device | None = None,
        out: HeightMap | None = None,
    ) -> HeightMap:
        """Resample once: NumPy arrays give NumPy arrays, device arrays give device arrays.

        Raises
        ------
        TypeError, ValueError
            Wrong dtype, shape, layout or device; or a standard deviation without ``sigma=True``, or the other way
            round.
        """
        if (sigma is not None) != self.sigma:
            raise TypeError(f"Regrid.sigma is {self.sigma}; expected the standard deviation of z if it is True")
        along, across = (x, y) if self.along[-1] == "x" else (y, x)
        more = () if sigma is None else (sigma,)
        inputs = (x, y, z, intensity, status, *more)
        if not any(all(isinstance(each, kind) for each in inputs) for kind in (np.ndarray, cl.array.Array)):
            raise mixed_kinds("Regrid", inputs)
        along_samples, along_profiles = self.passes
        lines = along_samples(along, z, intensity, status, across, *more, device=device)
        kept = () if sigma is None else (lines.sigma,)
        return along_profiles(lines.across, lines.z, lines.intensity, lines.status, *kept, device=device, out=out)

    @property
    def passes(self) -> tuple[_AlongSamples, _AlongProfiles]:
        """Operations of the two passes: along the samples of each profile, then along the profiles."""
        return _AlongSamples(regrid=self, direction=self.along), _AlongProfiles(
            regrid=self, direction=self.directions[1]
        )


class BoundRegrid:
    """`Regrid` bound to a device, a queue and a shape; used like `gpuvision.host.Bound`.

    Attributes
    ----------
    inputs : tuple of pyopencl.array.Array
        Input arrays of the instance: x, y, z, intensity, status, and sigma if the operation computes it.
    outputs : HeightMap of pyopencl.array.Array
        Output arrays of the instance.
    """

    def __init__(
        self, regrid: Regrid, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any], queue: Any
    ) -> None:
        self.operation, self.device = regrid, device
        self._x_first = regrid.along[-1] == "x"
        along_samples, along_profiles = regrid.passes
        self._samples: Bound[_Lines] = along_samples.bind(device, shape, dtype, queue=queue)
        self._lines = self._samples.outputs
        self._profiles: Bound[HeightMap] = along_profiles.bind(
            device, self._lines.z.shape, self._lines.z.dtype, queue=queue
        )
        along, z, intensity, status, across, *sigma = self._samples.inputs
        x, y = (along, across) if self._x_first else (across, along)
        self.inputs = (x, y, z, intensity, status, *sigma)
        self.outputs = self._profiles.outputs

    def __call__(self, *frames: DeviceArray, out: HeightMap | None = None, wait_for: Any = None) -> Any:
        """Enqueue both passes and return the event of the second.

        Parameters
        ----------
        *frames : pyopencl.array.Array
            x, y, z, intensity, status, and sigma if the operation computes it; without arguments: `inputs`.
        out : HeightMap, optional
            Where to write instead of `outputs`.
        wait_for : sequence of pyopencl.Event, optional

        Raises
        ------
        TypeError, ValueError
            A frame has another shape, dtype or device than the instance.
        """
        if len(frames) not in (0, len(self.inputs)):
            expected = (
                "x, y, z, intensity, status and sigma" if self.operation.sigma else "x, y, z, intensity and status"
            )
            raise TypeError(f"expected {expected}, got {len(frames)} arrays")
        x, y, z, intensity, status, *sigma = frames or self.inputs
        along, across = (x, y) if self._x_first else (y, x)
        first = self._samples(along, z, intensity, status, across, *sigma, wait_for=wait_for)
        lines: Any = self._lines
        kept = (lines.sigma,) if self.operation.sigma else ()
        return self._profiles(lines.across, lines.z, lines.intensity, lines.status, *kept, out=out, wait_for=[first])


class RegridCounts(NamedTuple):
    """Sizes and pitches [elements] of ``kernels/regrid/regrid.cl``, in the order of its struct ``RegridCounts``."""

    samples: int
    line_pitch: int
    sample_pitch: int
    cells: int
    out_line_pitch: int
    out_cell_pitch: int
    drop_folded: int
    lines: int
    lines_per_group: int
    tile_pitch: int
    out_set_pitch: int
    out_lines: int


class RegridTable(NamedTuple):
    """Parameters of ``kernels/regrid/regrid.cl``, in the order of its struct ``RegridTable``."""

    origin: float
    per_metre: float
    sense: float
    max_gap: float
    max_step: float
    fold_tolerance: float


def _lines_per_group(samples: int, least: int) -> int:
    """Return the number of lines of a work-group: short lines share a group, so that most items have a sample."""
    return min(max(least, _GROUP // capacity(samples)), _MAX_LINES)


class _Lines(NamedTuple):
    """Profiles resampled along their samples: arrays of shape (profiles, cells).

    Vector variant: (sets, cells, 16), for sets of 16 neighbouring profiles; profiles beyond the last one are NO_DATA.
    """

    z: FloatArray
    intensity: FloatArray
    status: StatusArray
    sigma: FloatArray | None
    across: FloatArray


@dataclass(frozen=True, kw_only=True)
class _Pass(VisionOperation[R]):
    """One pass of a `Regrid`: resample the lines of an array to the cells of one direction."""

    regrid: Regrid
    direction: Direction

    def _table(self) -> RegridTable:
        """Return the parameter table of the kernel."""
        grid, regrid = self.regrid.grid, self.regrid
        on_x = self.direction[-1] == "x"
        origin = grid.left if on_x else grid.top
        # Rows run against y.
        per_metre = 1.0 / grid.cell_x if on_x else -1.0 / grid.cell_y
        sense = math.copysign(1.0, per_metre) * (-1.0 if self.direction.startswith("-") else 1.0)
        per_length = abs(per_metre)
        gap, tolerance = regrid.max_gap * per_length, regrid.fold_tolerance * per_length
        return RegridTable(
            origin=origin,
            per_metre=per_metre,
            sense=sense,
            max_gap=gap,
            max_step=regrid.max_step,
            fold_tolerance=tolerance,
        )

    def _cells(self) -> int:
        return self.regrid.grid.columns if self.direction[-1] == "x" else self.regrid.grid.rows

    def _builder(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> LaunchBuilder:
        build = LaunchBuilder(self, device, shape, dtype, precision=self.regrid.precision, name="Regrid")
        build.check_dtype("float32", "float64", of="points")
        return build

    def _resample(
        self, build: LaunchBuilder, lines: int, made: tuple[int, ...], counts: RegridCounts, *, with_other: bool
    ) -> Launch:
        """Describe the launch that resamples lines; `with_other`: also interpolate the other coordinate.

        Parameters
        ----------
        lines : int
            Number of lines.
        made : tuple of int
            Shape of the outputs.
        counts : RegridCounts
            Sizes and pitches of the inputs and outputs.
        """
        value = (build.shape, build.dtype)
        with_sigma = self.regrid.sigma
        groups = ceil_div(lines, counts.lines_per_group)
        made_by_name = {name: made if name != "sigma" or with_sigma else None for name in self.Result._fields}
        return build.launch(
            "regrid/regrid.cl",
            "resample",
            work=vector_work(lines, _LANES) if build.uses_vectors else group_per_element(groups, _GROUP),
            more_inputs=[value, value, (build.shape, np.dtype(np.uint8)), *([value] * (with_other + with_sigma))],
            outputs=build.outputs(made_by_name),
            defines={
                **type_defines("INPUT", build.dtype, _LANES),
                **flags(WITH_OTHER=with_other, WITH_SIGMA=with_sigma),
                **({} if build.uses_vectors else {"GROUP": _GROUP}),
            },
            # Without the other coordinate the kernel gets a null pointer for its output, the last one.
            arguments=[
                *([] if with_other else [None]),
                np.array(counts, np.uint32),
                np.array(self._table(), build.real),
            ],
            problem_per_group=not build.uses_vectors,
        )


@dataclass(frozen=True, kw_only=True)
class _AlongSamples(_Pass[_Lines]):
    """First pass: a line is a profile; the other coordinate is also interpolated."""

    Result: ClassVar[type[Any]] = _Lines

    def input_names(self, count: int) -> list[str]:
        """Return the names of the inputs of `Regrid` in the order of the pass."""
        along, across = ("x", "y") if self.direction[-1] == "x" else ("y", "x")
        return [f"Regrid: {name}" for name in (along, "z", "intensity", "status", across, "sigma")[:count]]

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = self._builder(device, shape, dtype)
        build.check_shape(len(shape) == 2 and 0 not in shape, "arrays (profiles, samples) with one sample at least")
        profiles, samples = shape
        cells = self._cells()
        sets = ceil_div(profiles, _LANES)
        made = (sets, cells, _LANES) if build.uses_vectors else (profiles, cells)
        counts = RegridCounts(
            samples=samples,
            line_pitch=samples,
            sample_pitch=1,
            cells=cells,
            out_line_pitch=1 if build.uses_vectors else cells,
            out_cell_pitch=_LANES if build.uses_vectors else 1,
            drop_folded=0,
            lines=profiles,
            lines_per_group=_lines_per_group(samples, 1),
            tile_pitch=_LANES,
            out_set_pitch=_LANES * cells,
            out_lines=_LANES * sets,
        )
        return self._resample(build, profiles, made, counts, with_other=True)


@dataclass(frozen=True, kw_only=True)
class _AlongProfiles(_Pass[HeightMap]):
    """Second pass: a line is a cell of the first pass over all profiles, in `_Lines` of either layout."""

    Result: ClassVar[type[Any]] = HeightMap

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = self._builder(device, shape, dtype)
        in_sets = build.uses_vectors and len(shape) == 3 and shape[2] == _LANES
        build.check_shape(in_sets or len(shape) == 2, "the lines of the first pass")
        lines, profiles = shape[1], shape[0] * (_LANES if in_sets else 1)
        cells = self._cells()
        # A line is a row of the map or a column of it.
        line_pitch, cell_pitch = (cells, 1) if self.direction[-1] == "x" else (1, lines)
        counts = RegridCounts(
            samples=profiles,
            line_pitch=_LANES if in_sets else 1,
            sample_pitch=1 if in_sets else lines,
            cells=cells,
            out_line_pitch=line_pitch,
            out_cell_pitch=cell_pitch,
            drop_folded=int(self.regrid.folded == "drop"),
            lines=lines,
            lines_per_group=_lines_per_group(profiles, _LINES_OF_SECTOR),
            tile_pitch=_LANES * lines,
            out_set_pitch=_LANES * line_pitch,
            out_lines=lines,
        )
        return self._resample(build, lines, self.regrid.grid.shape, counts, with_other=False)
