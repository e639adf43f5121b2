"""Steps of the pose fit (kernels/pose): equations, composed poses, eigenvalues; each against its definition in float64.

A wrong derivative or a wrong step costs the fit more iterations, and its result stays.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigvalsh

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER

Reals = NDArray[np.float64]
SOURCE = """
#include "pose/pose_matrix.h"
#include "pose/pose_equation.h"
#define PUT(value) out[to++] = (value)

kernel void pose_steps(global const real *given, global real *made) {
    const size_t n = get_global_id(0);
    global const real *at = given + 24 * n;
    global real *out = made + 64 * n;
    const laned_pose pose = {at[0], at[1], at[2], at[3], at[4], at[5], at[6]};
    const laned_row row = {at[7], at[8], at[9], at[10], at[11], at[12], at[13], at[14]};
    int to = 0;
    const pose_equation equation = equation_of(pose, row);
    PUT(equation.residual);
    for (int k = 0; k < FREEDOMS; k++) PUT(equation.row[k]);
    real step[FREEDOMS], matrix[TRIANGLE], right[FREEDOMS];
    for (int k = 0; k < FREEDOMS; k++) step[k] = at[15 + k];
    const laned_pose next = pose_after(pose, step);
    PUT(next.dxx), PUT(next.dxy), PUT(next.dyx), PUT(next.dyy), PUT(next.x), PUT(next.y), PUT(next.etch);
    for (int k = 0; k < TRIANGLE; k++) matrix[k] = k;
    for (int k = 0; k < FREEDOMS; k++) right[k] = -k;
    add_equation(equation, at[13], 0.5f * at[13], matrix, right);
    add_etch(pose, at[22], matrix, right);
    for (int k = 0; k < TRIANGLE; k++) PUT(matrix[k]);
    for (int k = 0; k < FREEDOMS; k++) PUT(right[k]);
}

