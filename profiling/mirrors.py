"""Lit lines in mirrors: curved mirrors compared with Numba, plane mirrors with NumPy and Embree.

``balls``: images of the points of a line in 20 balls of 1280 triangles. The peer tests all triangles with the same
equations, in double like ours, compiled by Numba on all cores; quantities that do not depend on the point are computed
beforehand. `error` is the largest distance between its images and ours [m].

``facets/N``: mirror images of a line on a floor in the sides of boxes. The peer takes N samples of each lit segment,
finds their mirror images in all facets, and traces both paths of each image with Embree. Our result is exact;
`peer_error` is the median error of the peer over the samples of the sensor.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.mirror_points import MirrorPoints
from gpuvision.simulation.transport.mirrors import Mirrors
from gpuvision.simulation.transport.plane_mirrors import triangle_planes

_BALLS, _POINTS, _BOXES, _LIFT = 20, 2048, 30, 1e-7
_LENS = np.array([0.0, 0.08, 0.15])
_ALBEDO, _SHARE = 0.5, 0.8
Array = NDArray[np.float64]


def cases(device: Device) -> Iterator[Case]:
    """Yield balls, and facets for two numbers of samples."""
    if device.has_double:
        yield _balls(device)
    for samples in (64, 1024):
        yield _facets(device, samples)


def _balls(device: Device) -> Case:
    rng = np.random.default_rng(1)
    ball = np.array(trimesh.creation.icosphere(3).triangles)
    places = np.column_stack([rng.uniform(-0.02, 0.02, (_BALLS, 2)), np.full(_BALLS, 1.5e-3)])
    corners = np.concatenate([1e-3 * ball + place for place in places])
    normals = np.tile(ball / np.linalg.norm(ball, axis=2, keepdims=True), (_BALLS, 1, 1))
    points = np.zeros((_POINTS, 6))
    points[:, 0], points[:, 3] = np.linspace(-0.02, 0.02, _POINTS), 2e-5
    op = MirrorPoints(
        corners=corners,
        normals=normals,
        numbers=np.arange(len(corners), dtype=np.int32),
        outside=np.ones(len(corners), bool),
        kept=2 * _BALLS,
    )
    bound = op.bind(device, points.shape, points.dtype)
    bound.inputs[0].set(points)
    bound.inputs[1].set(_LENS)
    bound.run()
    triangle, place = to_numpy(bound.outputs.triangle), to_numpy(bound.outputs.place)
    found, theirs = np.zeros((_POINTS, 2 * _BALLS), np.int64), np.zeros((_POINTS, 2 * _BALLS, 3))

    def peer() -> None:
        _numba(points, _LENS, corners, normals, _corner_table(_LENS, corners, normals), found, theirs)

    peer()
    order, their_order = (np.argsort(np.where(each < 0, len(corners), each), axis=1) for each in (triangle, found))
    ours, same = np.take_along_axis(triangle, order, axis=1), np.take_along_axis(found, their_order, axis=1)
    difference = np.take_along_axis(place, order[..., None], axis=1) - np.take_along_axis(
        theirs, their_order[..., None], 1
    )
    both = (ours == same) & (ours >= 0)
    metadata = {
        "pairs": _POINTS * len(corners),
        "images": int((triangle >= 0).sum()),
        "others": int((ours != same).sum()),
    }
    return Case(
        "mirrors", "balls", bound.run, {"numba": peer}, float(np.abs(difference[both]).max()), metadata=metadata
    )


def _corner_table(lens: Array, corners: Array, normals: Array) -> Array:
    """Return for each corner: position, normal, lens height c, c e - 2 (e n) c for both edges e, and the edges."""
    edges = corners[:, 1:] - corners[:, :1]
    to_lens = lens - corners
    up = np.sum(to_lens * normals, axis=2)
    by_edge = (
        np.einsum("knj,kmj->knm", to_lens, edges) - 2.0 * np.einsum("knj,kmj->knm", normals, edges) * up[..., None]
    )
    both = np.broadcast_to(edges.reshape(-1, 1, 6), (len(corners), 3, 6))
    return np.ascontiguousarray(np.concatenate([corners, normals, up[..., None], by_edge, both], axis=2))


@numba.njit(error_model="numpy", inline="always")
def _law_at(t, k, n, x, y, z):
    qx, qy, qz = x - t[k, n, 0], y - t[k, n, 1], z - t[k, n, 2]
    up, c = qx * t[k, n, 3] + qy * t[k, n, 4] + qz * t[k, n, 5], t[k, n, 6]
    one = t[k, n, 7] * up + c * (qx * t[k, n, 9] + qy * t[k, n, 10] + qz * t[k, n, 11])
    two = t[k, n, 8] * up + c * (qx * t[k, n, 12] + qy * t[k, n, 13] + qz * t[k, n, 14])
    return one, two


@numba.njit(parallel=True, error_model="numpy")
def _numba(points, lens, corners, normals, table, found, places):
    """Test all triangles for each point: law of reflection at the corners, then Newton's method on the candidates."""
    count, kept = found.shape
    for i in numba.prange(count):
        shown = 0
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        found[i] = -1
        for k in range(corners.shape[0]):
            if table[k, 0, 6] <= 0.0 and table[k, 1, 6] <= 0.0 and table[k, 2, 6] <= 0.0:
                continue
            u0, v0 = _law_at(table, k, 0, px, py, pz)
            u1, v1 = _law_at(table, k, 1, px, py, pz)
            u2, v2 = _law_at(table, k, 2, px, py, pz)
            a, b, c = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
            per = 1.0 / (a + b + c)
            x, y = b * per, c * per
            if not (a * per > -0.5 and x > -0.5 and y > -0.5):
                continue
            x, y, place = _newton(points[i, :3], lens, corners[k], normals[k], x, y)
            if x >= 0.0 and y >= 0.0 and x + y <= 1.0 and shown < kept:
                normal = (1.0 - x - y) * normals[k, 0] + x * normals[k, 1] + y * normals[k, 2]
                up_lens, up_point = 0.0, 0.0
                for j in range(3):
                    up_lens += (lens[j] - place[j]) * normal[j]
                    up_point += (points[i, j] - place[j]) * normal[j]
                if up_lens > 1e-9 and up_point > 1e-9:
                    found[i, shown], places[i, shown] = k, place
                    shown += 1


