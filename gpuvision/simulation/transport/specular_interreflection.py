"""Light that lit lines on mirrors throw on other surfaces: further lit lines."""

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
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.mirror_points import Blocks
from gpuvision.simulation.transport.sheet_cut import ranges

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Pairs of a sheet and a block of triangles that are looked at in one go.
_PAIRS = 2_000_000
# Mirrored sheets that agree to so many digits, in sizes of the scene, are one.
_DIGITS = 11
# What is as near to the mirror, in distances of the source or sizes of the scene, lies on it.
_ON_IT = 1e-12
_HALVINGS = 12


class _Beam(NamedTuple):
    """Lit lines, and where each one's light comes from: a source (w = 1), or a direction towards it (w = 0)."""

    line: LitLine
    light: Float64  # (m, 4)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpecularInterreflection:
    """The mirrors of a scene as they throw light on; see `Mirrors.thrown`.

    Parameters
    ----------
    scene
        All surfaces.
    reflectance
        (n,): share that a triangle throws on.
    normals
        (n, 3, 3): normals at the corners of curved triangles.
    is_curved
        (n,): which are.
    step
        How far apart the rays are that a curved mirror throws on, on the lit line [m].
    clearance
        Of rays from surfaces [m].
    device
        Where rays are traced.
    """

    scene: Scene
    reflectance: Float64
    normals: Float64
    is_curved: npt.NDArray[np.bool_]
    step: float
    clearance: float
    device: Device

    def after(self, lit: LitLine, sheet: LightSheet, place: float, throws: int) -> LitLine:
        """Return what is lit after one mirror, two, ... up to so many, of light from a sheet at a transport [m]."""
        beam, found = _Beam(lit, np.tile(_light_of(sheet, place), (len(lit.power), 1))), []
        for _ in range(throws):
            share = self.reflectance[beam.line.triangle]
            beam = _those(beam, np.flatnonzero(share > 0.0))
            if not len(beam.light):
                break
            curved = self.is_curved[beam.line.triangle]
            beam = _joined(
                [self._by_planes(_those(beam, ~curved), sheet.uniformity), self._by_curves(_those(beam, curved))]
            )
            found.append(beam)
        return _joined([_Beam(_no_line(), np.zeros((0, 4))), *found]).line

    # ---- plane mirrors: the mirrored sheet cuts the scene ------------------------------------------------------

    def _by_planes(self, beam: _Beam, uniformity: float) -> _Beam:
        """Throw on what falls on plane mirrors: together what falls on one plane in one sheet from one place."""
        if not len(beam.light):
            return beam
        group = np.unique(self._keys(beam), axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(group, kind="stable")
        beam, group = _those(beam, order), group[order]
        first = np.flatnonzero(np.diff(group, prepend=-1))
        fans, at = _fans_of(beam, first, group, self._planes)
        cuts = self._cuts(fans)
        pieces = upper_envelope(cuts.fan, cuts.x, cuts.height)
        # Each piece, with each lit line of its mirror whose light falls on it.
        fan = cuts.fan[pieces.member]
        begin, count = first[fan], np.diff(first, append=len(group))[fan]
        member = np.repeat(np.arange(len(fan)), count)
        line = np.arange(len(member)) + np.repeat(begin - (np.cumsum(count) - count), count)
        left = np.maximum(pieces.left[member], at[line].min(axis=1))
        right = np.minimum(pieces.right[member], at[line].max(axis=1))
        kept = left < right
        member, line, left, right = pieces.member[member][kept], line[kept], left[kept], right[kept]
        return self._landed(beam, fans, cuts, (member, line, left, right), uniformity)

    def _landed(
        self,
        beam: _Beam,
        fans: _Fans,
        cuts: _Cuts,
        pieces: tuple[Integers, Integers, Float64, Float64],
        uniformity: float,
    ) -> _Beam:
        """Turn pieces (of which cut, lit by which line, from x to x) into lit lines."""
        member, line, left, right = pieces
        (a, b), (low, high) = cuts.x[member].T, cuts.height[member].T

        def height(x: Float64) -> Float64:
            return np.asarray(low + (x - a) / (b - a) * (high - low))

        dense = np.stack([height(left), height(right)]) ** 2 if fans.is_point.any() else np.ones((2, len(member)))
        dense[:, ~fans.is_point[cuts.fan[member]]] = 1.0
        change = np.abs(dense[1] - dense[0]) / dense.max(axis=0, initial=1e-300)
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
        good = length > 0.0
        light = fans.light[fan][good]
        triangle = cuts.triangle[member][good]
        return _Beam(_lit(self._planes, ends[good], triangle, (arriving[good] / length[good]), light), light)

    def _keys(self, beam: _Beam) -> Float64:
        """Return rows that are equal for lines which one mirrored sheet stands for."""
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
        return np.round(np.hstack([*planes, light]), _DIGITS) + 0.0

    def _cuts(self, fans: _Fans) -> _Cuts:
        """Return where mirrored sheets cut the scene's triangles beyond their mirrors."""
        blocks, found = self._blocks, []
        step = max(_PAIRS // max(len(blocks.radius), 1), 1)
        for first in range(0, len(fans.length), step):
            some = slice(first, first + step)
            off = fans.across[some] @ blocks.middle.T - np.sum(fans.across * fans.start, axis=1)[some, None]
            fan, block = np.nonzero(np.abs(off) <= blocks.radius * (1.0 + 1e-9) + _ON_IT * self._reach)
            fan, block = fans.reached(fan + first, block, blocks)
            count = np.diff(blocks.start)[block]
            triangle = blocks.order[ranges(blocks.start[block], count)]
            found.append(_cut(fans, np.repeat(fan, count), self.scene.corners, triangle, self._reach))
        return _Cuts(*(np.concatenate(column) for column in zip(*found, strict=True)))

    # ---- curved mirrors: rays ----------------------------------------------------------------------------------

    def _by_curves(self, beam: _Beam) -> _Beam:
        """Throw on what falls on curved mirrors, as even between rays a step apart."""
        if not len(beam.light):
            return beam
        count = np.maximum(np.ceil(beam.line.lengths / self.step), 1).astype(np.int64)
        row = np.repeat(np.arange(len(count)), count)
        number = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
        share = np.stack([number, number + 1], axis=1) / count[row, None]
        found = []
        for left in range(_HALVINGS, -1, -1):
            if not len(row):
                break
            spots, towards, triangle = self._reflected(beam, row, share)
            same = (triangle[:, 0] == triangle[:, 1]) & (triangle[:, 0] >= 0)
            if same.any():
                found.append(
                    self._between_rays(beam, row[same], share[same], spots[same], towards[same], triangle[same])
                )
            apart = (triangle[:, 0] != triangle[:, 1]) & (left > 0)
            middle = share[apart].mean(axis=1)
            row = np.tile(row[apart], 2)
            share = np.concatenate(
                [np.column_stack([share[apart, 0], middle]), np.column_stack([middle, share[apart, 1]])]
            )
        return _joined([_those(beam, np.zeros(0, np.int64)), *found])

    def _between_rays(
        self, beam: _Beam, row: Integers, share: Float64, spots: Float64, towards: Float64, triangle: Integers
    ) -> _Beam:
        length = np.linalg.norm(spots[:, 1] - spots[:, 0], axis=1)
        arriving = beam.line.power * beam.line.lengths * self.reflectance[beam.line.triangle]
        arriving = arriving[row] * (share[:, 1] - share[:, 0])
        good = length > 0.0
        # The light of so short a piece is parallel.
        light = np.column_stack([-towards.mean(axis=1), np.zeros(len(row))])[good]
        power = arriving[good] / length[good]
        return _Beam(_lit(self._planes, spots[good], triangle[good, 0], power, light), light)

    def _reflected(self, beam: _Beam, row: Integers, share: Float64) -> tuple[Float64, Float64, Integers]:
        """Return where the light of places on lit lines arrives, its direction, and the triangle (-1: none)."""
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
        met = hits.triangle >= 0
        spots = rays[:, :3] + np.where(met, hits.distance, 0.0)[:, None] * rays[:, 3:]
        return spots.reshape(-1, 2, 3), towards, hits.triangle.reshape(-1, 2).astype(np.int64)

    def _on_smooth(self, flat: Float64, triangle: Integers) -> tuple[Float64, Float64, Float64]:
        """Return the smooth surface's place and unit normal above places (k, 2, 3) of triangles, and its bulge."""
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
    def _blocks(self) -> Blocks:
        there = self.scene.bvh.numbers
        corners = self.scene.corners[there]
        blocks = Blocks.of(corners, np.broadcast_to((0.0, 0.0, 1.0), corners.shape))
        return blocks._replace(order=there[blocks.order])

    @functools.cached_property
    def _planes(self) -> Float64:
        corners = self.scene.corners
        with np.errstate(all="ignore"):
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


class _Fans(NamedTuple):
    """Mirrored sheets: x is the share of the lit line, from 0 to 1, whose light a place gets."""

    start: Float64  # (f, 3): one end of the lit line
    along: Float64  # (f, 3): to the other end
    light: Float64  # (f, 4): where the light seems to come from
    length: Float64  # (f,) of the lit line

    @property
    def back(self) -> Float64:
        """From the start towards the light, (f, 3)."""
        return np.asarray(self.light[:, :3] - self.light[:, 3:] * self.start)

    @property
    def basis(self) -> Float64:
        """What turns a place from the start into multiples of along and back, (f, 2, 3)."""
        return np.linalg.pinv(np.stack([self.along, self.back], axis=2))

    def reached(self, fan: Integers, block: Integers, blocks: Blocks) -> tuple[Integers, Integers]:
        """Return those pairs of a sheet and a block, cut by its plane, that the light may reach."""
        p, q = np.moveaxis(self.basis[fan], 1, 0)
        away, radius = blocks.middle[block] - self.start[fan], blocks.radius[block] * (1.0 + 1e-9)
        spread = np.where(self.is_point[fan], 1.0, 0.0)[:, None]
        # The way beyond the mirror, x from 0, and x to 1, each positive there and linear in the place.
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
        return np.asarray(self.light[:, 3] != 0.0)

    def places(self, fan: Integers, x: Float64, height: Float64) -> Float64:
        """Return the place at x and a height: minus the way from the mirror, or one over the ways from the source."""
        on_line = self.start[fan] + x[:, None] * self.along[fan]
        light = self.light[fan]
        with np.errstate(divide="ignore", invalid="ignore"):
            from_point = light[:, :3] + (on_line - light[:, :3]) / height[:, None]
        parallel = on_line + height[:, None] * light[:, :3]
        return np.asarray(np.where(self.is_point[fan][:, None], from_point, parallel))


class _Cuts(NamedTuple):
    """Where mirrored sheets cut triangles: which sheet and triangle, x and height of both ends, from left to right."""

    fan: Integers
    triangle: Integers
    x: Float64
    height: Float64


def _fans_of(beam: _Beam, first: Integers, group: Integers, planes: Float64) -> tuple[_Fans, Float64]:
    """Return the mirrored sheet of each group of lines, which lie on one line, and the lines' own ends in its x."""
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
    return _Fans(start, along * length[:, None], light, length), (at - low[group][:, None]) / length[group][:, None]


def _cut(fans: _Fans, fan: Integers, corners: Float64, triangle: Integers, reach: float) -> _Cuts:
    """Cut triangles with sheets, pair by pair, and keep what lies beyond the mirror and within the light."""
    points = corners[triangle] - fans.start[fan][:, None]
    across = fans.across[fan][:, None]
    # Each product by itself: neighbours find the same for the corner that they share.
    off = points[..., 0] * across[..., 0] + points[..., 1] * across[..., 1] + points[..., 2] * across[..., 2]
    below = off < 0.0
    crossing = below.any(axis=1) & ~below.all(axis=1)
    fan, triangle, below = fan[crossing], triangle[crossing], below[crossing]
    points, off = points[crossing], off[crossing]
    # Of each triangle the corner alone on its side, and the other two.
    lone = np.where(below.sum(axis=1) == 1, np.argmax(below, axis=1), np.argmin(below, axis=1))
    row, ends = np.arange(len(fan)), []
    for step in (1, 2):
        other = (lone + step) % 3
        # The edge that two share is cut in one place: from below upwards.
        swap = off[row, lone] > off[row, other]
        low, high = np.where(swap, other, lone), np.where(swap, lone, other)
        share = (off[row, low] / (off[row, low] - off[row, high]))[:, None]
        ends.append(points[row, low] + share * (points[row, high] - points[row, low]))
    place, light = np.stack(ends, axis=1), fans.light[fan]
    # place = p along + q back, in the plane of the two.
    p, q = np.moveaxis(np.einsum("fij,fpj->fpi", fans.basis[fan], place), -1, 0)
    # Beyond the mirror q is negative; rays from a source are 1 - q times as far apart as there.
    is_point = light[:, 3] != 0.0
    p, depth, kept = _beyond(p, -q, _ON_IT * np.where(is_point, 1.0, reach))
    fan, triangle, is_point = fan[kept], triangle[kept], is_point[kept, None]
    wide = np.where(is_point, 1.0 + depth, 1.0)
    x, height = p / wide, np.where(is_point, 1.0 / wide, -depth)
    order = np.argsort(x, axis=1, kind="stable")
    x, height = np.take_along_axis(x, order, axis=1), np.take_along_axis(height, order, axis=1)
    inside = (x[:, 1] > 0.0) & (x[:, 0] < 1.0)
    return _Cuts(fan[inside], triangle[inside], x[inside], height[inside])


def _beyond(p: Float64, depth: Float64, least: Float64) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
    """Cut segments to where their depth is beyond the least; the last says which there are."""
    under = depth < least[:, None]
    kept = np.asarray(~under.all(axis=1))
    p, depth, least, under = p[kept].copy(), depth[kept].copy(), least[kept], under[kept]
    rows, near = np.nonzero(under)
    share = (least[rows] - depth[rows, near]) / (depth[rows, 1 - near] - depth[rows, near])
    p[rows, near] += share * (p[rows, 1 - near] - p[rows, near])
    depth[rows, near] = least[rows]
    return p, depth, kept


def _barycentric(corners: Float64, places: Float64) -> Float64:
    """Return the weights of corners (k, 3, 3) that make up places (k, p, 3) in their triangles, (k, p, 3)."""
    edges = corners[:, 1:] - corners[:, :1]
    weights = np.einsum("kij,kpj->kpi", np.swapaxes(np.linalg.pinv(edges), 1, 2), places - corners[:, :1])
    return np.concatenate([1.0 - weights.sum(axis=-1, keepdims=True), weights], axis=-1)


def _light_of(sheet: LightSheet, place: float) -> Float64:
    """Return where the light of a sheet at a transport comes from, (4,)."""
    move = sheet.transport
    axes = np.array([move.g_axis, move.h_axis])
    if sheet.source is None:
        return np.append(axes[1] / np.linalg.norm(axes[1]), 0.0)
    source = np.array(move.origin) + np.array(sheet.source) @ axes + place * np.array(move.direction)
    return np.append(source, 1.0)


def _lit(normals: Float64, ends: Float64, triangle: Integers, power: Float64, light: Float64) -> LitLine:
    """Return lit lines, their normals on the side of the light."""
    normal = normals[triangle]
    towards = light[:, :3] - light[:, 3:] * ends.mean(axis=1)
    side = np.sum(normal * towards, axis=1, keepdims=True)
    return LitLine(ends, np.where(side < 0.0, -normal, normal), triangle, power)


def _no_line() -> LitLine:
    return LitLine(np.zeros((0, 2, 3)), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))


def lines_of(line: LitLine, which: npt.NDArray[Any]) -> LitLine:
    """Return some of the lines."""
    return LitLine(line.ends[which], line.normals[which], line.triangle[which], line.power[which])


def _those(beam: _Beam, which: npt.NDArray[Any]) -> _Beam:
    return _Beam(lines_of(beam.line, which), beam.light[which])


def _joined(beams: list[_Beam]) -> _Beam:
    lines = LitLine(*(np.concatenate(each) for each in zip(*(beam.line for beam in beams), strict=True)))
    return _Beam(lines, np.concatenate([beam.light for beam in beams]))
