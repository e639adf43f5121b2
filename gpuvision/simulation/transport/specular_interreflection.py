"""Specular interreflection: lines that mirrors light on other surfaces."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.row_padding import run_with_row_padding
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.envelope import upper_envelope
from gpuvision.simulation.transport.illumination import SHORTEST_LINE, LightSheet, LitLine
from gpuvision.simulation.transport.mirror_points import TriangleBlocks
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Pairs of a sheet and a block of triangles in memory at once.
_MAX_PAIRS = 2_000_000


@dataclass(frozen=True, kw_only=True)
class InterreflectionLimits:
    """Numerical limits of `SpecularInterreflection`.

    Attributes
    ----------
    sheet_decimals : int
        Number of decimals, in units of the scene's reach, to which two mirrored sheets must agree to count as one.
        Derived: the rounding of double with a margin of some ten thousand. Default 11.
    on_mirror : float
        Points nearer to a mirror than this fraction of the source's distance, or of the scene's reach, lie on it.
        Derived: some thousand roundings of double. Default 1e-12.
    max_halvings : int
        Largest number of times that a step is halved between two rays off a curved mirror that meet different
        triangles. Chosen: 2^-12 of a step. Default 12.
    """

    sheet_decimals: int = 11
    on_mirror: float = 1e-12
    max_halvings: int = 12


class _Beam(NamedTuple):
    """Lit lines, and the origin of each line's light: a source (w = 1), or a direction towards the light (w = 0)."""

    line: LitLine
    light: Float64  # (m, 4)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpecularInterreflection:
    """Mirrors of a scene as reflectors of the sheet's light; used by `Mirrors.reflected_lines`.

    Parameters
    ----------
    scene
        All surfaces.
    reflectance
        (n,): share of the light that each triangle reflects specularly.
    normals
        (n, 3, 3): normals at the corners of curved triangles.
    is_curved
        (n,) bool: triangles that belong to curved mirrors.
    step
        Distance on the lit line of the rays that are traced off a curved mirror [m].
    clearance
        Distance from a surface within which a ray meets nothing [m].
    device
        Device of the ray queries.
    limits
        Numerical limits.
    """

    scene: Scene
    reflectance: Float64
    normals: Float64
    is_curved: npt.NDArray[np.bool_]
    step: float
    clearance: float
    device: Device
    limits: InterreflectionLimits = InterreflectionLimits()

    def reflected_lines(self, lit: LitLine, sheet: LightSheet, L: float, max_reflections: int) -> LitLine:
        """Return the lines that are lit after 1 to ``max_reflections`` reflections.

        Parameters
        ----------
        lit
            Lines that the sheet lights.
        sheet
            Sheet of light.
        L
            Transport of the sheet [m].
        max_reflections
            Largest number of mirrors one after another.
        """
        beam, found = _Beam(lit, np.tile(_light_position(sheet, L), (len(lit.power), 1))), []
        for _ in range(max_reflections):
            share = self.reflectance[beam.line.triangle]
            beam = _select(beam, np.flatnonzero(share > 0.0))
            if not len(beam.light):
                break
            curved = self.is_curved[beam.line.triangle]
            beam = _concatenate(
                [
                    self._reflect_by_planes(_select(beam, ~curved), sheet.uniformity),
                    self._reflect_by_curves(_select(beam, curved)),
                ]
            )
            found.append(beam)
        return _concatenate([_Beam(_empty_line(), np.zeros((0, 4))), *found]).line

    # ---- plane mirrors: the mirrored sheet cuts the scene ------------------------------------------------------

    def _reflect_by_planes(self, beam: _Beam, uniformity: float) -> _Beam:
        """Return the lines lit by plane mirrors.

        Lines on one plane, in one sheet and from one source are computed together.
        """
        if not len(beam.light):
            return beam
        group = np.unique(self._sheet_keys(beam), axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(group, kind="stable")
        beam, group = _select(beam, order), group[order]
        first = np.flatnonzero(np.diff(group, prepend=-1))
        fans, at = _mirrored_sheets(beam, first, group, self._planes)
        cuts = self._cuts(fans)
        pieces = upper_envelope(cuts.fan, cuts.x, cuts.height)
        # Each piece is paired with each lit line of its mirror whose light falls on it.
        fan = cuts.fan[pieces.segment]
        begin, count = first[fan], np.diff(first, append=len(group))[fan]
        member = np.repeat(np.arange(len(fan)), count)
        line = np.arange(len(member)) + np.repeat(begin - (np.cumsum(count) - count), count)
        left = np.maximum(pieces.left[member], at[line].min(axis=1))
        right = np.minimum(pieces.right[member], at[line].max(axis=1))
        kept = left < right
        member, line, left, right = pieces.segment[member][kept], line[kept], left[kept], right[kept]
        return self._lines_on_surfaces(beam, fans, cuts, (member, line, left, right), uniformity)

    def _lines_on_surfaces(
        self,
        beam: _Beam,
        fans: _MirroredSheets,
        cuts: _SheetCuts,
        pieces: tuple[Integers, Integers, Float64, Float64],
        uniformity: float,
    ) -> _Beam:
        """Turn pieces (index of the cut, index of the line that lights it, x at both ends) into lit lines."""
        member, line, left, right = pieces
        (a, b), (low, high) = cuts.x[member].T, cuts.height[member].T

        def height(x: Float64) -> Float64:
            return np.asarray(low + (x - a) / (b - a) * (high - low))

        density = np.stack([height(left), height(right)]) ** 2 if fans.is_point.any() else np.ones((2, len(member)))
        density[:, ~fans.is_point[cuts.fan[member]]] = 1.0
        change = np.abs(density[1] - density[0]) / density.max(axis=0, initial=1e-300)
        count = np.maximum(np.ceil(change / uniformity * (1.0 - 1e-9)), 1.0).astype(np.int64)
        row = np.repeat(np.arange(len(count)), count)
        number = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
        width = ((right - left) / count)[row]
        left, right = left[row] + number * width, left[row] + (number + 1) * width
        member, line, (a, b), (low, high) = member[row], line[row], (a[row], b[row]), (low[row], high[row])
        fan = cuts.fan[member]
        ends = np.stack([fans.places(fan, x, height(x)) for x in (left, right)], axis=1)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        arriving = (
            beam.line.power[line] * self.reflectance[beam.line.triangle[line]] * (right - left) * fans.length[fan]
        )
        good = length > SHORTEST_LINE * self._reach
        light = fans.light[fan][good]
        triangle = cuts.triangle[member][good]
        return _Beam(_lit_lines(self._planes, ends[good], triangle, (arriving[good] / length[good]), light), light)

    def _sheet_keys(self, beam: _Beam) -> Float64:
        """Return rows that are equal for lines with the same mirrored sheet."""
        line, light = beam.line, beam.light.copy()
        start, mirror = line.ends[:, 0], self._planes[line.triangle]
        across = np.cross(line.ends[:, 1] - start, light[:, :3] - light[:, 3:] * start)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        planes = []
        for normal in (mirror, across):
            largest = np.take_along_axis(normal, np.abs(normal).argmax(axis=1)[:, None], axis=1)
            normal = normal * np.sign(largest)
            planes += [normal, np.sum(normal * start, axis=1, keepdims=True) / self._reach]
        light[:, :3] /= np.where(light[:, 3:] != 0.0, self._reach, 1.0)
        return np.round(np.hstack([*planes, light]), self.limits.sheet_decimals) + 0.0

    def _cuts(self, fans: _MirroredSheets) -> _SheetCuts:
        """Return the cuts of mirrored sheets through the scene's triangles beyond their mirrors."""
        blocks, found = self._blocks, []
        step = max(_MAX_PAIRS // max(len(blocks.radius), 1), 1)
        for first in range(0, len(fans.length), step):
            some = slice(first, first + step)
            plane_distance = fans.across[some] @ blocks.middle.T - np.sum(fans.across * fans.start, axis=1)[some, None]
            fan, block = np.nonzero(
                np.abs(plane_distance) <= blocks.radius * (1.0 + 1e-9) + self.limits.on_mirror * self._reach
            )
            fan, block = fans.reachable(fan + first, block, blocks)
            count = np.diff(blocks.start)[block]
            triangle = blocks.order[concatenated_ranges(blocks.start[block], count)]
            found.append(
                _cut_triangles(
                    fans, np.repeat(fan, count), self.scene.corners, triangle, self._reach, self.limits.on_mirror
                )
            )
        return _SheetCuts(*(np.concatenate(column) for column in zip(*found, strict=True)))

    # ---- curved mirrors: rays ----------------------------------------------------------------------------------

    def _reflect_by_curves(self, beam: _Beam) -> _Beam:
        """Return the lines lit by curved mirrors; the light is even between two neighbouring rays."""
        if not len(beam.light):
            return beam
        count = np.maximum(np.ceil(beam.line.lengths / self.step), 1).astype(np.int64)
        row = np.repeat(np.arange(len(count)), count)
        number = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
        share = np.stack([number, number + 1], axis=1) / count[row, None]
        found = []
        for left in range(self.limits.max_halvings, -1, -1):
            if not len(row):
                break
            spots, towards, triangle = self._reflected(beam, row, share)
            same = (triangle[:, 0] == triangle[:, 1]) & (triangle[:, 0] >= 0)
            if same.any():
                found.append(
                    self._between_rays(beam, row[same], share[same], spots[same], towards[same], triangle[same])
                )
            differs = (triangle[:, 0] != triangle[:, 1]) & (left > 0)
            middle = share[differs].mean(axis=1)
            row = np.tile(row[differs], 2)
            share = np.concatenate(
                [np.column_stack([share[differs, 0], middle]), np.column_stack([middle, share[differs, 1]])]
            )
        return _concatenate([_select(beam, np.zeros(0, np.int64)), *found])

    def _between_rays(
        self, beam: _Beam, row: Integers, share: Float64, spots: Float64, towards: Float64, triangle: Integers
    ) -> _Beam:
        length = np.linalg.norm(spots[:, 1] - spots[:, 0], axis=1)
        arriving = beam.line.power * beam.line.lengths * self.reflectance[beam.line.triangle]
        arriving = arriving[row] * (share[:, 1] - share[:, 0])
        good = length > SHORTEST_LINE * self._reach
        # The piece is short: its light counts as parallel.
        light = np.column_stack([-towards.mean(axis=1), np.zeros(len(row))])[good]
        power = arriving[good] / length[good]
        return _Beam(_lit_lines(self._planes, spots[good], triangle[good, 0], power, light), light)

    def _reflected(self, beam: _Beam, row: Integers, share: Float64) -> tuple[Float64, Float64, Integers]:
        """Return the points that the light of fractions of lines meets, its directions, and the triangles (or -1)."""
        mirror = beam.line.triangle[row]
        ends = beam.line.ends[row]
        flat = ends[:, :1] + share[..., None] * (ends[:, 1:] - ends[:, :1])
        place, normal, bulge = self._on_smooth(flat, mirror)
        light = beam.light[row][:, None]
        coming = light[..., 3:] * flat - light[..., :3]
        coming = coming / np.linalg.norm(coming, axis=-1, keepdims=True)
        slope = np.sum(coming * normal, axis=-1, keepdims=True)
        towards = coming - 2.0 * slope * normal
        start = place + (2.0 * bulge / np.maximum(np.abs(slope[..., 0]), 1e-9) + self.clearance)[..., None] * towards
        rays = np.concatenate([start, towards], axis=-1).reshape(-1, 6)
        hits = run_with_row_padding(ClosestHit(scene=self.scene, clearance=self.clearance), self.device, rays)
        hit = hits.triangle >= 0
        spots = rays[:, :3] + np.where(hit, hits.distance, 0.0)[:, None] * rays[:, 3:]
        return spots.reshape(-1, 2, 3), towards, hits.triangle.reshape(-1, 2).astype(np.int64)

    def _on_smooth(self, flat: Float64, triangle: Integers) -> tuple[Float64, Float64, Float64]:
        """Return the points and normals of the smooth surface over points (k, 2, 3) of triangles, and the bulge."""
        corners, normals = self.scene.corners[triangle], self.normals[triangle]
        weights = _barycentric(corners, flat)
        below = np.sum((flat[:, :, None] - corners[:, None]) * normals[:, None], axis=-1)
        lift = -0.5 * np.einsum("kpi,kij->kpj", weights * below, normals)
        normal = np.einsum("kpi,kij->kpj", weights, normals)
        return flat + lift, normal / np.linalg.norm(normal, axis=-1, keepdims=True), np.linalg.norm(lift, axis=-1)

    @functools.cached_property
    def _reach(self) -> float:
        return float(np.abs(self.scene.corners[self.scene.bvh.numbers]).max(initial=0.0)) or 1.0

    @functools.cached_property
    def _blocks(self) -> TriangleBlocks:
        numbers = self.scene.bvh.numbers
        corners = self.scene.corners[numbers]
        blocks = TriangleBlocks.of(corners, np.broadcast_to((0.0, 0.0, 1.0), corners.shape))
        return blocks._replace(order=numbers[blocks.order])

    @functools.cached_property
    def _planes(self) -> Float64:
        corners = self.scene.corners
        with np.errstate(all="ignore"):
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


class _MirroredSheets(NamedTuple):
    """Mirrored sheets. The coordinate x, 0 to 1, is the fraction of the lit line whose light a point gets."""

    start: Float64  # (f, 3): one end of the lit line
    along: Float64  # (f, 3): to the other end
    light: Float64  # (f, 4): mirror image of the source, or of the direction
    length: Float64  # (f,) of the lit line

    @property
    def back(self) -> Float64:
        """Vectors from the start towards the light, (f, 3)."""
        return np.asarray(self.light[:, :3] - self.light[:, 3:] * self.start)

    @property
    def basis(self) -> Float64:
        """Matrices that turn a vector from the start into multiples of along and back, (f, 2, 3)."""
        return np.linalg.pinv(np.stack([self.along, self.back], axis=2))

    def reachable(self, fan: Integers, block: Integers, blocks: TriangleBlocks) -> tuple[Integers, Integers]:
        """Return the pairs of a sheet and a block in its plane that the light may reach."""
        p, q = np.moveaxis(self.basis[fan], 1, 0)
        away, radius = blocks.middle[block] - self.start[fan], blocks.radius[block] * (1.0 + 1e-9)
        spread = np.where(self.is_point[fan], 1.0, 0.0)[:, None]
        # Depth beyond the mirror, distance of x from 0, and of x from 1: linear functions, positive where light can be.
        inside = np.ones(len(fan), bool)
        for offset, slope in ((0.0, -q), (0.0, p), (1.0, -p - spread * q)):
            inside &= offset + np.sum(slope * away, axis=1) >= -radius * np.linalg.norm(slope, axis=1)
        return fan[inside], block[inside]

    @property
    def across(self) -> Float64:
        """Unit normals of the sheets, (f, 3)."""
        normal = np.cross(self.along, self.back)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))

    @property
    def is_point(self) -> npt.NDArray[np.bool_]:
        """Whether the light is emitted by a point source, (f,)."""
        return np.asarray(self.light[:, 3] != 0.0)

    def places(self, fan: Integers, x: Float64, height: Float64) -> Float64:
        """Return the points at x and a height: minus the depth beyond the mirror, or 1 / (distance from the source)."""
        on_line = self.start[fan] + x[:, None] * self.along[fan]
        light = self.light[fan]
        with np.errstate(divide="ignore", invalid="ignore"):
            from_point = light[:, :3] + (on_line - light[:, :3]) / height[:, None]
        parallel = on_line + height[:, None] * light[:, :3]
        return np.asarray(np.where(self.is_point[fan][:, None], from_point, parallel))


