"""Kernels that solve a problem with a work-group: the result does not depend on the size of the group."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.host import Device, clear_cache, to_numpy
from gpuvision.matching.features import line_fit
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.matching.pose import board_pose, pose
from gpuvision.matching.pose.board_pose import FitBoardLines
from gpuvision.matching.pose.pose import SolvePose

Case = tuple[Any, Any, tuple[np.ndarray, ...]]


def lines(_: Device, rng: np.random.Generator, **options: Any) -> Case:
    """Return a fit of three lines through 137 points each, a third of them gross errors, and one missing."""
    u, v = rng.uniform(-30.0, 30.0, (3, 137)), rng.normal(0.0, 0.05, (3, 137))
    v[:, :45] += 7.0
    points = np.stack([500.0 + 0.8 * u - 0.6 * v, 300.0 + 0.6 * u + 0.8 * v], axis=-1).astype(np.float32)
    points[1, 0] = np.nan
    return line_fit, FitLines(variant="work_item", with_weights=True, **options), (points,)


def poses(_: Device, rng: np.random.Generator, **options: Any) -> Case:
    """Return three poses from 67 edges each, a fifth of them gross errors, and one missing."""
    angle, place = rng.uniform(0.0, 2.0 * np.pi, (3, 67)), rng.uniform(-0.05, 0.05, (3, 67, 2))
    moved = np.array([3e-5, -2e-5]) + 4e-3 * place[..., ::-1] * [-1.0, 1.0] + rng.normal(0.0, 2e-6, place.shape)
    moved[:, :13] += 1e-4
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rows = np.concatenate([normal, place, moved, np.full((3, 67, 1), 2e-6)], axis=-1).astype(np.float32)
    rows[1, 0, 6] = -1.0
    return pose, SolvePose(variant="work_item", **options), (rows,)


def board_lines(_: Device, rng: np.random.Generator, **options: Any) -> Case:
    """Return three lines of a board through 90 edges each, a third of them gross errors, and one missing."""
    u, v = rng.uniform(-3e-3, 3e-3, (3, 90)), rng.normal(0.0, 2e-6, (3, 90))
    v[:, :30] += 1e-4
    sigma = np.full((3, 90), 2e-6)
    sigma[1, 0] = np.nan
    numbers = np.array([[0.6, 0.8, 0.01, 0.02, 1e-6, 1.0]] * 3)
    inputs = tuple(each.astype(np.float32) for each in (np.stack([u, v], axis=-1), sigma, numbers))
    return board_pose, FitBoardLines(solver=SolvePose(**options)), inputs


CASES: dict[str, Callable[[Device, np.random.Generator], Case]] = {
    "pose": poses,
    "pose, free scale": lambda device, rng: poses(device, rng, scale=None),
    "lines": lambda device, rng: lines(device, rng, scale=0.05),
    "lines, free scale": lines,
    "lines of a board": board_lines,
    "lines of a board, free scale": lambda device, rng: board_lines(device, rng, scale=None),
}
# A pose takes 10 s to build in groups of 8.
MARKS = {
    "pose": [pytest.mark.slow],
    "pose, free scale": [pytest.mark.nightly],
    "lines, free scale": [pytest.mark.nightly],
    "lines of a board, free scale": [pytest.mark.nightly],
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, [])) for name in CASES])
def test_results_do_not_depend_on_the_group(
    device: Device, name: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A group of eight items sums the 64 parts in the same order as a group of 64."""
    module, operation, inputs = CASES[name](device, rng)
    expected = operation(*inputs, device=device)
    clear_cache()  # a call keeps its bound operation, with the usual group
    assert not to_numpy(getattr(expected, "status", np.zeros(1))).any()  # lines of a board have no status
    monkeypatch.setattr(module, "_GROUP", 8)
    assert operation.launch(device, inputs[0].shape, inputs[0].dtype).local_size == (8,)
    for field, ours, found in zip(expected._fields, expected, operation(*inputs, device=device), strict=True):
        np.testing.assert_array_equal(found, ours, err_msg=field)


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, [])) for name in CASES])
def test_a_device_with_few_registers_runs_smaller_groups(
    device: Device, name: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kernel that takes the registers of a group of 64 runs in as many groups of 8."""
    if device.kind == "rusticl":
        pytest.skip("Mesa's group limit of a kernel is not read (host/limits.py)")
    _, operation, inputs = CASES[name](device, rng)
    expected = operation(*inputs, device=device)
    real = cl.Kernel.get_work_group_info

    def limited(self: Any, key: Any, of: Any) -> Any:
        return 8 if key == cl.kernel_work_group_info.WORK_GROUP_SIZE else real(self, key, of)

    monkeypatch.setattr(cl.Kernel, "get_work_group_info", limited)
    bound = operation.bind(device, inputs[0].shape, inputs[0].dtype)
    found = bound.on_host(inputs)
    assert bound.enqueue_arguments[2:] == ((24,), (8,))
    for field, ours, theirs in zip(expected._fields, expected, found, strict=True):
        np.testing.assert_array_equal(theirs, ours, err_msg=field)