@numba.njit(error_model="numpy", inline="always")
def _law(point, lens, place, normal, corners, out):
    square, c, q = 0.0, 0.0, 0.0
    for j in range(3):
        square += normal[j] * normal[j]
        c += (lens[j] - place[j]) * normal[j]
        q += (point[j] - place[j]) * normal[j]
    for m in range(2):
        ce, qe, ne = 0.0, 0.0, 0.0
        for j in range(3):
            edge = corners[m + 1, j] - corners[0, j]
            ce += (lens[j] - place[j]) * edge
            qe += (point[j] - place[j]) * edge
            ne += normal[j] * edge
        out[m] = square * (ce * q + qe * c) - 2.0 * ne * c * q


@numba.njit(error_model="numpy")
def _surface(corners, normals, x, y):
    weights = (1.0 - x - y, x, y)
    flat = weights[0] * corners[0] + x * corners[1] + y * corners[2]
    place, normal = flat.copy(), np.zeros(3)
    for n in range(3):
        rise = 0.0
        for j in range(3):
            rise += (flat[j] - corners[n, j]) * normals[n, j]
        for j in range(3):
            place[j] -= 0.5 * weights[n] * rise * normals[n, j]
            normal[j] += weights[n] * normals[n, j]
    return place, normal


@numba.njit(error_model="numpy")
def _newton(point, lens, corners, normals, x, y):
    residual, residual_x, residual_y = np.empty(2), np.empty(2), np.empty(2)
    for _ in range(16):
        for out, dx, dy in ((residual, 0.0, 0.0), (residual_x, 1e-6, 0.0), (residual_y, 0.0, 1e-6)):
            place, normal = _surface(corners, normals, x + dx, y + dy)
            _law(point, lens, place, normal, corners, out)
        ax, ay = (residual_x[0] - residual[0]) * 1e6, (residual_y[0] - residual[0]) * 1e6
        bx, by = (residual_x[1] - residual[1]) * 1e6, (residual_y[1] - residual[1]) * 1e6
        per = 1.0 / (ax * by - ay * bx)
        dx, dy = (residual[0] * by - residual[1] * ay) * per, (residual[1] * ax - residual[0] * bx) * per
        x, y = x - min(max(dx, -0.5), 0.5), y - min(max(dy, -0.5), 0.5)
        if abs(dx) + abs(dy) < 1e-9:
            break
    return x, y, _surface(corners, normals, x, y)[0]


def _facets(device: Device, samples: int) -> Case:
    scene, view, lit = _box_scene()
    materials = (
        Material(diffuse=Lambert(albedo=_ALBEDO)),
        Material(diffuse=Lambert(albedo=0.0), mirror=_SHARE),
    )
    mirrors = Mirrors(view=view, scene=scene, materials=materials, device=device)
    embree = EmbreeScene()
    TriangleMesh(embree, scene.corners.astype(np.float32))

    def peer() -> Exposure:
        return _by_samples(scene, view, lit, embree, samples)

    ours, theirs = mirrors.mirrored_exposure(lit, 0.0).total(), peer().total()
    lit_up = ours > 0.0
    error = float(np.median(np.abs(theirs[lit_up] / ours[lit_up] - 1.0)))
    metadata = {"triangles": len(scene.corners), "samples": samples * len(lit.power), "peer_error": error}
    return Case(
        "mirrors",
        f"facets/{samples}",
        lambda: mirrors.mirrored_exposure(lit, 0.0),
        {"numpy+embreex": peer},
        0.0,
        metadata=metadata,
    )


