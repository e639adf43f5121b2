"""MirrorFacets on devices: no block that shows a line is omitted; windows by the law of reflection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from canary import Guarded
from gpuvision.host import Device
from gpuvision.simulation.transport.mirror_facets import MirrorFacets
from gpuvision.simulation.transport.plane_mirrors import mirror_windows, triangle_planes

WAYS = pytest.mark.parametrize(
    ("variant", "dtype"),
    [("vector", np.float64), ("work_item", np.float64), ("vector", np.float32), ("work_item", np.float32)],
)
LENS = np.array([0.1, 0.2, 2.0])


def mirrors(kind: str, rng: np.random.Generator) -> np.ndarray:
    soup = rng.uniform(-1.0, 1.0, (300, 1, 3)) + rng.normal(0.0, 0.2, (300, 3, 3))
    boxes = [trimesh.creation.box((0.3, 0.3, 0.3)).subdivide().subdivide() for _ in range(6)]
    turned = [
        np.array(box.triangles) @ trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3] for box in boxes
    ]
    heap = np.concatenate([box + rng.uniform(-1.0, 1.0, 3) for box in turned])
    return (
        {"soup": soup, "one": soup[:1], "boxes": heap, "sphere": np.array(trimesh.creation.icosphere(2).triangles)}[
            kind
        ]
        .astype(np.float32)
        .astype(np.float64)
    )


def all_windows(corners: np.ndarray, lines: np.ndarray) -> Any:
    line, mirror = (each.ravel() for each in np.indices((len(lines), len(corners))))
    return mirror_windows(LENS, lines.reshape(-1, 2, 3), corners, triangle_planes(corners), line, mirror)


def test_a_mirror_seen_edge_on_shows_nothing() -> None:
    """Lens and line are above the plane of the mirror by 1e-9 of their distance, or by a tenth: the rays are alike."""
    corners = np.array([[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]])
    first, shown = np.zeros(1, np.int64), []
    for height in (1e-9, 0.1):
        lens, line = np.array([-2.0, 0.0, 2.0 * height]), np.array([[[0.8, 0.0, height], [0.8, 0.0, 4.0 * height]]])
        windows = mirror_windows(lens, line, corners, triangle_planes(corners), first, first, min_height=1e-6)
        shown.append(len(windows.line))
    assert shown == [0, 1]


@WAYS
@pytest.mark.parametrize("kind", ["soup", "one", "boxes", "sphere"])
def test_no_block_is_left_out_that_shows_a_line(
    device: Device, variant: Any, dtype: Any, kind: str, rng: np.random.Generator
) -> None:
    corners = mirrors(kind, rng)
    lines = rng.uniform(-1.5, 1.5, (77, 3)).repeat(2, axis=0).reshape(77, 6)
    lines[:, 3:] += rng.normal(0.0, 0.3, (77, 3))
    lines = lines.astype(dtype)
    found = all_windows(corners, lines.astype(np.float64))
    op = MirrorFacets(corners=corners, variant=variant)
    candidates = op(lines, LENS.astype(dtype), device=device).near
    block_of = np.empty(len(corners), int)
    block_of[op.blocks.order] = np.repeat(np.arange(candidates.shape[1]), np.diff(op.blocks.start))
    assert candidates[found.line, block_of[found.mirror]].all()
    assert len(found.line) > (0 if kind == "one" else 50)
    if kind == "boxes":
        # TriangleBlocks of one face each: few that are looked at show nothing.
        assert candidates.mean() < 0.1


def test_rays_reflect_at_the_ends_of_windows_as_they_should(rng: np.random.Generator) -> None:
    corners, lines = mirrors("soup", rng), rng.uniform(-1.5, 1.5, (20, 6))
    found = all_windows(corners, lines)
    ends = lines.reshape(-1, 2, 3)[found.line]
    place = ends[:, :1] + found.share[..., None] * (ends[:, 1:] - ends[:, :1])
    planes = triangle_planes(corners)[found.mirror][:, None]
    normal, offset = planes[..., :3], planes[..., 3]
    up, lens_up = np.sum(place * normal, axis=-1) - offset, LENS @ normal[:, 0].T - offset[:, 0]
    assert np.all(up * lens_up[:, None] > -1e-9)
    share = np.abs(lens_up[:, None]) / (np.abs(lens_up[:, None]) + np.abs(up))
    spot = LENS + share[..., None] * (place - 2.0 * up[..., None] * normal - LENS)
    triangle = corners[found.mirror]
    basis = np.linalg.pinv(np.swapaxes(triangle[:, 1:] - triangle[:, :1], 1, 2))
    weights = np.einsum("nij,nej->nei", basis, spot - triangle[:, :1])
    inside = np.concatenate([weights, 1.0 - weights.sum(axis=-1, keepdims=True)], axis=-1).min(axis=-1)
    assert np.all(inside > -1e-9)
    # An end inside the line is on an edge, or where the line crosses the mirror.
    cut = (found.share > 0.0) & (found.share < 1.0)
    assert np.all(np.minimum(np.abs(inside), np.abs(up))[cut] < 1e-9)
    assert cut.sum() > 50


@pytest.mark.double
def test_writes_only_its_outputs(device: Device, rng: np.random.Generator) -> None:
    op = MirrorFacets(corners=mirrors("soup", rng))
    for shape in ((1,), (3, 7), (33,)):
        lines = rng.uniform(-1.0, 1.0, (*shape, 6))
        plain = op(lines, LENS, device=device)
        guarded = Guarded(plain)
        op(lines, LENS, device=device, out=guarded.out)
        guarded.assert_intact()
        np.testing.assert_array_equal(plain.near, guarded.out.near)


def test_what_it_does_not_take(device: Device, rng: np.random.Generator) -> None:
    for wrong in (np.full((1, 3, 3), np.nan), np.zeros((0, 3, 3)), np.zeros((3, 3))):
        with pytest.raises(ValueError, match="corners"):
            MirrorFacets(corners=wrong)
    with pytest.raises(ValueError, match=r"\(\.\.\., 6\)"):
        MirrorFacets(corners=mirrors("one", rng))(np.zeros((4, 5)), LENS, device=device)
    with pytest.raises(TypeError, match="float32"):
        MirrorFacets(corners=mirrors("one", rng))(np.zeros((4, 6), np.int32), LENS, device=device)