kernel void matrices(global const real *inliers, global const real *all, global real *made, const real tolerance) {
    const size_t n = get_global_id(0);
    real of_inliers[TRIANGLE], of_all[TRIANGLE], least, largest;
    for (int k = 0; k < TRIANGLE; k++) of_inliers[k] = inliers[n * TRIANGLE + k], of_all[k] = all[n * TRIANGLE + k];
    const pose_matrix one = pose_part(of_inliers), other = pose_part(of_all);
    made[4 * n] = eigenvalues(one, tolerance, &least, &largest);
    made[4 * n + 1] = least;
    made[4 * n + 2] = largest;
    made[4 * n + 3] = least_inlier_fraction(one, other);
}
"""
TRANSFORMS = pytest.mark.parametrize(("parameters", "has_etch"), [(3, False), (4, True), (6, True), (6, False)])


def program_of(device: Device, folder: Path, parameters: int, has_etch: bool) -> Any:
    (folder / "steps.cl").write_text(SOURCE)
    defines = {"POSE_PARAMETERS": parameters, "FREEDOMS": parameters + has_etch}
    defines |= {"WITH_ETCH_BIAS": None} if has_etch else {}
    return build(device, folder, "steps.cl", defines, include_folders=(KERNEL_FOLDER,))


def run(device: Device, kernel: Any, count: int, *arguments: Any) -> Reals:
    """Return the last of the arrays after the kernel."""
    given = [cl.array.to_device(device.queue, each) if isinstance(each, np.ndarray) else each for each in arguments]
    kernel(device.queue, (count,), None, *(each.data if isinstance(each, cl.array.Array) else each for each in given))
    arrays = [each for each in given if isinstance(each, cl.array.Array)]
    return np.asarray(arrays[-1].get(), np.float64)


def stretch_of(step: Reals, parameters: int) -> Reals:
    """Return the matrix of the scales and the shear of a step."""
    if parameters == 3:
        return np.eye(2)
    return np.eye(2) + ([[step[3], step[5]], [0.0, step[4]]] if parameters == 6 else step[3] * np.eye(2))


def stepped(matrix: Reals, shift: Reals, step: Reals, parameters: int) -> tuple[Reals, Reals]:
    """Return the pose after a step: it is turned by the angle whose tangent the step has, and then stretched."""
    cosine = 1.0 / np.hypot(1.0, step[2])
    turn = cosine * np.array([[1.0, -step[2]], [step[2], 1.0]])
    return matrix @ turn @ stretch_of(step, parameters), shift + matrix @ step[:2]


def residual(matrix: Reals, shift: Reals, row: Reals, etch: float) -> float:
    """Return n (T^-1(p + e) - p) - g etch."""
    normal, point, away, factor = row[:2], row[2:4], row[4:6], row[7]
    return float(normal @ (np.linalg.solve(matrix, point + away - shift) - point) - factor * etch)


@TRANSFORMS
def test_equations_and_steps(
    device: Device, parameters: int, has_etch: bool, rng: np.random.Generator, tmp_path: Path
) -> None:
    count, freedoms = 30, parameters + has_etch
    given = rng.normal(0.0, 0.2, (count, 24)).astype(np.float32)
    given[:, 7:11] = rng.normal(0.0, 1.0, (count, 4))
    kernel = program_of(device, tmp_path, parameters, has_etch).pose_steps
    made = run(device, kernel, count, given, np.zeros((count, 64), np.float32))
    for numbers, out in zip(given.astype(np.float64), made, strict=True):
        matrix, shift = np.eye(2) + numbers[:4].reshape(2, 2), numbers[4:6]
        etch, row, step = numbers[6] if has_etch else 0.0, numbers[7:15], numbers[15:22]
        # Without the etch bias the kernel's pose has one of 0.
        row = row.copy()
        off = residual(matrix, shift, row, numbers[6])
        slopes = []
        for k in range(freedoms):
            ends = []
            for sign in (1.0, -1.0):
                move = np.zeros(7)
                move[k] = 1e-5 * sign
                now = etch + move[k] if k == parameters else numbers[6]
                ends.append(
                    residual(*stepped(matrix, shift, move, parameters), row, now)
                    if k != parameters
                    else residual(matrix, shift, row, now)
                )
            slopes.append((ends[1] - ends[0]) / 2e-5)
        np.testing.assert_allclose(out[: 1 + freedoms], [off, *slopes], rtol=1e-4, atol=1e-4)
        after, moved = stepped(matrix, shift, step, parameters)
        grown = etch + step[parameters] if has_etch else 0.0
        np.testing.assert_allclose(
            out[1 + freedoms : 8 + freedoms], [*(after - np.eye(2)).ravel(), *moved, grown], rtol=1e-5, atol=1e-6
        )
        lower = np.tril_indices(freedoms)
        size = len(lower[0])
        normal = row[6] * np.outer(slopes, slopes)
        prior = np.diag([0.0] * parameters + [numbers[22] ** 2] * has_etch)
        right = 0.5 * row[6] * off * np.array(slopes) - np.arange(freedoms)
        right[parameters:] -= numbers[22] ** 2 * etch
        start = 8 + freedoms
        np.testing.assert_allclose(
            out[start : start + size], np.arange(size) + (normal + prior)[lower], rtol=1e-4, atol=2e-4
        )
        np.testing.assert_allclose(out[start + size : start + size + freedoms], right, rtol=1e-4, atol=2e-4)


@TRANSFORMS
def test_eigenvalues_and_share_of_the_inliers(
    device: Device, parameters: int, has_etch: bool, rng: np.random.Generator, tmp_path: Path
) -> None:
    """The etch bias is eliminated; a matrix of lower rank has no share; the rank counts eigenvalues over a limit."""
    count, freedoms, tolerance = 120, parameters + has_etch, 2.0**-6
    lower = np.tril_indices(freedoms)
    rows = rng.normal(size=(count, 12, freedoms)) * np.geomspace(0.2, 2.0, freedoms)
    used = rng.random((count, 12, 1)) < 0.75
    every, inliers = (np.einsum("nri,nrj->nij", each, each) for each in (rows, rows * used))
    inliers += 1e-3 * np.eye(freedoms)
    every += 1e-3 * np.eye(freedoms)
    # A parameter without information; eigenvalues of a diagonal matrix, one of them exactly at the limit of the rank.
    every[0, 0], every[0, :, 0] = 0.0, 0.0
    inliers[1] = np.diag([tolerance, *np.linspace(0.5, 1.0, parameters - 1), *([0.75] * has_etch)])
    given = [np.ascontiguousarray(each[:, *lower], np.float32) for each in (inliers, every)]
    kernel = program_of(device, tmp_path, parameters, has_etch).matrices
    made = run(device, kernel, count, *given, np.zeros((count, 4), np.float32), np.float32(tolerance))

    def part(matrix: Reals) -> Reals:
        return np.linalg.inv(np.linalg.inv(matrix)[:parameters, :parameters]) if has_etch else matrix

    ranks = set()
    for number, (one, other, out) in enumerate(zip(inliers, every, made, strict=True)):
        values = np.linalg.eigvalsh(part(one))
        np.testing.assert_allclose(out[1:3], values[[0, -1]], rtol=2e-4, atol=2e-5 * values[-1])
        share = 0.0 if number == 0 else eigvalsh(part(one), part(other))[0]
        assert out[3] == pytest.approx(share, rel=5e-3, abs=1e-4)
        rank = np.sum(values > tolerance * values[-1])
        if number == 1:
            assert out[0] == parameters - 1
        elif np.min(np.abs(values / values[-1] - tolerance)) > 1e-4:
            assert out[0] == rank
        ranks.add(rank)
    assert len(ranks) > 1
