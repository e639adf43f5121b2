"""Undistorted images: what an ideal camera would have seen, interpolated in what the real one saw."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.image_map import Packer, PixelMap, Taps
from gpuvision.camera.lens import Lens
from gpuvision.host import Define, Device, Launch, LaunchBuilder, Precision, Variant, WorkSize, round_up, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.status import Status
from gpuvision.validation import finite, numbers

Interpolation = Literal["bilinear", "bicubic"]
Border = Literal["mask", "constant", "replicate", "reflect"]
Matrix = tuple[tuple[float, float, float], ...]

_TAPS = {"bilinear": Taps(0, 1), "bicubic": Taps(1, 2)}
_BORDERS = {
    "mask": "BORDER_MASK",
    "constant": "BORDER_CONSTANT",
    "reflect": "BORDER_REFLECT",
    "replicate": "BORDER_REPLICATE",
}
# An index into a frame, and one into a map, is an int on the device.
_LARGEST_FRAME = 2**30
# What a model computes at once stays in the caches.
_ROWS_AT_ONCE = 32
# Columns and rows of a work-group with an item per pixel.
_GROUP = (32, 4)


@runtime_checkable
class Distorts(Protocol):
    """A camera model: anything that says where an ideal pixel lies in the measured image."""

    def distort(self, points: npt.ArrayLike, /) -> npt.NDArray[np.float64]:
        """Measured (column, row) of ideal ones, shape (..., 2); NaN where there is none."""
        ...


class UndistortedImage(NamedTuple):
    """Images as an ideal camera sees them.

    Attributes
    ----------
    image
        (..., rows, columns[, 3]), in the input's dtype.
    status
        (rows, columns) uint8 `Status` flags, the same for every image of a batch. NO_DATA: the place lies outside the
        source image's pixels. NOT_INVERTIBLE: past the fold of the camera model no place exists.
    """

    image: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class UndistortImage(VisionOperation[UndistortedImage]):
    """Measured images -> ideal images.

    ``op(image)`` with uint8, uint16 or float32 of shape (..., rows, columns), or (..., rows, columns, 3) for three
    channels; NumPy or device arrays; returns an `UndistortedImage`.

    Parameters
    ----------
    model
        A camera model (`Lens`, `Camera`, anything with ``distort``), or the map itself: an array (rows, columns, 2)
        or a `PixelMap` of the (column, row) in the source image that each output pixel shows; NaN where none.
    interpolation
        ``"bilinear"``, or ``"bicubic"``: the cubic convolution with a = -0.75, as OpenCV's.
    channels
        1, or 3: the last axis.
    border
        What lies outside the source image. ``"mask"``: nothing; such pixels are NaN, or 0 in whole numbers.
        ``"constant"``: `value`. ``"replicate"``: the outermost pixel. ``"reflect"``: the image, mirrored about the
        centre of its outermost pixels. The status tells of such pixels in all cases.
    value
        Of the constant border.
    size
        (columns, rows) of the ideal image; None: those of the input, or of the map.
    region
        (column, row, columns, rows): the part of the ideal image to compute; None: all of it.
    matrix
        ((fx, 0, cx), (0, fy, cy), (0, 0, 1)) of the ideal image [px], for a `Camera`; None: the camera's own.
    coordinates
        ``"map"``: places are computed once in double, and packed. ``"computed"``: the kernel computes them for every
        image, from a `Lens` or a `Camera`; it needs no memory and no time to begin with.
    precision
        Of computed places. ``"single"`` (and None) keeps them to a rounding of the coordinate.
    variant
        ``"vector"`` for CPU runtimes, ``"work_item"`` for GPUs, ``"auto"`` by the device.

    Raises
    ------
    TypeError, ValueError
        The model cannot do what is asked, or a number is not in its range.

    Notes
    -----
    Places of a map are good to 1e-5 px, beside the rounding to whole numbers and that of single precision (about
    1e-7 of the largest value). Pixels without any place (NOT_INVERTIBLE) are as the border's policy says for ``"mask"``
    and ``"constant"``; for the others as for ``"mask"``.
    """

    Result: ClassVar[type[Any]] = UndistortedImage

    model: Any
    interpolation: Interpolation = "bilinear"
    channels: int = 1
    border: Border = "mask"
    value: float = 0.0
    size: tuple[int, int] | None = None
    region: tuple[int, int, int, int] | None = None
    matrix: Matrix | None = None
    coordinates: Literal["map", "computed"] = "map"
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if isinstance(self.model, np.ndarray):
            object.__setattr__(self, "model", PixelMap(self.model))
        self._check_choices()
        self._check_model()
        object.__setattr__(self, "value", finite(self.value, "UndistortImage.value"))
        for name, length in (("size", 2), ("region", 4)):
            given = getattr(self, name)
            if given is None:
                continue
            object.__setattr__(self, name, tuple(map(operator.index, given)))
            if len(given) != length or min(given[-2:]) < 1:
                raise ValueError(f"UndistortImage.{name} is {given}, expected {length} whole numbers, sizes above 0")
        if self.matrix is not None:
            object.__setattr__(self, "matrix", numbers(self.matrix, (3, 3), "UndistortImage.matrix"))
            self.model.defines(self.matrix)

    def _check_choices(self) -> None:
        choices: dict[str, tuple[Any, ...]] = {
            "interpolation": tuple(_TAPS),
            "channels": (1, 3),
            "border": tuple(_BORDERS),
            "coordinates": ("map", "computed"),
            "precision": ("single", "double", None),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                expected = ", ".join(map(repr, allowed))
                raise ValueError(f"UndistortImage.{name} is {getattr(self, name)!r}, expected one of {expected}")

    def _check_model(self) -> None:
        if not isinstance(self.model, PixelMap | Distorts):
            kind = type(self.model).__name__
            raise TypeError(f"UndistortImage.model is a {kind}, expected a map or a model with distort(points)")
        if isinstance(self.model, PixelMap) and self.size is not None:
            raise ValueError("UndistortImage.size: a map has its own size; leave it out")
        if self.matrix is not None and not isinstance(self.model, Camera):
            raise TypeError("UndistortImage.matrix needs a Camera, whose own matrix it replaces")
        if self.coordinates == "computed" and not isinstance(self.model, Lens | Camera):
            raise TypeError("UndistortImage.coordinates='computed' needs a Lens or a Camera; use 'map'")
        if self.coordinates == "map" and self.precision is not None:
            raise ValueError("UndistortImage.precision is that of computed coordinates; a map is made in double")

    def places(self, shape: tuple[int, int]) -> npt.NDArray[np.float64]:
        """Return the (column, row) in a source image of a shape that each output pixel shows, (rows, columns, 2)."""
        first_column, first_row, columns, rows = self._region(shape)
        part = slice(first_row, first_row + rows), slice(first_column, first_column + columns)
        if isinstance(self.model, PixelMap):
            return self.model.places[part]
        options = {} if self.matrix is None else {"matrix": self.matrix}
        places = np.empty((rows, columns, 2))
        for first in range(0, rows, _ROWS_AT_ONCE):
            some = places[first : first + _ROWS_AT_ONCE]
            some[..., 0] = np.arange(columns) + first_column
            some[..., 1] = (np.arange(first, first + len(some)) + first_row)[:, None]
            some[:] = self.model.distort(some, **options)
        return places

    def _region(self, shape: tuple[int, int]) -> tuple[int, int, int, int]:
        own = self.model.places.shape[:2] if isinstance(self.model, PixelMap) else shape
        columns, rows = self.size or own[::-1]
        if self.region is None:
            return 0, 0, columns, rows
        left, top, wide, high = self.region
        if isinstance(self.model, PixelMap) and not (0 <= left <= columns - wide and 0 <= top <= rows - high):
            raise ValueError(f"UndistortImage.region {self.region} leaves the map of {columns} x {rows} pixels")
        return left, top, wide, high

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        *batch, rows, columns = self._checked(build)
        region = self._region((rows, columns))
        made_columns, made_rows = region[2:]
        if max(rows * columns, made_rows * made_columns) * self.channels >= _LARGEST_FRAME:
            raise ValueError(f"UndistortImage takes images of fewer than 2**30 samples, got {rows} x {columns} pixels")
        frames = math.prod(batch)
        made = (*batch, made_rows, made_columns, *((3,) if self.channels == 3 else ()))
        computed = self.coordinates == "computed"
        tables = (None, None, None, self._table(build.real)) if computed else (*self._packed(rows, columns), None)
        fill = self.value if self.border == "constant" else math.nan if dtype.kind == "f" else 0.0
        if build.uses_vectors:
            work = WorkSize((made_rows, frames), (1, 1), vectors=True)
        else:
            wide, high = _GROUP
            work = WorkSize((round_up(made_columns, wide), round_up(made_rows, high), frames), (wide, high, 1))
        return build.launch(
            "undistort_image/undistort_image.cl",
            "undistort",
            work=work,
            outputs=build.outputs({"image": made, "status": (made_rows, made_columns)}, image=dtype),
            defines=self._defines(dtype),
            arguments=[
                *tables,
                np.array([columns, rows, made_columns, made_rows, *region[:2], self._missing], np.int32),
                np.float32(fill),
            ],
            streams=True,
        )

    def _checked(self, build: LaunchBuilder) -> tuple[int, ...]:
        """Check the input and return its shape without the channels."""
        build.check_dtype("uint8", "uint16", "float32", of="images")
        shape, dtype = build.shape, build.dtype
        expected = "(..., rows, columns, 3)" if self.channels == 3 else "(..., rows, columns)"
        pixels = shape if self.channels == 1 else shape[:-1]
        is_valid = len(pixels) >= 2 and 0 not in pixels[-2:] and (self.channels == 1 or shape[-1] == 3)
        build.check_shape(is_valid, f"images {expected} with one pixel at least")
        if dtype.kind == "u" and not 0.0 <= self.value <= np.iinfo(dtype).max:
            raise ValueError(f"UndistortImage.value is {self.value:g}, expected what {dtype} holds")
        return pixels

    def _packed(self, rows: int, columns: int) -> tuple[Any, ...]:
        taps = _TAPS[self.interpolation]
        known = self.border in ("mask", "constant")
        packer = Packer(
            source=(rows, columns),
            taps=taps,
            channels=self.channels,
            missing=int(self._missing),
            outside=int(Status.NO_DATA) if known else None,
            margin=(0.5, 0.5) if self.border == "mask" else (float(taps.after), float(taps.before + 1)),
        )
        return tuple(packer.pack(self.places((rows, columns))))

    @property
    def _missing(self) -> Status:
        """What it means that a pixel has no place."""
        return Status.NO_DATA if isinstance(self.model, PixelMap) else Status.NOT_INVERTIBLE

    def _table(self, real: np.dtype[Any]) -> npt.NDArray[Any]:
        if isinstance(self.model, Lens):
            return self.model.packed((0.0, 0.0), 1.0, inverse=True).astype(real)
        table: npt.NDArray[Any] = self.model.packed(real, "distort", self.matrix)
        return table

    def _defines(self, dtype: np.dtype[Any]) -> dict[str, Define]:
        defines = type_defines("CODE", dtype, 16)
        defines |= {"CONVERT_CODES": f"convert_{defines['CODE16']}", "CHANNELS": self.channels}
        if dtype.kind == "u":
            defines["LARGEST"] = f"{np.iinfo(dtype).max}.0f"
        if self.interpolation == "bicubic":
            defines["BICUBIC"] = None
        defines[_BORDERS[self.border]] = None
        if self.coordinates == "computed":
            model = self.model.defines if isinstance(self.model, Lens) else self.model.defines(self.matrix)
            defines |= {"COMPUTED": None} | model
        return defines