class _SheetCuts(NamedTuple):
    """Cuts of mirrored sheets through triangles: index of the sheet and the triangle, x and height of both ends."""

    fan: Integers
    triangle: Integers
    x: Float64
    height: Float64


def _mirrored_sheets(beam: _Beam, first: Integers, group: Integers, planes: Float64) -> tuple[_MirroredSheets, Float64]:
    """Return the mirrored sheet of each group of lines on one line, and x of the lines' own ends."""
    line = beam.line
    along = line.ends[first, 1] - line.ends[first, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    at = np.sum((line.ends - line.ends[first[group], :1][:, 0][:, None]) * along[group][:, None], axis=-1)
    low, high = np.minimum.reduceat(at.min(axis=1), first), np.maximum.reduceat(at.max(axis=1), first)
    length = high - low
    start = line.ends[first, 0] + low[:, None] * along
    normal, light = planes[line.triangle[first]], beam.light[first].copy()
    above = np.sum(normal * (light[:, :3] - light[:, 3:] * start), axis=1, keepdims=True)
    light[:, :3] -= 2.0 * above * normal
    return _MirroredSheets(start, along * length[:, None], light, length), (at - low[group][:, None]) / length[group][
        :, None
    ]


def _cut_triangles(
    fans: _MirroredSheets, fan: Integers, corners: Float64, triangle: Integers, reach: float, on_mirror: float
) -> _SheetCuts:
    """Cut triangles with sheets, pair by pair, and keep the parts beyond the mirror and within the light."""
    points = corners[triangle] - fans.start[fan][:, None]
    across = fans.across[fan][:, None]
    # Explicit products and not a matrix product: neighbours get the same rounding for a corner that they share.
    distance = points[..., 0] * across[..., 0] + points[..., 1] * across[..., 1] + points[..., 2] * across[..., 2]
    below = distance < 0.0
    crossing = below.any(axis=1) & ~below.all(axis=1)
    fan, triangle, below = fan[crossing], triangle[crossing], below[crossing]
    points, distance = points[crossing], distance[crossing]
    # The corner that is alone on its side of the sheet, and the other two.
    lone = np.where(below.sum(axis=1) == 1, np.argmax(below, axis=1), np.argmin(below, axis=1))
    row, ends = np.arange(len(fan)), []
    for step in (1, 2):
        other = (lone + step) % 3
        # An edge is cut from its lower to its upper corner, so that both of its triangles get the same point.
        swap = distance[row, lone] > distance[row, other]
        low, high = np.where(swap, other, lone), np.where(swap, lone, other)
        share = (distance[row, low] / (distance[row, low] - distance[row, high]))[:, None]
        ends.append(points[row, low] + share * (points[row, high] - points[row, low]))
    place, light = np.stack(ends, axis=1), fans.light[fan]
    # place = p along + q back, in the plane of the two.
    p, q = np.moveaxis(np.einsum("fij,fpj->fpi", fans.basis[fan], place), -1, 0)
    # Beyond the mirror q is negative. Rays from a source are 1 - q times as far apart as at the mirror.
    is_point = light[:, 3] != 0.0
    p, depth, kept = _clip_beyond(p, -q, on_mirror * np.where(is_point, 1.0, reach))
    fan, triangle, is_point = fan[kept], triangle[kept], is_point[kept, None]
    wide = np.where(is_point, 1.0 + depth, 1.0)
    x, height = p / wide, np.where(is_point, 1.0 / wide, -depth)
    order = np.argsort(x, axis=1, kind="stable")
    x, height = np.take_along_axis(x, order, axis=1), np.take_along_axis(height, order, axis=1)
    inside = (x[:, 1] > 0.0) & (x[:, 0] < 1.0)
    return _SheetCuts(fan[inside], triangle[inside], x[inside], height[inside])


def _clip_beyond(p: Float64, depth: Float64, least: Float64) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
    """Clip segments to depths beyond the least one; the last result is the mask of segments that remain."""
    under = depth < least[:, None]
    kept = np.asarray(~under.all(axis=1))
    p, depth, least, under = p[kept].copy(), depth[kept].copy(), least[kept], under[kept]
    rows, start = np.nonzero(under)
    share = (least[rows] - depth[rows, start]) / (depth[rows, 1 - start] - depth[rows, start])
    p[rows, start] += share * (p[rows, 1 - start] - p[rows, start])
    depth[rows, start] = least[rows]
    return p, depth, kept


def _barycentric(corners: Float64, places: Float64) -> Float64:
    """Return the barycentric weights of points (k, p, 3) in triangles (k, 3, 3), (k, p, 3)."""
    edges = corners[:, 1:] - corners[:, :1]
    weights = np.einsum("kij,kpj->kpi", np.swapaxes(np.linalg.pinv(edges), 1, 2), places - corners[:, :1])
    return np.concatenate([1.0 - weights.sum(axis=-1, keepdims=True), weights], axis=-1)


def _light_position(sheet: LightSheet, L: float) -> Float64:
    """Return the source or the direction of a sheet's light at a transport, (4,), as in `_Beam`."""
    move = sheet.transport
    axes = np.array([move.g_axis, move.h_axis])
    if sheet.source is None:
        return np.append(axes[1] / np.linalg.norm(axes[1]), 0.0)
    source = np.array(move.origin) + np.array(sheet.source) @ axes + L * np.array(move.direction)
    return np.append(source, 1.0)


def _lit_lines(normals: Float64, ends: Float64, triangle: Integers, power: Float64, light: Float64) -> LitLine:
    """Return lit lines with normals on the side of the light."""
    normal = normals[triangle]
    towards = light[:, :3] - light[:, 3:] * ends.mean(axis=1)
    side = np.sum(normal * towards, axis=1, keepdims=True)
    return LitLine(ends, np.where(side < 0.0, -normal, normal), triangle, power)


def _empty_line() -> LitLine:
    return LitLine(np.zeros((0, 2, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))


def _select(beam: _Beam, which: npt.NDArray[Any]) -> _Beam:
    return _Beam(beam.line.select(which), beam.light[which])


def _concatenate(beams: list[_Beam]) -> _Beam:
    lines = LitLine(*(np.concatenate(each) for each in zip(*(beam.line for beam in beams), strict=True)))
    return _Beam(lines, np.concatenate([beam.light for beam in beams]))
