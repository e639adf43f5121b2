"""Camera pose from a frame of a servo loop, compared with the same method in Numba, and in NumPy and OpenCV.

A region of 128 x 128 to 256 x 256 pixels, 8 bits, shows a square; 60 calipers (rulers) of 64 samples and 5 lines cross
its sides. All candidates copy the frame, place the rulers for the predicted pose, find the edges, solve a robust pose
from 64 start candidates and 12 iterations, and return the pose and covariance of the camera. Numba uses all cores for
the rulers; `FeatureSet.bind` runs in the calling thread where the device has inline queues.

The metadata of a row have the 50th and the 99th percentile of the time of a call, in microseconds, of 2000 calls. Calls
with the frame behind a lens (``lens_p50_us``) alternate with the calls without.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.matching.robust import sample_subsets
from gpuvision.profiling import ruler as of_ruler
from gpuvision.profiling import ruler_peers
from gpuvision.profiling.harness import Case, Peer
from gpuvision.profiling.line_fit import STEPS, TRIALS
from gpuvision.profiling.pose import fit_flops, fit_pose, numpy_pose

SIZES = (128, 192, 256)
RULERS, PIXEL, NOISE = 60, 10e-6, 2.0
MOTION = np.array([17e-6, -12e-6, 0.003])  # of the camera, from the predicted to the true pose [m, m, rad]
PREDICTED = np.array([20e-3, 30e-3, 0.0])
_CALLS = 2000
_SAMPLING_PX = np.float32(0.02)
_HALF, _ONE = np.float32(0.5), np.float32(1.0)


def scene(size: int, lens: Lens | None = None) -> tuple[NDArray[np.uint8], FeatureSet]:
    """Return a frame of a bright square at the true pose, through a lens, and rulers across its sides."""
    half = 0.235 * size * PIXEL
    normal = np.repeat([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)], RULERS // 4, axis=0)
    along = np.tile(np.linspace(-0.6 * half, 0.6 * half, RULERS // 4), 4)[:, None]
    placement = PREDICTED[:2]
    point = placement + half * normal + along * normal[:, ::-1] * (-1, 1)
    middle = (size - 1) / 2
    pixels = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).astype(np.float64)
    column, row = ((pixels if lens is None else lens.undistort(pixels)) - middle).transpose(2, 0, 1)
    x, y, theta = PREDICTED + MOTION
    c, s = np.cos(theta), np.sin(theta)
    seen = np.stack([column * c + row * s, column * s - row * c], axis=-1) * PIXEL + (x, y) - placement
    inside = (half - np.abs(seen).max(axis=-1)) / PIXEL
    image = 100.0 + 50.0 * np.tanh(inside / 1.2) + np.random.default_rng(3).normal(0.0, NOISE, (size, size))
    features = FeatureSet(
        side="top",
        placement=placement,
        point=point,
        normal=normal,
        spacing=np.zeros(RULERS),
        length=np.full(RULERS, ruler_peers.LENGTH * PIXEL),
        sigma=np.full(RULERS, 0.1 * PIXEL),
        imaging=Imaging(pixel=PIXEL, smoothing_ratio=of_ruler.SMOOTHING, width_px=ruler_peers.WIDTH),
        covariance=np.eye(3),
        condition=1.0,
        region=np.stack([placement - size / 2 * PIXEL, placement + size / 2 * PIXEL]),
    )
    return np.rint(np.clip(image, 0, 255)).astype(np.uint8), features


@numba.njit(error_model="numpy", fastmath={"contract"})
def _place(point, normal, pose, centre, placed):
    """Place rulers where a camera at a pose sees points relative to its predicted centre [m]."""
    c, s = np.float32(np.cos(pose[2])), np.float32(np.sin(pose[2]))
    per = np.float32(1.0 / PIXEL)
    for i in range(point.shape[0]):
        placed[i, 0] = centre + (c * point[i, 0] + s * point[i, 1]) * per
        placed[i, 1] = centre + (s * point[i, 0] - c * point[i, 1]) * per
        placed[i, 2] = c * normal[i, 0] + s * normal[i, 1]
        placed[i, 3] = s * normal[i, 0] - c * normal[i, 1]


@numba.njit(error_model="numpy")
def _camera(expected, board, pose):
    """Change the motion of the board at the predicted image centre into the pose of the camera."""
    c, s = np.cos(board[2]), np.sin(board[2])
    pose[0] = expected[0] - c * board[0] - s * board[1]
    pose[1] = expected[1] + s * board[0] - c * board[1]
    pose[2] = expected[2] - board[2]


@functools.cache
def _estimators() -> dict[str, Any]:
    """Return the expert's Numba functions for `RULERS` rulers by name, compiled once for frames of all sizes."""
    return {name: _estimator(measure) for name, measure in ruler_peers.expert_forms(RULERS).items()}