def _box_scene() -> tuple[Scene, SensorView, LitLine]:
    """Return boxes with mirroring sides on a floor, a sensor, a sheet of light, and the lit line."""
    rng = np.random.default_rng(1)
    floor = np.array(
        [[[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0]], [[-0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]]]
    )
    parts = [floor]
    for _ in range(_BOXES):
        size = rng.uniform((2e-3, 2e-3, 1e-3), (6e-3, 6e-3, 6e-3))
        box = trimesh.creation.box(size).apply_transform(_turned(rng.random()))
        place = (*rng.uniform((-0.02, -0.015), (0.02, 0.005)), 0.5 * size[2])
        parts.append(np.add(box.triangles, place))
    corners = np.concatenate(parts)
    upright = np.abs(triangle_planes(corners)[:, 2]) < 0.5
    transport = StraightTransport(step=1e-4)
    geometry = Triangulation.from_stand_off(
        baseline=_LENS[1], stand_off=_LENS[2], focal_distance=0.04, tilt=0.0, region=((-6e-3, 6e-3), (-6e-3, 6e-3))
    )
    edges = np.linspace(-6e-3, 6e-3, 257)
    lens = (float(_LENS[0]), float(_LENS[1]), float(_LENS[2]))
    view = SensorView(triangulation=geometry, transport=transport, lens=lens, u_edges=edges, v_edges=edges)
    scene = Scene(corners, upright.astype(np.int32))
    return scene, view, LightSheet(transport=transport, g_limits=(-0.025, 0.025)).illuminate(scene, 0.0)


def _turned(angle: float) -> Array:
    """Return the matrix (4, 4) of a rotation about z."""
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return turn


def _by_samples(scene: Scene, view: SensorView, lit: LitLine, embree: Any, samples: int) -> Exposure:
    """Return the mirrored light from samples of lit segments: mirror images, and rays for both ways of each."""
    assert scene.material is not None
    dull = scene.material[lit.triangle] == 0
    share = ((np.arange(samples) + 0.5) / samples)[:, None]
    points = (lit.ends[dull, :1] + share * (lit.ends[dull, 1:] - lit.ends[dull, :1])).reshape(-1, 3)
    normals, each = np.repeat(lit.normals[dull], samples, axis=0), np.repeat((lit.power * lit.lengths)[dull], samples)
    mirrors = scene.corners[scene.material == 1]
    planes, total = triangle_planes(mirrors), view.dark()
    for corners, plane in zip(mirrors, planes, strict=True):
        normal, up, lens_up = plane[:3], points @ plane[:3] - plane[3], _LENS @ plane[:3] - plane[3]
        front = np.flatnonzero(up * lens_up > 0.0)
        image = points[front] - 2.0 * up[front, None] * normal
        spot = _LENS + (lens_up / (lens_up + up[front]))[:, None] * (image - _LENS)
        inside = np.ones(len(front), bool)
        for n in range(3):
            inside &= (spot - corners[n]) @ np.cross(normal, corners[(n + 1) % 3] - corners[n]) > 0.0
        row, spot, image = front[inside], spot[inside], image[inside]
        towards = spot - points[row]
        cosine = np.sum(towards * normals[row], axis=1) / np.linalg.norm(towards, axis=1)
        free = cosine > 0.0
        free[free] = _free(embree, spot[free], points[row[free]])
        free[free] = _free(embree, spot[free], np.broadcast_to(_LENS, (int(free.sum()), 3)))
        row, image, cosine = row[free], image[free], cosine[free]
        power = _SHARE * _ALBEDO / np.pi / samples * each[row] * cosine * view.aperture_solid_angle(image)
        u, v = view.project(image).T
        total = total + view.deposit_spots(u, v, power)
    return total


def _free(embree: Any, start: Array, end: Array) -> NDArray[np.bool_]:
    if not len(start):
        return np.zeros(0, bool)
    direction = end - start
    direction *= 1.0 - 2.0 * _LIFT / np.linalg.norm(direction, axis=1, keepdims=True)
    lifted = start + _LIFT * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    ones = np.ones(len(start), np.float32)
    return np.asarray(
        embree.run(lifted.astype(np.float32), direction.astype(np.float32), dists=ones, query="OCCLUDED") != 0
    )
