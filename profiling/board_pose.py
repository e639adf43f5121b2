"""Fused board pose, compared with the same method in NumPy and OpenCV, and in one fused Numba function.

A hundred calipers (rulers) of 64 samples and 5 lines, ten across each of ten edges of the artwork, in an 8-bit frame of
640 x 480: edge positions, a robust line through the edge points of each artwork edge, a robust pose from the lines, and
its covariance at the placement point. One line is displaced, and every tenth ruler crosses a spot brighter than its
edge.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.board_pose import BoardPoseEstimator, place_rulers
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.matching.robust import sample_subsets
from gpuvision.profiling import pose as of_pose
from gpuvision.profiling import pose_lanes, ruler_peers
from gpuvision.profiling import ruler as of_ruler
from gpuvision.profiling.harness import Case, Peer, traffic_of
from gpuvision.profiling.line_fit import EFFICIENCY, STEPS, TRIALS, fit_line
from gpuvision.profiling.line_fit import fit_flops as line_flops
from gpuvision.profiling.pose import PLACEMENT, fit_pose, numpy_pose, tukey_root

LINES, EACH = 10, 10
PIXEL, PATCH = 10e-6, 160  # m, px
TRUE_POSE = np.array([3e-5, -2e-5, 0.004])
_PLACE = np.array(PLACEMENT, np.float32)
_ZERO, _HALF, _ONE, _TWO = (np.float32(each) for each in (0.0, 0.5, 1.0, 2.0))
_SUMS = {"contract", "reassoc"}


def scene() -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """Return a frame, and rulers and lines of `BoardPoseEstimator`; every edge has a separate patch of the frame."""
    rng = np.random.default_rng(11)
    columns, rows = of_ruler.COLUMNS // PATCH, of_ruler.ROWS // PATCH
    matrix = np.array([[1.0 / PIXEL, 0.0, 320.0], [0.0, -1.0 / PIXEL, 240.0], [2.0, 1.0, 1.0]])
    angle = rng.permutation(np.arange(LINES)) * np.pi / LINES
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    middle = [((i % columns + 0.5) * PATCH, (i // columns + 0.5) * PATCH) for i in range(LINES)]
    back = np.linalg.inv(matrix)
    point = np.column_stack([middle, np.ones(LINES)]) @ back.T
    point = point[:, :2] / point[:, 2:]
    along = np.tile(np.linspace(-30.0, 30.0, EACH) * PIXEL, (LINES, 1))
    rulers, lines = place_rulers(normal, point, along, matrix)
    row, column = np.mgrid[: of_ruler.ROWS, : of_ruler.COLUMNS]
    seen = np.stack([column, row, np.ones_like(row)], axis=-1) @ back.T
    seen = seen[..., :2] / seen[..., 2:] - TRUE_POSE[:2]
    cosine, sine = np.cos(TRUE_POSE[2]), np.sin(TRUE_POSE[2])
    seen = seen @ np.array([[cosine, -sine], [sine, cosine]])
    which = np.minimum(row // PATCH, rows - 1) * columns + column // PATCH
    image = np.full(row.shape, 100.0)
    for number in range(LINES):
        away = (seen - point[number]) @ normal[number] / PIXEL - (9.0 if number == 4 else 0.0)
        image = np.where(which == number, 100.0 + 40.0 * np.tanh(away / 1.5), image)
    for x, y in rulers.reshape(-1, rulers.shape[-1])[::10, :2]:
        image[np.hypot(column - x - 8.0, row - y - 8.0) < 5.0] = 240.0
    image += rng.normal(0.0, 2.0, image.shape)
    return np.rint(np.clip(image, 0, 255)).astype(np.uint8), rulers, lines


# ---- Numba ---------------------------------------------------------------------------------------------------------


def _fused_form(measure: Any, *, parallel: bool) -> Any:
    """Return a Numba function that computes the board pose in one call.

    `measure` measures the edges along all rulers; under `parallel` the lines are fitted on all cores.
    """

    @numba.njit(parallel=parallel, error_model="numpy", fastmath=_SUMS)
    def fused(
        image,
        pixels,
        adjacent,
        packed,
        plain,
        rulers,
        lines,
        taps,
        numbers,
        pairs,
        starts,
        edges,
        status,
        pose,
        covariance,
    ):
        measure(image, pixels, adjacent, packed, plain, taps, numbers, edges, status)
        count = lines.shape[0]
        rows = np.empty((7, 2 * count), np.float32)
        for i in numba.prange(count):
            u, v, w = np.empty(EACH, np.float32), np.empty(EACH, np.float32), np.empty(EACH, np.float32)
            for k in range(EACH):
                at = i * EACH + k
                found, s = status[at] == 0, edges[0, at]
                per = _ONE / (_ONE + s * rulers[at, 8])
                a, b = (rulers[at, 4] + s * rulers[at, 6]) * per, (rulers[at, 5] + s * rulers[at, 7]) * per
                u[k] = a if found else _ZERO
                v[k] = b if found else _ZERO
                sigma = edges[3, at] * np.exp(_HALF / (edges[2, at] * edges[2, at] + numbers[1]))
                across = abs(rulers[at, 7] - b * rulers[at, 8]) * per * sigma
                w[k] = _ONE / across if found else _ZERO
            x, y, c, s, of_offset, of_angle = fit_line(u, v, w, pairs)
            reach = np.sqrt(of_offset / of_angle)
            for side in range(2):
                offset = reach if side else -reach
                on, off, at = x + offset * c, y + offset * s, 2 * i + side
                rows[0, at], rows[1, at] = lines[i, 0], lines[i, 1]
                rows[2, at], rows[3, at] = lines[i, 2] + on * lines[i, 1], lines[i, 3] - on * lines[i, 0]
                rows[4, at], rows[5, at] = off * lines[i, 0], off * lines[i, 1]
                rows[6, at] = _ONE / np.sqrt(_TWO * of_offset + lines[i, 4] * lines[i, 4])
        fit_pose(rows, starts, _PLACE, pose, covariance)

    return fused


# ---- NumPy and OpenCV ----------------------------------------------------------------------------------------------


def _numpy_lines(u: NDArray[Any], v: NDArray[Any], w: NDArray[Any], pairs: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Fit all lines at once; the arrays have the shape (lines, rulers per line)."""
    i, j = pairs.T
    x, y = u[:, j] - u[:, i], v[:, j] - v[:, i]
    per = 1.0 / np.hypot(x, y)
    c, s = (x * per)[..., None], (y * per)[..., None]
    z = (c * (v[:, None] - v[:, i, None]) - s * (u[:, None] - u[:, i, None])) * w[:, None]
    loss = np.sum(1.0 - tukey_root(z) ** 3, axis=-1)
    best = np.argmin(np.where(w[:, i] * w[:, j] > 0, loss, np.inf), axis=1)
    each = np.arange(len(u))
    x, y, c, s = u[each, i[best]], v[each, i[best]], c[each, best, 0], s[each, best, 0]
    for _ in range(STEPS):
        dx, dy = u - x[:, None], v - y[:, None]
        a, b = c[:, None] * dx + s[:, None] * dy, c[:, None] * dy - s[:, None] * dx
        weight = (w * tukey_root(b * w)) ** 2
        sw, su, sv = weight.sum(1), (weight * a).sum(1), (weight * b).sum(1)
        mean_a, mean_b = su / sw, sv / sw
        across = 2.0 * ((weight * a * b).sum(1) - su * mean_b)
        along = (weight * (a * a - b * b)).sum(1) - su * mean_a + sv * mean_b
        turn = 0.5 * np.arctan2(across, along)
        x, y = x + c * mean_a - s * mean_b, y + s * mean_a + c * mean_b
        c, s = c * np.cos(turn) - s * np.sin(turn), s * np.cos(turn) + c * np.sin(turn)
    dx, dy = u - x[:, None], v - y[:, None]
    weight = w * w * (tukey_root((c[:, None] * dy - s[:, None] * dx) * w) > 0)
    a = c[:, None] * dx + s[:, None] * dy
    return x, y, c, s, 1.0 / (EFFICIENCY * weight.sum(1)), 1.0 / (EFFICIENCY * (weight * a * a).sum(1))