def _estimator(measure: Any) -> Any:
    """Return a Numba function that computes the pose of the camera in one call; `measure` measures the rulers."""

    @numba.njit(error_model="numpy")
    def estimate(frame, views, pose, point, normal, taps, numbers, starts, work):
        placed, edges, status, rows, origin, board, covariance, found = work
        views.image[:] = frame
        _place(point, normal, pose, np.float32(_HALF * (frame.shape[1] - 1)), placed)
        measure(views.image, views.pixels, views.pairs, views.packed, placed, taps, numbers, edges, status)
        pixel = np.float32(PIXEL)
        for i in range(placed.shape[0]):
            sigma = edges[3, i] * np.exp(_HALF / (edges[2, i] * edges[2, i] + numbers[1]))
            moved = edges[0, i] * pixel if status[i] == 0 else np.float32(0.0)
            rows[0, i], rows[1, i] = normal[i, 0], normal[i, 1]
            rows[2, i], rows[3, i] = point[i, 0], point[i, 1]
            rows[4, i], rows[5, i] = normal[i, 0] * moved, normal[i, 1] * moved
            certainty = _ONE / (np.sqrt(sigma * sigma + _SAMPLING_PX * _SAMPLING_PX) * pixel)
            rows[6, i] = certainty if status[i] == 0 else np.float32(0.0)
        fit_pose(rows, starts, origin, board, covariance)
        _camera(pose, board, found)

    return estimate


# Operations in kernels/feature_pose of a ruler: its place and direction in the frame 14, the row of its edge 12.
_ROW = 26


def pose_flops(starts: int) -> int:
    """Return the operations of a pose of a camera: rulers, and the pose from starts."""
    ruler = of_ruler.ruler_flops(ruler_peers.LENGTH, ruler_peers.WIDTH, ruler_peers.REACH)
    return RULERS * (ruler + _ROW) + fit_flops(RULERS, starts)


class _Numpy:
    """Pose by NumPy, with samples from OpenCV's remap."""

    def __init__(self, features: FeatureSet, noise: float, size: int) -> None:
        self.point, self.normal = features.point - features.placement, features.normal
        self.noise, self.centre = noise, (size - 1) / 2
        self.matrix, self.starts = of_ruler._gradient_matrix(np.float32), sample_subsets(RULERS, 3, TRIALS)

    def __call__(self, frame: NDArray[Any], pose: NDArray[Any]) -> NDArray[Any]:
        image = frame.copy()
        c, s = np.cos(pose[2]), np.sin(pose[2])
        linear = np.array([[c, s], [s, -c]])
        placed = np.concatenate([self.centre + self.point @ linear.T / PIXEL, self.normal @ linear.T], axis=1)
        position, _, width, sigma, dark = of_ruler._opencv(image, placed.astype(np.float32), self.matrix)
        sigma = sigma * np.exp(0.5 / (width * width + of_ruler._VARIANCE)) * self.noise
        certainty = np.where(dark, 0.0, 1.0 / (np.hypot(sigma, _SAMPLING_PX) * PIXEL))
        moved = self.normal * (np.where(dark, 0.0, position) * PIXEL)[:, None]
        rows = np.column_stack([self.normal, self.point, moved, certainty])
        board, _ = numpy_pose(rows, self.starts, (0.0, 0.0))
        c, s = np.cos(board[2]), np.sin(board[2])
        turned = np.array([c * board[0] + s * board[1], c * board[1] - s * board[0], board[2]])
        return np.asarray(pose - turned)


def cases(device: Device) -> Iterator[Case]:
    """Yield the pose from a region of each size."""
    for size in SIZES:
        yield _case(device, size)


