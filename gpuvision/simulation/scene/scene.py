"""Scenes: triangles with materials, from files or trimesh, and their defects."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import reading
from gpuvision.simulation.scene.bvh import GPU_WIDTH, WIDTH, Bvh, radix_argsort
from gpuvision.simulation.scene.convex_parts import ConvexParts, ConvexSurfaces
from gpuvision.simulation.scene.mesh_file import SUFFIXES, check_mesh

# Multiplier of the hash: 2^64 over the golden ratio, made odd (Fibonacci hashing, Knuth).
_MIXER = 0x9E3779B97F4A7C15

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Defects:
    """Defective triangles of a scene, by their numbers.

    Attributes
    ----------
    not_finite
        Triangles with a corner that is NaN or infinite. They are not in the BVH, and `Scene.corners` holds a corner of
        another triangle three times.
    degenerate
        Triangles without area: two corners coincide, or all three are collinear. They are not in the BVH.
    duplicate
        Triangles with the corners and the winding of an earlier triangle, on an edge of three or more triangles: parts
        of a mesh that were stored twice. They are not in the BVH, and `Scene.corners` holds their first corner three
        times.
    non_manifold
        Triangles on an edge of three or more triangles, or on a surface that cannot be oriented (a Moebius strip). They
        are kept unchanged.
    inverted
        Triangles with the opposite winding to most of their connected neighbours. They are flipped, so that the
        winding of `Scene.corners` is consistent.
    """

    not_finite: tuple[int, ...]
    degenerate: tuple[int, ...]
    duplicate: tuple[int, ...]
    non_manifold: tuple[int, ...]
    inverted: tuple[int, ...]

    def __str__(self) -> str:
        """Return one line for each kind of defect that occurs."""
        lines = []
        for name, numbers in vars(self).items():
            if numbers:
                some = ", ".join(map(str, numbers[:10])) + (", ..." if len(numbers) > 10 else "")
                lines.append(f"{name.replace('_', ' ')}: {len(numbers)} triangles ({some})")
        return "\n".join(lines) or "no defects"

    @property
    def without_area(self) -> list[int]:
        """Triangles of a scene that have no area: not finite, degenerate and duplicate ones."""
        return [*self.not_finite, *self.degenerate, *self.duplicate]


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles with materials; compared by identity.

    Parameters
    ----------
    corners : numpy.ndarray
        (n, 3, 3), corners of the triangles [m]; n may be 0.
    material : numpy.ndarray, optional
        Integers (n,), index of the material of each triangle, 0 or more; None: all 0.

    Attributes
    ----------
    defects
        Defective triangles. Their numbers are indices of the given triangles.

    Raises
    ------
    ValueError
        A shape is wrong, or a material index is negative.
    """

    corners: npt.NDArray[np.float64]
    material: npt.NDArray[np.int32] | None = None
    defects: Defects = field(init=False)

    def __post_init__(self) -> None:
        corners = np.array(self.corners, np.float64)
        if corners.ndim != 3 or corners.shape[1:] != (3, 3):
            raise ValueError(f"Scene.corners has shape {corners.shape}, expected (n, 3, 3): triangles in metres")
        given = np.zeros(len(corners), np.int32) if self.material is None else np.asarray(self.material)
        if given.shape != (len(corners),) or given.dtype.kind not in "iu":
            raise ValueError(f"Scene.material is {given.dtype} {given.shape}, expected integers ({len(corners)},)")
        if np.any(given < 0):
            raise ValueError(
                "Scene.material has a negative index; expected 0 for the first material, 1 for the second, ..."
            )
        defects = _defects(corners)
        # Without area, so that no other code meets NaN or two surfaces in one place.
        duplicate, not_finite = list(defects.duplicate), list(defects.not_finite)
        corners[duplicate] = corners[duplicate][:, :1]
        corners[not_finite] = next((each for each in corners[:, 0] if np.isfinite(each).all()), 0.0)
        inverted = list(defects.inverted)
        corners[inverted] = corners[inverted][:, ::-1]
        corners.flags.writeable = False
        object.__setattr__(self, "corners", corners)
        object.__setattr__(self, "material", given.astype(np.int32))
        object.__setattr__(self, "defects", defects)

    @functools.cached_property
    def bvh(self) -> Bvh:
        """BVH over the triangles with an area, built at the first use."""
        return self._tree(WIDTH)

    @functools.cached_property
    def convex_parts(self) -> ConvexParts:
        """Convex parts of the triangles of `bvh` and a tree over them, built at the first use."""
        good = self._is_in_tree
        surfaces = ConvexSurfaces.of(self.corners[good])
        is_plain = not surfaces.is_convex.any()
        return ConvexParts.of(self.bvh if is_plain else Bvh.build(self.corners, good, parts=surfaces.parts), surfaces)

    @functools.cached_property
    def gpu_bvh(self) -> Bvh:
        """BVH over the same triangles with four children per node, for GPUs; built at the first use."""
        return self._tree(GPU_WIDTH)

    @property
    def _is_in_tree(self) -> npt.NDArray[np.bool_]:
        good = np.ones(len(self.corners), bool)
        good[self.defects.without_area] = False
        return good

    def _tree(self, width: int) -> Bvh:
        return Bvh.build(self.corners, self._is_in_tree, width=width)

    @classmethod
    def of(cls, meshes: Any, *, metres: float = 1.0) -> Scene:
        """Make a scene of a `trimesh.Trimesh`, a `trimesh.Scene`, or several meshes.

        Each mesh has a separate material, numbered in the order of the meshes. All instances of a mesh in a
        `trimesh.Scene` share its material.

        Parameters
        ----------
        meshes : Any
            Meshes of trimesh.
        metres : float
            Length unit of the meshes [m]: 1e-3 for millimetres. Default 1.

        Raises
        ------
        TypeError
            An element is not a `trimesh.Trimesh`.
        """
        parts = sorted(_parts(meshes), key=lambda part: part[0])
        if not parts:
            return cls(np.zeros((0, 3, 3)))
        triangles = [np.asarray(mesh.triangles, np.float64) for _, mesh in parts]
        materials = [np.full(len(mesh.faces), number, np.int32) for number, mesh in parts]
        return cls(np.concatenate(triangles) * metres, np.concatenate(materials))

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, metres: float = 1.0) -> Scene:
        """Read a scene from an STL, PLY, OBJ or GLB file; each mesh of the file has a separate material.

        Parameters
        ----------
        path : str or os.PathLike[str]
            The file.
        metres : float
            Length unit of the file [m]: 1e-3 for millimetres. Default 1.

        Raises
        ------
        FileNotFoundError
            The file does not exist.
        IsADirectoryError
            The path is a folder.
        ReadError
            The file has another format, is damaged, contains no triangles, or has more triangles
            than `gpuvision.simulation.scene.mesh_file.MAX_TRIANGLES`.
        """
        import trimesh

        path = Path(path)
        if path.is_dir():
            raise IsADirectoryError(f"{path}: a folder, expected a file with a mesh")
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        if path.suffix.lower() not in SUFFIXES:
            raise ReadError(f"{path}: expected a mesh as {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
        with reading(path, "mesh", hint="is it damaged, truncated or of another format?"):
            check_mesh(path)
            # Materials of the file are not used, and may refer to files of any size.
            loaded = trimesh.load(path, process=False, skip_materials=True)
            scene = (
                cls(np.zeros((0, 3, 3))) if isinstance(loaded, trimesh.PointCloud) else cls.of(loaded, metres=metres)
            )
        if not len(scene.corners):
            raise ReadError(f"{path}: contains no triangles, expected a mesh of the part")
        return scene


def _parts(meshes: Any) -> list[tuple[int, Any]]:
    """Return the meshes in scene coordinates, with their material numbers."""
    import trimesh

    if isinstance(meshes, trimesh.Scene):
        names, parts = list(meshes.geometry), []
        for node in meshes.graph.nodes_geometry:
            transform, name = meshes.graph[node]
            if isinstance(meshes.geometry[name], trimesh.Trimesh):
                parts.append((names.index(name), meshes.geometry[name].copy().apply_transform(transform)))
        return parts
    several = [meshes] if isinstance(meshes, trimesh.Trimesh) else list(meshes)
    for each in several:
        if not isinstance(each, trimesh.Trimesh):
            raise TypeError(f"expected trimesh meshes, got {type(each).__name__}; trimesh.load reads files")
    return list(enumerate(several))


def _defects(corners: npt.NDArray[np.float64]) -> Defects:
    """Find the defective triangles among (n, 3, 3)."""
    finite: npt.NDArray[np.bool_] = np.asarray(np.isfinite(corners).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], corners, 0.0)
    flat = finite & _is_degenerate(safe)
    good, duplicate = np.flatnonzero(finite & ~flat), np.zeros(0, np.int64)
    non_manifold, inverted = duplicate, duplicate
    if len(good):
        points = _vertex_numbers(safe[good].reshape(-1, 3)).reshape(-1, 3)
        non_manifold, inverted = _winding(points)
        # A duplicate of a triangle with neighbours is on an edge of three or more triangles.
        rows = points[non_manifold]
        rows = np.take_along_axis(rows, (rows.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
        first = np.unique(rows, axis=0, return_index=True)[1]
        if len(first) < len(non_manifold):
            is_kept = np.ones(len(good), bool)
            is_kept[np.delete(non_manifold, first)] = False
            duplicate, good = good[~is_kept], good[is_kept]
            non_manifold, inverted = _winding(points[is_kept])
    return Defects(
        _numbers(np.flatnonzero(~finite)),
        _numbers(np.flatnonzero(flat)),
        _numbers(duplicate),
        _numbers(good[non_manifold]),
        _numbers(good[inverted]),
    )


def _numbers(values: Iterable[Any]) -> tuple[int, ...]:
    return tuple(int(each) for each in values)


def _is_degenerate(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return whether the areas of triangles are zero up to the rounding of their corners."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(one, two), axis=1)
    rounding = 4.0 * np.finfo(np.float64).eps * np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    return np.asarray(area <= rounding)


def _vertex_numbers(points: npt.NDArray[np.float64]) -> Integers:
    """Return vertex numbers (n,) of points (n, 3): points with identical coordinates have the same number."""
    columns = np.ascontiguousarray(points.T) + 0.0
    mixed = np.zeros(len(points), np.uint64)
    for column in columns.view(np.uint64):
        mixed = (mixed ^ column) * np.uint64(_MIXER)
        mixed ^= mixed >> np.uint64(32)
    # Points are grouped by a 63-bit hash; a comparison of the coordinates within each group finds hash collisions.
    order = radix_argsort((mixed >> np.uint64(1)).astype(np.int64))
    mixed, columns = mixed[order] >> np.uint64(1), columns[:, order]
    is_new = np.append(True, mixed[1:] != mixed[:-1])
    if np.any((columns[:, 1:] != columns[:, :-1]).any(axis=0) & ~is_new[1:]):
        return np.asarray(np.unique(points + 0.0, axis=0, return_inverse=True)[1]).reshape(-1)
    numbers = np.empty(len(points), np.int64)
    numbers[order] = np.cumsum(is_new) - 1
    return numbers


def _winding(points: Integers) -> tuple[Integers, Integers]:
    """Return the non-manifold and the inverted triangles, by vertex numbers (n, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(points)
    tail, head = points.ravel(), np.roll(points, -1, axis=1).ravel()
    face = np.repeat(np.arange(count), 3)
    edge = np.minimum(tail, head) * (points.max() + 1) + np.maximum(tail, head)
    order = radix_argsort(edge)
    edge, face, forward = edge[order], face[order], (tail < head)[order]
    first = np.append(0, np.flatnonzero(edge[1:] != edge[:-1]) + 1)
    uses = np.diff(first, append=len(edge))
    non_manifold = np.unique(face[np.repeat(uses > 2, uses)])
    one = first[uses == 2]
    opposed = forward[one] == forward[one + 1]
    if not opposed.any():
        return non_manifold, np.zeros(0, np.int64)
    # Graph with two nodes per triangle, as given and flipped. Neighbours are linked where their windings agree. A
    # surface that can be oriented has two components, one for each orientation.
    a, b = face[one], face[one + 1]
    rows, columns = np.concatenate([a, a + count]), np.concatenate([b + count * opposed, b + count * ~opposed])
    links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    label = connected_components(links, directed=False)[1]
    size = np.bincount(label[:count], minlength=label.max() + 1)
    given, flipped = size[label[:count]], size[label[count:]]
    # The orientation of the majority is kept; at a tie, the component with the lower label.
    inverted = (given < flipped) | ((given == flipped) & (label[:count] > label[count:]))
    not_orientable = np.flatnonzero(label[:count] == label[count:])
    return np.union1d(non_manifold, not_orientable), np.flatnonzero(inverted)
