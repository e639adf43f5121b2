"""Scenes: triangles with materials, from files or trimesh, and what is wrong with them."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.bvh import Bvh, radix_argsort

# An odd number of 64 bits that looks like noise (of the golden ratio).
_MIXER = 0x9E3779B97F4A7C15

# What trimesh's readers raise where a file breaks off or is garbled; some look for a package that guesses encodings.
_DAMAGED = (
    ArithmeticError,
    AttributeError,
    ImportError,
    LookupError,
    NameError,
    RuntimeError,
    TypeError,
    ValueError,
)

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Defects:
    """Triangles of a scene that are not as they should be, by their numbers, and what was done about them.

    Attributes
    ----------
    not_finite
        A corner is NaN or infinite: left out of the tree.
    degenerate
        Two corners are the same, or the three lie on a line (no area): left out.
    non_manifold
        On an edge that three or more share, or that cannot be wound like their neighbours at all (a Moebius strip):
        kept as they are.
    inverted
        Wound against most of those they hang together with: turned, so that `Scene.corners` are wound alike.
    """

    not_finite: tuple[int, ...]
    degenerate: tuple[int, ...]
    non_manifold: tuple[int, ...]
    inverted: tuple[int, ...]

    def __str__(self) -> str:
        """Return a line for each kind that occurs."""
        lines = []
        for name, numbers in vars(self).items():
            if numbers:
                some = ", ".join(map(str, numbers[:10])) + (", ..." if len(numbers) > 10 else "")
                lines.append(f"{name.replace('_', ' ')}: {len(numbers)} triangles ({some})")
        return "\n".join(lines) or "no defects"


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles, each with a material; compared by identity.

    Parameters
    ----------
    corners
        (n, 3, 3), metres; n may be 0.
    material
        (n,) integers: the index of each triangle's material; all 0 if left out.

    Attributes
    ----------
    defects
        What was wrong. Numbers of triangles stay what they were in the input.

    Raises
    ------
    ValueError
        Wrong shapes; a material below 0.
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
            raise ValueError("Scene.material has an index below 0; expected 0 for the first material, and on")
        defects = _defects(corners)
        turned = list(defects.inverted)
        corners[turned] = corners[turned][:, ::-1]
        corners.flags.writeable = False
        object.__setattr__(self, "corners", corners)
        object.__setattr__(self, "material", given.astype(np.int32))
        object.__setattr__(self, "defects", defects)

    @functools.cached_property
    def bvh(self) -> Bvh:
        """The tree over the triangles that can be met, built at the first use."""
        good = np.ones(len(self.corners), bool)
        good[[*self.defects.not_finite, *self.defects.degenerate]] = False
        return Bvh.build(self.corners, good)

    @classmethod
    def of(cls, meshes: Any, *, metres: float = 1.0) -> Scene:
        """Take a `trimesh.Trimesh`, a `trimesh.Scene`, or several meshes.

        Each mesh is one material, in their order; what stands in a `trimesh.Scene` several times is one.

        Parameters
        ----------
        meshes
            What trimesh loaded or made.
        metres
            How long the meshes' unit is: 1e-3 for millimetres.
        """
        parts = sorted(_parts(meshes), key=lambda part: part[0])
        if not parts:
            return cls(np.zeros((0, 3, 3)))
        triangles = [np.asarray(mesh.triangles, np.float64) for _, mesh in parts]
        materials = [np.full(len(mesh.faces), number, np.int32) for number, mesh in parts]
        return cls(np.concatenate(triangles) * metres, np.concatenate(materials))

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, metres: float = 1.0) -> Scene:
        """Read STL, PLY, OBJ or GLB; each of a file's meshes is one material.

        Raises
        ------
        FileNotFoundError
            There is no such file.
        IsADirectoryError
            It is a folder.
        ValueError
            It is of another kind, damaged, or holds no triangles.
        """
        import trimesh

        if os.path.isdir(path):
            raise IsADirectoryError(f"{os.fspath(path)}: a folder, expected a file with a mesh")
        if not os.path.isfile(path):
            raise FileNotFoundError(f"{os.fspath(path)}: no such file")
        if os.path.splitext(path)[1].lower() not in (".stl", ".ply", ".obj", ".glb"):
            raise ValueError(f"{os.fspath(path)}: expected a mesh as .stl, .ply, .obj or .glb")
        try:
            scene = cls.of(trimesh.load(os.fspath(path), process=False), metres=metres)
        except _DAMAGED as error:
            raise ValueError(f"{os.fspath(path)}: not a readable mesh: damaged, cut short or no mesh at all") from error
        if not len(scene.corners):
            raise ValueError(f"{os.fspath(path)}: holds no triangles")
        return scene


def _parts(meshes: Any) -> list[tuple[int, Any]]:
    """Return meshes where they stand in the scene, with the numbers of their materials."""
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
    finite: npt.NDArray[np.bool_] = np.asarray(np.isfinite(corners).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], corners, 0.0)
    flat = finite & _is_flat(safe)
    good = np.flatnonzero(finite & ~flat)
    if not len(good):
        return Defects(_numbers(np.flatnonzero(~finite)), _numbers(np.flatnonzero(flat)), (), ())
    points = _numbered(safe[good].reshape(-1, 3)).reshape(-1, 3)
    crowded, inverted = _winding(points)
    return Defects(
        _numbers(np.flatnonzero(~finite)),
        _numbers(np.flatnonzero(flat)),
        _numbers(good[crowded]),
        _numbers(good[inverted]),
    )


def _numbers(values: Iterable[Any]) -> tuple[int, ...]:
    return tuple(int(each) for each in values)


def _is_flat(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Whether triangles have no area: none beyond the rounding of their own corners."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(one, two), axis=1)
    rounding = 4.0 * np.finfo(np.float64).eps * np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    return np.asarray(area <= rounding)


def _numbered(points: npt.NDArray[np.float64]) -> Integers:
    """Return a number for each point (n, 3), the same for the same."""
    columns = np.ascontiguousarray(points.T) + 0.0
    mixed = np.zeros(len(points), np.uint64)
    for column in columns.view(np.uint64):
        mixed = (mixed ^ column) * np.uint64(_MIXER)
        mixed ^= mixed >> np.uint64(32)
    # A number of 63 bits for each; the places say whether two have the same one by chance.
    order = radix_argsort((mixed >> np.uint64(1)).astype(np.int64))
    mixed, columns = mixed[order] >> np.uint64(1), columns[:, order]
    is_new = np.append(True, mixed[1:] != mixed[:-1])
    if np.any((columns[:, 1:] != columns[:, :-1]).any(axis=0) & ~is_new[1:]):
        return np.asarray(np.unique(points + 0.0, axis=0, return_inverse=True)[1]).reshape(-1)
    numbers = np.empty(len(points), np.int64)
    numbers[order] = np.cumsum(is_new) - 1
    return numbers


def _winding(points: Integers) -> tuple[Integers, Integers]:
    """Return which triangles hang on a crowded edge (or cannot be wound), and which are wound against the most."""
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
    crowded = np.unique(face[np.repeat(uses > 2, uses)])
    one = first[uses == 2]
    against = forward[one] == forward[one + 1]
    if not against.any():
        return crowded, np.zeros(0, np.int64)
    # Every triangle twice, as it is and turned: neighbours join the sheets in which they are wound alike.
    a, b = face[one], face[one + 1]
    rows, columns = np.concatenate([a, a + count]), np.concatenate([b + count * against, b + count * ~against])
    links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    label = connected_components(links, directed=False)[1]
    size = np.bincount(label[:count], minlength=label.max() + 1)
    as_is, turned = size[label[:count]], size[label[count:]]
    # At a tie the sheet of the lower label stays.
    inverted = (as_is < turned) | ((as_is == turned) & (label[:count] > label[count:]))
    one_sided = np.flatnonzero(label[:count] == label[count:])
    return np.union1d(crowded, one_sided), np.flatnonzero(inverted)
