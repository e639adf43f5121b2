"""Light of lit lines on surfaces, all pairs without occlusion, compared with the same closed form in Numba.

The peer `numba` is branch-free and vectorised by LLVM over receivers, with a polynomial arc tangent, in single
precision. `numba-plain` is a loop over receivers and segments with the arc tangent of the library. `error` and
`peer_error` are relative to the largest irradiance of the case (NaN on a device without double).

``wall``: lines that run into a wall; all pairs face each other. ``board``: patches of boxes on a board. In both cases
the segments have few directions and surfaces, as on flat faces; our kernel exploits this. In ``closed-form-slopes``
each line lies on a different slope: the worst case for our kernel, without an effect on the peer.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling import adaptive_shadow_rays as adaptive
from gpuvision.profiling import occluded_irradiance, patches
from gpuvision.profiling.harness import Case
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments

_BLOCK = 512
# Largest difference of the two Numba loops over the largest irradiance: single precision, sums of up to 64 segments.
_AGREEMENT = 1e-5
F = np.float32
ZERO, HALF, ONE, QUARTER, TURN, TINY = F(0.0), F(0.5), F(1.0), F(np.pi / 2.0), F(np.pi), F(1e-24)
# Minimax polynomial in z^2 of atan(z) / z on [0, 1]; largest error 1.6e-8.
A0, A1, A2, A3, A4 = F(-0.333333317), F(0.199997393), F(-0.142785687), F(0.110337641), F(-0.086568804)
A5, A6, A7, A8 = F(0.062501694), F(-0.035871539), F(0.013507771), F(-0.002386997)


@numba.njit(parallel=True, error_model="numpy")
def _numba(receivers, table, out):
    """Sum over segments for blocks of receivers. Blocks are transposed and the code is unrolled for LLVM."""
    count = receivers.shape[0]
    for block in numba.prange((count + _BLOCK - 1) // _BLOCK):
        begin = block * _BLOCK
        n = min(_BLOCK, count - begin)
        local = np.empty((6, _BLOCK), np.float32)
        sums = np.zeros(_BLOCK, np.float32)
        for i in range(n):
            for k in range(6):
                local[k, i] = receivers[begin + i, k]
        xs, ys, zs, us, vs, ws = local[0], local[1], local[2], local[3], local[4], local[5]
        for m in range(table.shape[0]):
            px, py, pz, ux, uy, uz = table[m, 0], table[m, 1], table[m, 2], table[m, 3], table[m, 4], table[m, 5]
            lx, ly, lz, length, power = table[m, 6], table[m, 7], table[m, 8], table[m, 9], table[m, 10]
            for i in range(n):
                dx, dy, dz = xs[i] - px, ys[i] - py, zs[i] - pz
                along = dx * ux + dy * uy + dz * uz
                height = dx * lx + dy * ly + dz * lz
                rx, ry, rz = along * ux - dx, along * uy - dy, along * uz - dz
                square = rx * rx + ry * ry + rz * rz + TINY
                a, b = us[i] * rx + vs[i] * ry + ws[i] * rz, us[i] * ux + vs[i] * uy + ws[i] * uz
                cut = -a / b
                low, high = -along, length - along
                low = cut if (b > ZERO) & (cut > low) else low
                high = cut if (b < ZERO) & (cut < high) else high
                step = high - low
                per = ONE / ((low * low + square) * (high * high + square))
                rho = np.sqrt(square)
                sine, cosine = step * rho, square + low * high
                size = -cosine if cosine < ZERO else cosine
                ratio = (size if sine > size else sine) / (sine if sine > size else size)
                w = ratio * ratio
                arc = A0 + w * (A1 + w * (A2 + w * (A3 + w * (A4 + w * (A5 + w * (A6 + w * (A7 + w * A8)))))))
                arc = ratio + ratio * w * arc
                arc = QUARTER - arc if sine > size else arc
                arc = TURN - arc if cosine < ZERO else arc
                value = a * (step * (square - low * high) * per + arc / rho) / square + b * step * (low + high) * per
                seen = (height > ZERO) & (step > ZERO) & ((a > ZERO) | (b != ZERO))
                sums[i] += HALF * height * power * value if seen else ZERO
        out[begin : begin + n] = sums[:n]


# Least operations of a pair in `end_factor` of kernels/line_irradiance/line_irradiance.h, in single precision, for a
# segment in front of the receiver's plane that is seen under an acute angle: distances of the ends from the plane 4,
# square 3, product and sum 2, cosine and flat 2, both and reach 4, tangent 2, sine 1, w 2, wide 1, cube and bracket 2,
# arc_less_sine 10, its product and sum 2, integral 5, height 1. Around it 4: both ends along the line, the exitance and
# the sum. A root counts as 1.
_PAIR_FLOPS = 45


@numba.njit(parallel=True, error_model="numpy")
def _numba_plain(receivers, table, out):
    for i in numba.prange(receivers.shape[0]):
        total = ZERO
        for m in range(table.shape[0]):
            low, high = adaptive.facing_part(receivers[i], table[m])
            if high > low:
                total += adaptive.part_irradiance(receivers[i], table[m], low, high)
        out[i] = total


def cases(device: Device) -> Iterator[Case]:
    """Yield a wall with many and with few lines, a board with boxes, light of patches, and light with occlusion."""
    yield _case(device, *wall(64, 20_000), "closed-form/wall/64x20000")
    yield _case(device, *wall(16, 100_000), "closed-form/wall/16x1e5")
    yield _case(device, *_board(20_000), "closed-form/board/64x20000")
    yield _case(device, *_slopes(64, 20_000), "closed-form-slopes/64x20000")
    yield from patches.cases(device)
    yield from occluded_irradiance.cases(device)


def _case(device: Device, segments: LitSegments, receivers: NDArray[np.float32], name: str) -> Case:
    bound = LineIrradiance(segments=segments).bind(device, receivers.shape, receivers.dtype)
    bound.inputs[0].set(receivers)
    ours = to_numpy(bound.run().irradiance)
    table, out = adaptive.segment_table(segments), np.empty(len(receivers), np.float32)
    plain = np.full_like(out, np.nan)
    _numba(receivers, table, out)
    _numba_plain(receivers, table, plain)
    if not _error(plain, out) < _AGREEMENT:
        raise AssertionError("the plain Numba loop and the expert's loop differ")
    exact = LineIrradiance(segments=segments, precision="double")
    truth = to_numpy(exact(receivers, device=device).irradiance) if device.has_double else np.full(len(out), np.nan)
    pairs = len(segments.exitance) * len(receivers)
    metadata = {"pairs": pairs, "peer_error": _error(out, truth)}
    peers = {
        "numba": lambda: _numba(receivers, table, out),
        "numba-plain": lambda: _numba_plain(receivers, table, out),
    }
    # On a wall all segments face all receivers; on a board pairs behind a surface are left out early.
    whole = name.startswith("closed-form/wall") and bool(np.all(ours > 0.0))
    return Case(
        "reflections",
        name,
        bound.run,
        peers,
        _error(ours, truth),
        traffic=(receivers.nbytes + table.nbytes, 5 * len(receivers)),
        metadata=metadata,
        flops=_PAIR_FLOPS * pairs if whole else None,
    )


def _error(values: NDArray[Any], truth: NDArray[Any]) -> float:
    return float(np.max(np.abs(values - truth)) / np.max(truth))


def wall(segments: int, receivers: int) -> tuple[LitSegments, NDArray[np.float32]]:
    """Return lines on a floor that end at a wall, and receivers on the wall."""
    rng = np.random.default_rng(1)
    ends = np.zeros((segments, 2, 3))
    ends[:, :, 1] = rng.uniform(-0.1, 0.1, segments)[:, None]
    ends[:, 1, 0] = rng.uniform(0.02, 0.2, segments)
    places = np.zeros((receivers, 6), np.float32)
    places[:, 1], places[:, 2] = rng.uniform(-0.1, 0.1, receivers), rng.uniform(1e-3, 0.1, receivers)
    places[:, 3] = 1.0
    return LitSegments(ends, np.tile([0.0, 0.0, 1.0], (segments, 1)), np.ones(segments)), places


def _slopes(segments: int, receivers: int) -> tuple[LitSegments, NDArray[np.float32]]:
    """Return lines on different slopes that face a wall, and receivers on the wall."""
    rng = np.random.default_rng(7)
    start = np.column_stack(
        [rng.uniform(0.01, 0.1, segments), rng.uniform(-0.1, 0.1, segments), np.full(segments, -0.05)]
    )
    across = rng.uniform((0.02, -0.02, -0.02), (0.1, 0.02, 0.02), (segments, 3))
    normals = np.cross(across, np.cross([-0.5, 0.0, 1.0], across))
    ends = np.stack([start, start + across], axis=1)
    return LitSegments(ends, normals, np.ones(segments)), wall(segments, receivers)[1]


def _board(receivers: int) -> tuple[LitSegments, NDArray[np.float32]]:
    """Return lines over boxes and the board between them, and patches on the sides and tops of the boxes."""
    rng = np.random.default_rng(2)
    at = np.linspace(-0.1, 0.1, 33)[:-1]
    ends = np.zeros((64, 2, 3))
    ends[::2, 0, 0], ends[1::2, 0, 0] = at, at + 0.003
    ends[:, 1, 0] = ends[:, 0, 0] + 0.003
    ends[::2, :, 2] = rng.uniform(0.001, 0.01, 32)[:, None]
    normals = np.tile([0.0, 0.0, 1.0], (64, 1))
    faces = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    side = np.repeat(np.arange(receivers // 50 + 1), 50)[:receivers]
    centres = rng.uniform(-0.1, 0.1, (side[-1] + 1, 3)) * [1.0, 0.3, 0.0] + [0.0, 0.0, 0.005]
    facing = faces[side % 5]
    spread = rng.uniform(-0.004, 0.004, (receivers, 3)) * (facing == 0.0)
    return LitSegments(ends, normals, np.ones(64)), np.hstack([centres[side] + spread, facing]).astype(np.float32)