class _Numpy:
    """Board poses by NumPy, with samples from OpenCV's remap."""

    def __init__(self, image: NDArray[Any], rulers: NDArray[Any], lines: NDArray[Any], noise: float) -> None:
        self.image, self.lines, self.noise = image, lines.astype(np.float64), noise
        self.plain, self.rulers = np.ascontiguousarray(rulers[..., :4].reshape(-1, 4)), rulers.astype(np.float64)
        self.matrix = of_ruler._gradient_matrix(np.float32)
        self.pairs, self.starts = sample_subsets(EACH, 2, TRIALS), sample_subsets(2 * LINES, 3, TRIALS)

    def __call__(self) -> tuple[NDArray[Any], NDArray[Any]]:
        return self._pose(of_ruler._opencv(self.image, self.plain, self.matrix))

    def exact(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the pose from samples in double; OpenCV rounds samples to whole grey levels."""
        matrix = of_ruler._gradient_matrix(np.float64)
        return self._pose(of_ruler._numpy(self.image, self.plain.astype(np.float64), matrix))

    def _pose(self, found: tuple[NDArray[Any], ...]) -> tuple[NDArray[Any], NDArray[Any]]:
        position, width, sigma, dark = (found[i].reshape(LINES, EACH).astype(np.float64) for i in (0, 2, 3, 4))
        sigma = sigma * np.exp(0.5 / (width * width + of_ruler._VARIANCE))
        *_, u0, v0, du, dv, projective = np.moveaxis(self.rulers, -1, 0)
        per = 1.0 / (1.0 + position * projective)
        u, v = (u0 + position * du) * per, (v0 + position * dv) * per
        w = np.where(dark > 0, 0.0, 1.0 / (np.abs(dv - v * projective) * per * sigma * self.noise))
        x, y, c, s, of_offset, of_angle = _numpy_lines(u, v, w, self.pairs)
        reach = np.sqrt(of_offset / of_angle)[:, None] * [-1.0, 1.0]
        on, off = x[:, None] + reach * c[:, None], y[:, None] + reach * s[:, None]
        nx, ny, px, py, of = (np.repeat(each[:, None], 2, axis=1) for each in self.lines.T[:5])
        certainty = 1.0 / np.sqrt(2.0 * of_offset[:, None] + of**2)
        rows = np.stack([nx, ny, px + on * ny, py - on * nx, off * nx, off * ny, certainty], axis=-1)
        return numpy_pose(rows.reshape(-1, 7), self.starts, PLACEMENT)


def cases(device: Device) -> Iterator[Case]:
    """Yield the fused board pose from a hundred rulers, and the cases of the pose alone."""
    yield _fused_pose(device)
    yield from of_pose.cases(device)


def _fused_pose(device: Device) -> Case:
    image, rulers, lines = scene()
    edges = RulerEdges(
        threshold=of_ruler.THRESHOLD,
        length=ruler_peers.LENGTH,
        width=ruler_peers.WIDTH,
        smoothing_px=of_ruler.SMOOTHING,
        noise=2.0,
    )
    solver = SolvePose(placement=PLACEMENT, max_trials=TRIALS, max_iterations=STEPS)
    bound = BoardPoseEstimator(ruler=edges, lines=LINES, rulers_per_line=EACH, solver=solver).bind(
        device, image.shape, image.dtype
    )
    inputs: tuple[NDArray[Any], ...] = (image, rulers, lines)
    for array, values in zip(bound.inputs, inputs, strict=True):
        array.set(values)
    bound.run()
    result = bound.outputs
    noise = edges._packed(image.dtype)[2]
    by_numpy = _Numpy(image, rulers, lines, float(noise) / ruler_peers.WIDTH)
    flat, plain = rulers.reshape(-1, rulers.shape[-1]), by_numpy.plain
    numbers = np.array([of_ruler._LEAST * ruler_peers.WIDTH, of_ruler._VARIANCE, noise], np.float32)
    taps = of_ruler._TAPS.astype(np.float32)
    found, status = np.empty((4, len(flat)), np.float32), np.empty(len(flat), np.uint8)
    pose, covariance = np.empty(3, np.float32), np.empty((3, 3), np.float32)

    given = (*ruler_peers.Frame.of(image), plain, flat, lines, taps, numbers, by_numpy.pairs, by_numpy.starts)
    forms: dict[str, Callable[[], object]] = {}
    results = []
    for name, measure in ruler_peers.expert_forms(len(flat)).items():
        fused = _fused_form(measure, parallel=not name.endswith("-serial"))
        forms[name] = functools.partial(fused, *given, found, status, pose, covariance)
        fused = pose_lanes.fused_form(measure, LINES, EACH, TRIALS)
        forms[f"{name}-lanes"] = functools.partial(fused, *given, found, status, pose, covariance, _PLACE)
    for name, form in forms.items():
        found[...], status[...], pose[...], covariance[...] = np.nan, 255, np.nan, np.nan
        form()
        results.append((f"numba {name}", pose.copy(), covariance.copy()))
    (exact, exact_covariance), (rounded, _) = by_numpy.exact(), by_numpy()
    ours = np.array([*to_numpy(result.placement), to_numpy(result.pose)[2]])
    sigma = np.sqrt(np.diag(exact_covariance))
    of_ours = to_numpy(result.covariance)
    for name, each, of in (
        ("gpuvision", ours, of_ours),
        *results,
        ("numpy", rounded, exact_covariance),
    ):
        if np.any(np.abs(each - exact) > 0.5 * sigma) or np.any(np.abs(np.sqrt(np.diag(of)) / sigma - 1.0) > 0.1):
            raise AssertionError(
                f"the pose of {name} differs from that in double: {each} and {exact}, standard deviations {sigma}"
            )
    taken = of_ruler.frame_bytes(image, len(flat) * ruler_peers.LENGTH * ruler_peers.WIDTH)
    traffic = (taken + rulers.nbytes + lines.nbytes, traffic_of(bound)[1])
    metadata = {"p50_us": _median(bound.run) * 1e6, "sigma_m": float(sigma[0])}
    metadata["numba_error"] = max(_worst(each, exact) for _, each, _ in results)
    metadata["numpy_error"] = _worst(rounded, exact)
    peers: dict[str, Peer] = {"numpy": by_numpy, "numba": forms}
    return Case(
        "pose",
        "local-fix",
        bound.run,
        peers,
        _worst(ours, exact),
        traffic,
        metadata=metadata,
        flops=pose_flops(len(by_numpy.pairs), len(by_numpy.starts)),
        copied=False,
    )


# Operations in kernels/board_pose: of an edge its place in the frame of its line 9, sigma 4, certainty 1; of a line two
# rows, each 16.
_EDGE, _LINE = 14, 32


def pose_flops(pairs: int, starts: int) -> int:
    """Return the operations of a board pose: edges, lines from pairs of edges, the pose from starts."""
    edge = _EDGE + of_ruler.ruler_flops(ruler_peers.LENGTH, ruler_peers.WIDTH, ruler_peers.REACH)
    of_lines = LINES * (EACH * edge + line_flops(EACH, pairs) + _LINE)
    return of_lines + of_pose.fit_flops(2 * LINES, starts)


def _worst(pose: NDArray[Any], exact: NDArray[Any]) -> float:
    """Return the largest error of the placement point [m]."""
    return float(np.max(np.abs(pose[:2] - exact[:2])))


def _median(call: Callable[[], object]) -> float:
    """Return the median time of a call in a sequence of calls [s]."""
    times = []
    for _ in range(300):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))
