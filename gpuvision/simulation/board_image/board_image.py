"""Images of a board as a camera takes them: pose, motion blur, lens, illumination, and the noise of a CMOS sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.lens import Lens
from gpuvision.host import (
    Array,
    Define,
    Device,
    Launch,
    LaunchBuilder,
    Variant,
    flags,
    opencl_type,
    table_offsets,
    type_defines,
)
from gpuvision.host.work_size import WorkSize, round_up
from gpuvision.operation import VisionOperation
from gpuvision.simulation.board_image.reflectance_map import WHITE, ReflectanceMap
from gpuvision.validation import finite, integer

Float32 = npt.NDArray[np.float32]

_LANES, _GROUP = 16, 64
_MOST_SUBPOSES = 64  # sub-poses that a work-item keeps


class BoardImageTable(NamedTuple):
    """Parameters of ``kernels/board_image/board_image.cl``, which reads them by name.

    Attributes
    ----------
    centre_x, centre_y
        Centre of the image [px].
    grow
        Nodes of the map per pixel.
    per_value
        Electrons, or reflectance, per value of the map, over the number of sub-poses.
    white
        Electrons, or reflectance, of white.
    dark
        Dark current [e-]. Default 0.0.
    dark_variance
        Variance of the dark noise [e-^2]. Default 0.0.
    full_well
        Most electrons of a pixel. Default 0.0.
    bend
        Non-linearity over the full well [1/e-]. Default 0.0.
    dark_level, gain, max_level
        Grey level without electrons, grey levels per electron, and the largest one. Defaults 0.0, 0.0 and 0.0.
    """

    centre_x: float
    centre_y: float
    grow: float
    per_value: float
    white: float
    dark: float = 0.0
    dark_variance: float = 0.0
    full_well: float = 0.0
    bend: float = 0.0
    dark_level: float = 0.0
    gain: float = 0.0
    max_level: float = 0.0


class BoardImage(NamedTuple):
    """Images of a board.

    Attributes
    ----------
    image : (frames, rows, columns)
        Grey levels: uint8 for sensors of up to 8 bits, otherwise uint16. Without a sensor: float32 reflectance.
    """

    image: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderBoard(VisionOperation[BoardImage]):
    """Rendering of a board under a camera: ``op(poses, numbers) -> BoardImage``.

    The poses are float64 (or float32) of shape (frames, sub-poses, 3): x, y [m] and theta [rad] of the camera over the
    board as in `BoardView` (the point of the board at the image's centre, and the angle of increasing columns), at
    times spread evenly over the exposure; one sub-pose: no motion. Motion of up to half a pixel between sub-poses is
    smooth. The numbers are uint32 (frames,): the number of a frame selects its noise; equal numbers give equal noise.

    Parameters
    ----------
    board : ReflectanceMap
        Board, rasterised for the camera's size of a pixel.
    shape : (int, int)
        Rows and columns of the image, or of the region of interest that is read.
    mirrored : bool
        The camera sees the board from behind, as in `BoardView`. Default False.
    sensor : CmosSensor, optional
        Sensor. Default: none; the image is the reflectance in float32.
    electrons : float
        Photoelectrons of white board (reflectance 1) during the exposure; with a sensor only. Default: 0.8 of its
        saturation. Range: above 0.
    exposure : float
        Exposure time for the dark current [s], default 0. Range: 0 or more.
    noise : bool
        Whether noise from frame to frame is added. Default True.
    seed : int
        Key of the noise, and of the differences between the pixels (prnu and dsnu), 0 to 2^32 - 1. Default 0.
    illumination : numpy.ndarray, optional
        (rows, columns) irradiance of the board in each pixel relative to its nominal value: gradients, vignetting.
    glare : numpy.ndarray, optional
        (rows, columns) reflectance that is added in each pixel: specular highlights.
    model : Lens or Camera, optional
        Lens distortion; the image is the measured one. With a region of interest use `Lens.in_window`.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" computes 16 pixels at a time (CPU runtimes), "work_item" one pixel per item (GPUs).

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    Notes
    -----
    Shot noise and dark noise are one normal number of the variance electrons + dark_noise^2, by a counter-based
    generator (Philox): the image depends on the seed, the frame number and the pixel only. A Poisson distribution is
    skew by 1 / sqrt(electrons), which is left out.

    Edges lie where the artwork and the pose put them to 0.002 px with the defaults of `ReflectanceMap`. A pose that is
    not finite, or far outside the map, shows the border of the map.

    Cost: per pixel and sub-pose four values of the map, and per pixel one random number. A frame of 256 x 256 pixels
    with noise takes less than 0.5 ms on two cores.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, chapter 7.
    .. [2] J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011.
    """

    Result: ClassVar[type[Any]] = BoardImage

    board: ReflectanceMap
    shape: tuple[int, int]
    mirrored: bool = False
    sensor: CmosSensor | None = None
    electrons: float | None = None
    exposure: float = 0.0
    noise: bool = True
    seed: int = 0
    illumination: npt.NDArray[Any] | None = None
    glare: npt.NDArray[Any] | None = None
    model: Lens | Camera | None = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.board, ReflectanceMap):
            raise TypeError(f"RenderBoard.board is a {type(self.board).__name__}, expected a ReflectanceMap")
        for each in self.shape:
            integer(each, "RenderBoard.shape", minimum=1, maximum=1 << 15)
        integer(self.seed, "RenderBoard.seed", minimum=0, maximum=(1 << 32) - 1)
        finite(self.exposure, "RenderBoard.exposure [s]", minimum=0.0)
        if self.electrons is not None:
            finite(self.electrons, "RenderBoard.electrons", above=0.0)
            if self.sensor is None:
                raise ValueError("RenderBoard.electrons needs a sensor; give the sensor")
        for name in ("illumination", "glare"):
            given = getattr(self, name)
            if given is not None and (np.shape(given) != tuple(self.shape) or not np.isfinite(given).all()):
                raise ValueError(f"RenderBoard.{name} has the shape {np.shape(given)}, expected finite {self.shape}")
        if not isinstance(self.model, Lens | Camera | None):
            raise TypeError(f"RenderBoard.model is a {type(self.model).__name__}, expected a Lens or a Camera")

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the images."""
        if self.sensor is None:
            return np.dtype(np.float32)
        return np.dtype(np.uint8 if self.sensor.bits <= 8 else np.uint16)

    @property
    def white_electrons(self) -> float:
        """Photoelectrons of white board during the exposure; 0 without a sensor."""
        if self.sensor is None:
            return 0.0
        return 0.8 * self.sensor.saturation if self.electrons is None else self.electrons

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for poses of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision="single", narrows=True, variant=self.variant)
        build.check_dtype("float64", "float32", of="poses")
        is_valid = len(shape) == 3 and shape[0] > 0 and 0 < shape[1] <= _MOST_SUBPOSES and shape[2] == 3
        build.check_shape(is_valid, f"poses (frames, sub-poses, 3) with 1 to {_MOST_SUBPOSES} sub-poses")
        frames, subposes = shape[:2]
        rows, columns = self.shape
        if build.uses_vectors and columns >= _LANES:
            work = WorkSize((rows, frames), (1, 1), vectors=True)
        else:
            work = WorkSize((round_up(columns, _GROUP), rows, frames), (_GROUP, 1, 1))
        gain, offset = self._pixel_differences()
        places = self._places()
        board = self.board
        return build.launch(
            "board_image/board_image.cl",
            "board_image",
            work=work,
            more_inputs=[((frames,), np.dtype(np.uint32))],
            outputs=build.outputs({"image": (frames, rows, columns)}, image=self.dtype),
            defines=self._defines(dtype, subposes, gain=gain, offset=offset, places=places),
            arguments=[
                board.values,
                np.array([*board.origin, 1.0 / board.cell], dtype),
                np.array(self._table(subposes), np.float32),
                np.array([rows, columns, *board.values.shape], np.int32),
                gain,
                offset,
                None if self.glare is None else np.asarray(self.glare, np.float32),
                places,
                np.uint32(self.seed),
            ],
        )

    def _table(self, subposes: int) -> BoardImageTable:
        rows, columns = self.shape
        white = 1.0 if self.sensor is None else self.white_electrons
        table = BoardImageTable(
            centre_x=(columns - 1) / 2,
            centre_y=(rows - 1) / 2,
            grow=self.board.pixel / self.board.cell,
            per_value=white / (WHITE * subposes),
            white=white,
        )
        if self.sensor is None:
            return table
        sensor = self.sensor
        return table._replace(
            dark=sensor.dark_current * sensor.exposure_time(self.exposure),
            dark_variance=sensor.dark_noise**2,
            full_well=sensor.full_well,
            bend=sensor.nonlinearity / sensor.full_well,
            dark_level=sensor.dark_level,
            gain=sensor.gain,
            max_level=float(sensor.max_level),
        )

    def _defines(self, dtype: np.dtype[Any], subposes: int, **arrays: Float32 | None) -> dict[str, Define]:
        sensor = self.sensor
        return {
            **type_defines("CODE", self.dtype, 16),
            "CONVERT_CODES": f"convert_{opencl_type(self.dtype)}16",
            "POSE": opencl_type(dtype),
            "SUBPOSES": subposes,
            **table_offsets("TABLE", dict.fromkeys(BoardImageTable._fields, 1)),
            **flags(
                POSE_IS_DOUBLE=dtype == np.float64,
                SENSOR=sensor is not None,
                NOISE=sensor is not None and self.noise,
                BENT=sensor is not None and sensor.nonlinearity > 0.0,
                MIRRORED=self.mirrored,
                GLARE=self.glare is not None,
                **{name.upper(): array is not None for name, array in arrays.items()},
            ),
        }

    def _pixel_differences(self) -> tuple[Float32 | None, Float32 | None]:
        """Return the gain and the dark offset [e-] of each pixel, each (rows, columns); None where all are equal."""
        prnu, dsnu = (0.0, 0.0) if self.sensor is None else (self.sensor.prnu, self.sensor.dsnu)
        rng = np.random.default_rng(self.seed)
        gains, offsets = rng.standard_normal((2, *self.shape))
        gain = None if self.illumination is None else np.asarray(self.illumination, np.float64)
        if prnu:
            gain = (1.0 if gain is None else gain) * (1.0 + prnu * gains)
        return (
            None if gain is None else np.asarray(gain, np.float32),
            np.asarray(dsnu * offsets, np.float32) if dsnu else None,
        )

    def _places(self) -> Float32 | None:
        """Return dx and dy (2, rows, columns) of the undistorted pixels from the image's centre [px]."""
        if self.model is None:
            return None
        rows, columns = self.shape
        x, y = np.meshgrid(np.arange(float(columns)), np.arange(float(rows)))
        ideal = self.model.undistort(np.stack([x, y], axis=-1)) - ((columns - 1) / 2, (rows - 1) / 2)
        if not np.isfinite(ideal).all():
            raise ValueError("RenderBoard.model: some pixels have no undistorted position; the lens model folds there")
        return np.ascontiguousarray(np.moveaxis(ideal, -1, 0), np.float32)


def exposure_poses(start: npt.ArrayLike, end: npt.ArrayLike, count: int) -> npt.NDArray[np.float64]:
    """Return sub-poses of a steady motion during the exposure, at the middles of equal parts of the time.

    Parameters
    ----------
    start, end : array_like
        Poses (..., 3) at the begin and at the end of the exposure: x, y [m], theta [rad].
    count : int
        Number of sub-poses, 1 or more; a motion blur of n pixels needs 2 n.

    Returns
    -------
    numpy.ndarray
        (..., count, 3) float64.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.
    """
    share = (np.arange(integer(count, "count", minimum=1)) + 0.5) / count
    first, last = (np.asarray(each, np.float64)[..., None, :] for each in (start, end))
    return np.asarray(first + share[:, None] * (last - first))