def _case(device: Device, size: int) -> Case:
    frame, features = scene(size)
    solver = SolvePose(max_trials=TRIALS, max_iterations=STEPS)
    levels: dict[str, Any] = {"threshold": of_ruler.THRESHOLD, "noise": NOISE}
    options: dict[str, Any] = levels | {"copper": "bright", "etch_bias_sigma": 0.0, "solver": solver}
    bound = features.bind(device, frame.shape, np.uint8, **options)
    # A distortion of 3 % of the distance at a corner.
    lens = Lens(k1=0.06 / size**2, centre=((size - 1) / 2, (size - 1) / 2))
    distorted, _ = scene(size, lens)
    behind_lens = features.bind(device, frame.shape, np.uint8, model=lens, **options)
    noise = bound.operation.ruler._packed(frame.dtype)[2]
    by_numpy = _Numpy(features, float(noise) / ruler_peers.WIDTH, size)
    views, found = ruler_peers.Frame.of(np.empty_like(frame)), np.empty(3)
    numbers = np.array([of_ruler._LEAST * ruler_peers.WIDTH, of_ruler._VARIANCE, noise], np.float32)
    point, normal = ((features.point - features.placement).astype(np.float32), features.normal.astype(np.float32))
    single = [np.empty(shape, np.float32) for shape in ((RULERS, 4), (4, RULERS), (7, RULERS), 2, 3, (3, 3))]
    placed, edges, rows, origin, board, covariance = single
    origin[:] = 0.0
    work = (placed, edges, np.empty(RULERS, np.uint8), rows, origin, board, covariance, found)
    taps, starts = of_ruler._TAPS.astype(np.float32), by_numpy.starts

    forms: dict[str, Callable[[], object]] = {}
    poses: dict[str, NDArray[Any]] = {}
    for name, estimate in _estimators().items():
        forms[name] = functools.partial(estimate, frame, views, PREDICTED, point, normal, taps, numbers, starts, work)
        forms[name]()
        poses[f"numba {name}"] = found.copy()

    def ours() -> object:
        return bound(frame, PREDICTED)

    def ours_behind_lens() -> object:
        return behind_lens(distorted, PREDICTED)

    result, true = bound(frame, PREDICTED), PREDICTED + MOTION
    sigma = np.sqrt(np.diag(np.asarray(result.covariance)))
    of_ours = np.array(result.pose)
    of_lens = np.array(behind_lens(distorted, PREDICTED).pose)
    of_numpy = by_numpy(frame, PREDICTED)
    for name, each in (("gpuvision", of_ours), ("lens", of_lens), *poses.items(), ("numpy", of_numpy)):
        if np.any(np.abs(each - true) > 6.0 * sigma):
            raise AssertionError(f"the pose of {name} differs from the truth: {each - true}, sigmas {sigma}")
    peers: dict[str, Peer] = {"numpy": lambda: by_numpy(frame, PREDICTED), "numba": forms}
    metadata: dict[str, float] = {}
    for names, calls in ((("", "lens_"), (ours, ours_behind_lens)), (("numba_",), (forms["pairs-serial"],))):
        for name, (p50, p99) in zip(names, percentiles(*calls), strict=True):
            metadata |= {f"{name}p50_us": p50, f"{name}p99_us": p99}
    error = float(np.max(np.abs(of_ours[:2] - true[:2])))
    metadata |= {"sigma_m": float(sigma[0])}
    # The frame is copied to the device, the rulers are not.
    traffic = (frame.nbytes, sum(np.asarray(each).nbytes for each in result))
    flops = pose_flops(len(starts))
    return Case("servo", str(size), ours, peers, error, traffic, metadata=metadata, flops=flops, copied=False)


def percentiles(*calls: Callable[[], object]) -> list[tuple[float, float]]:
    """Return the 50th and 99th percentile of the time of each call in a sequence of alternating calls [us]."""
    times = np.empty((_CALLS, len(calls)))
    for row in times:
        for number, call in enumerate(calls):
            begun = time.perf_counter()
            call()
            row[number] = time.perf_counter() - begun
    return [(float(p50), float(p99)) for p50, p99 in 1e6 * np.percentile(times, (50, 99), axis=0).T]
