"""Image undistortion (remap): interpolate a measured image at the measured positions of ideal pixels."""

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
from gpuvision.host import (
    Array,
    Define,
    Device,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Variant,
    WorkSize,
    ceil_div,
    round_up,
    type_defines,
)
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
# Samples of a frame: indices into frames and maps are 32-bit int on the device.
_LARGEST_FRAME = 2**30
# Rows of a map computed in one pass, so that the intermediate arrays of a camera model fit into the caches.
_ROWS_AT_ONCE = 32
# Work-items of a work-group along columns and rows.
_GROUP = (32, 4)
_QUAD = 4  # samples of a work-item for bilinear integer images


@runtime_checkable
class DistortionModel(Protocol):
    """Camera model that returns the measured position of an ideal pixel."""

    def distort(self, points: npt.ArrayLike, /) -> npt.NDArray[np.float64]:
        """Return measured (column, row) of ideal points (..., 2); NaN where none exists."""
        ...


class UndistortedImage(NamedTuple):
    """Undistorted images.

    Attributes
    ----------
    image : array
        (..., rows, columns[, 3]), in the input's dtype.
    status : array of uint8
        (rows, columns) `Status` flags, the same for every image of a batch. NO_DATA: the source position lies outside
        the source image. NOT_INVERTIBLE: the ideal pixel lies past the fold of the camera model and has no source
        position.
    """

    image: Array
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class UndistortImage(VisionOperation[UndistortedImage]):
    """Image undistortion: measured images to ideal images (OpenCV: ``remap``, ``undistort``).

    ``op(image)`` takes uint8, uint16 or float32 images (..., rows, columns), or (..., rows, columns, 3) for three
    channels, as NumPy or device arrays, and returns an `UndistortedImage`.

    Parameters
    ----------
    model : Lens, Camera, DistortionModel, PixelMap or numpy.ndarray
        Camera model, or the map itself: for each output pixel the (column, row) in the source image [px], (rows,
        columns, 2), NaN where none exists.
    interpolation : {"bilinear", "bicubic"}
        "bicubic" is the cubic convolution with a = -0.75, as in OpenCV. Default "bilinear".
    channels : {1, 3}
        Number of channels; 3 channels are the last axis. Default 1.
    border : {"mask", "constant", "replicate", "reflect"}
        Value of pixels outside the source image. "mask" (default): NaN, or 0 in integer images. "constant":
        `border_value`. "replicate": the outermost pixel. "reflect": the image mirrored about the centres of its
        outermost pixels. The status flags these pixels in every case.
    border_value : float
        Value of the constant border [grey levels]. Default 0.
    size : (int, int), optional
        Columns and rows of the ideal image. Default: the size of the input, or of the map.
    region : (int, int, int, int), optional
        (column, row, columns, rows): part of the ideal image to compute [px]. Default: all of it.
    matrix : 3 x 3, optional
        ((fx, 0, cx), (0, fy, cy), (0, 0, 1)): camera matrix of the ideal image [px], for a `Camera`. Default: the
        matrix of ``model``.
    coordinates : {"map", "computed"}
        "map" (default): source positions are computed once in double precision and packed. "computed": the kernel
        computes them for every image from a `Lens` or a `Camera`; this needs no memory and no preparation.
    precision : {"single", "double"}, optional
        Precision of computed source positions. Default "single": exact to the rounding of the coordinate.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: 16-wide vectors for CPU runtimes, a work-item per sample for GPUs (per four samples for bilinear
        integer images), or by the device (default).

    Raises
    ------
    TypeError, ValueError
        The model does not support an option, or a number is out of its range.

    Notes
    -----
    Error: source positions of a map are exact to 1e-5 px. Integer outputs are rounded to nearest; single precision
    adds about 1e-7 of the largest value. Pixels without a source position (NOT_INVERTIBLE) get `border_value` under
    ``border="constant"``, otherwise NaN, or 0 in integer images.

    References
    ----------
    R. Keys, Cubic convolution interpolation for digital image processing, IEEE Trans. ASSP 29 (1981) 1153.
    """

    Result: ClassVar[type[Any]] = UndistortedImage

    model: Any  # a PixelMap or a DistortionModel; arrays are converted to PixelMap
    interpolation: Interpolation = "bilinear"
    channels: int = 1
    border: Border = "mask"
    border_value: float = 0.0
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
        object.__setattr__(self, "value", finite(self.border_value, "UndistortImage.border_value"))
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
            value = getattr(self, name)
            if value not in allowed or isinstance(value, bool | np.bool_):
                expected = ", ".join(map(repr, allowed))
                raise ValueError(f"UndistortImage.{name} is {value!r}, expected one of {expected}")

    def _check_model(self) -> None:
        if not isinstance(self.model, PixelMap | DistortionModel):
            kind = type(self.model).__name__
            raise TypeError(f"UndistortImage.model is a {kind}, expected a map or a model with distort(points)")
        if isinstance(self.model, PixelMap) and self.size is not None:
            raise ValueError("UndistortImage.size: a map has its own size; leave it out")
        if self.matrix is not None and not isinstance(self.model, Camera):
            raise TypeError("UndistortImage.matrix needs a Camera, whose own matrix it replaces")
        if self.coordinates == "computed" and not isinstance(self.model, Lens | Camera):
            raise TypeError("UndistortImage.coordinates='computed' needs a Lens or a Camera; use 'map'")
        if self.coordinates == "map" and self.precision is not None:
            raise ValueError(
                "UndistortImage.precision has no effect on a map, which is made in double; give coordinates='computed'"
            )

    def source_positions(self, shape: tuple[int, int]) -> npt.NDArray[np.float64]:
        """Return the source position of every output pixel.

        Parameters
        ----------
        shape : (int, int)
            Rows and columns of the source image.

        Returns
        -------
        numpy.ndarray
            (rows, columns, 2) float64: column and row in the source image [px]; NaN where none exists.
        """
        first_column, first_row, columns, rows = self._region(shape)
        part = slice(first_row, first_row + rows), slice(first_column, first_column + columns)
        if isinstance(self.model, PixelMap):
            return self.model.positions[part]
        options = {} if self.matrix is None else {"matrix": self.matrix}
        positions = np.empty((rows, columns, 2))
        for first in range(0, rows, _ROWS_AT_ONCE):
            block = positions[first : first + _ROWS_AT_ONCE]
            block[..., 0] = np.arange(columns) + first_column
            block[..., 1] = (np.arange(first, first + len(block)) + first_row)[:, None]
            block[:] = self.model.distort(block, **options)
        return positions

    def _region(self, shape: tuple[int, int]) -> tuple[int, int, int, int]:
        """Return column, row, columns, rows of the output within the ideal image."""
        full_shape = self.model.positions.shape[:2] if isinstance(self.model, PixelMap) else shape
        columns, rows = self.size or full_shape[::-1]
        if self.region is None:
            return 0, 0, columns, rows
        left, top, width, height = self.region
        if isinstance(self.model, PixelMap) and not (0 <= left <= columns - width and 0 <= top <= rows - height):
            raise ValueError(f"UndistortImage.region {self.region} leaves the map of {columns} x {rows} pixels")
        return left, top, width, height

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
        fill = self.border_value if self.border == "constant" else math.nan if dtype.kind == "f" else 0.0
        if build.uses_vectors:
            work = WorkSize((made_rows, frames), (1, 1), vectors=True)
        else:
            wide, high = _GROUP
            each = _QUAD if self._quad(dtype) else self.channels if computed else 1  # SAMPLES in undistort_image.cl
            items = ceil_div(made_columns * self.channels, each)
            work = WorkSize((round_up(items, wide), round_up(made_rows, high), frames), (wide, high, 1))
        return build.launch(
            "undistort_image/undistort_image.cl",
            "undistort",
            work=work,
            outputs=build.outputs({"image": made, "status": (made_rows, made_columns)}, image=dtype),
            defines=self._defines(dtype) | ({} if build.uses_vectors else self._quad(dtype)),
            arguments=[
                *tables,
                np.array([columns, rows, made_columns, made_rows, *region[:2], self._missing], np.int32),
                np.float32(fill),
            ],
            streams=True,
        )

    def _checked(self, build: LaunchBuilder) -> tuple[int, ...]:
        """Check type and shape of the input; return the shape without the channels."""
        build.check_dtype("uint8", "uint16", "float32", of="images")
        shape, dtype = build.shape, build.dtype
        expected = "(..., rows, columns, 3)" if self.channels == 3 else "(..., rows, columns)"
        pixels = shape if self.channels == 1 else shape[:-1]
        is_valid = len(pixels) >= 2 and 0 not in pixels[-2:] and (self.channels == 1 or shape[-1] == 3)
        build.check_shape(is_valid, f"images {expected} with one pixel at least")
        if self.channels == 1:
            build.check_no_colour("images (..., rows, columns) without channels=3")
        if dtype.kind == "u" and not 0.0 <= self.border_value <= np.iinfo(dtype).max:
            raise ValueError(
                f"UndistortImage.border_value is {self.border_value:g}, expected a value in the range of {dtype}"
            )
        return pixels

    def _packed(self, rows: int, columns: int) -> tuple[Any, ...]:
        taps = _TAPS[self.interpolation]
        has_constant_border = self.border in ("mask", "constant")
        packer = Packer(
            source=(rows, columns),
            taps=taps,
            channels=self.channels,
            missing=int(self._missing),
            outside=int(Status.NO_DATA) if has_constant_border else None,
            margin=(0.5, 0.5) if self.border == "mask" else (float(taps.after), float(taps.before + 1)),
        )
        return tuple(packer.pack(self.source_positions((rows, columns))))

    @property
    def _missing(self) -> Status:
        """Status of a pixel without a source position."""
        return Status.NO_DATA if isinstance(self.model, PixelMap) else Status.NOT_INVERTIBLE

    def _table(self, real: np.dtype[Any]) -> npt.NDArray[Any]:
        if isinstance(self.model, Lens):
            return self.model.packed((0.0, 0.0), 1.0, inverse=True).astype(real)
        table: npt.NDArray[Any] = self.model.packed(real, "distort", self.matrix)
        return table

    def _quad(self, dtype: np.dtype[Any]) -> dict[str, Define]:
        """Return the macro QUAD where a work-item of the work-item variant computes four samples."""
        if self.interpolation != "bilinear" or dtype.kind != "u":
            return {}
        return {"QUAD": {1: "uint", 2: "ulong"}[dtype.itemsize]}

    def _defines(self, dtype: np.dtype[Any]) -> dict[str, Define]:
        defines = type_defines("CODE", dtype, 16)
        defines |= {"CONVERT_CODES": f"convert_{defines['CODE16']}", "CHANNELS": self.channels}
        if dtype.kind == "u":
            defines["MAX_CODE"] = f"{np.iinfo(dtype).max}.0f"
        if self.interpolation == "bicubic":
            defines["BICUBIC"] = None
        defines[_BORDERS[self.border]] = None
        if self.coordinates == "computed":
            model = self.model.defines if isinstance(self.model, Lens) else self.model.defines(self.matrix)
            defines |= {"FROM_MODEL": None} | model
        return defines
