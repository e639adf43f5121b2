"""Specular interreflection of lit lines: mirror images of lines, and lines that mirrors project on other surfaces."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.rays import AnyHit
from gpuvision.simulation.scene.row_padding import run_with_row_padding
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.sensors.view_rays import check_materials
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_exposure import expose_lines
from gpuvision.simulation.transport.mirror_points import MirrorPoints
from gpuvision.simulation.transport.mirror_surfaces import DEFAULT_LIMITS, MirrorLimits, MirrorSurfaces
from gpuvision.simulation.transport.plane_mirrors import (
    heights_above,
    mirror_windows,
    reflect_points,
)
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges
from gpuvision.simulation.transport.specular_interreflection import SpecularInterreflection
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Images of a point in curved mirrors that the kernel has room for: at first, and at most (the count is one byte).
_FIRST_IMAGES, _MAX_IMAGES = 32, 255
# Largest difference of the images of a point in two triangles of an edge, relative to the scene, in single precision:
# EDGE of kernels/mirrors/mirrors.cl. In double precision the clearance is larger.
_SAME_IMAGE = 1e-5


class _MirroredParts(NamedTuple):
    """Parts of lines visible in mirrors: index of the line, of the mirror, and fractions of the line (k, 2)."""

    line: Integers
    mirror: Integers
    share: Float64


@dataclass(frozen=True, kw_only=True, eq=False)
class Mirrors:
    """Mirrors of a scene in view of a sensor; compared by identity.

    A triangle whose material has a `mirror` share reflects on both sides. Where the normals at its corners agree with
    the normal of the triangle, it is a plane mirror, and its images are exact. Otherwise it is part of a curved mirror.

    Parameters
    ----------
    view
        The sensor.
    scene, materials
        Surfaces, and a material for every number in `Scene.material`.
    normals
        (n, 3, 3): normals at the corners of all triangles; None: `smooth_normals` of the scene.
    steps_per_sample
        Number of steps in which a line in a curved mirror is imaged, per sample of the sensor as measured in the sheet.
        More than 0, default 2.
    max_reflections
        Largest number of mirrors that the light of the sheet meets one after another, 0 or more. Default 2.
    device
        Device of the kernels; None: `Device.best`.
    limits
        Numerical limits.

    Raises
    ------
    ValueError
        A triangle has no material; a parameter lies outside its range.

    Notes
    -----
    Plane mirrors: exact windows, visible intervals on both sides of the reflection, images divided exactly at the
    sensor's bins; errors are roundings. Curved mirrors: positions as `MirrorPoints` says, of second order in the step,
    and of first order where an image ends. Lines that the lens sees are diffuse reflectors of the material's albedo
    (`Lambert`); glossy lobes are not included. There is one mirror between line and lens. Light that curved mirrors
    reflect to other surfaces is traced by rays, one step apart.
    """

    view: SensorView
    scene: Scene
    materials: Sequence[Material]
    normals: Float64 | None = None
    steps_per_sample: float = 2.0
    max_reflections: int = 2
    device: Device | None = None
    limits: MirrorLimits = DEFAULT_LIMITS

    def __post_init__(self) -> None:
        check_materials(self.scene, self.materials)
        if self.normals is not None and np.shape(self.normals) != self.scene.corners.shape:
            raise ValueError(f"Mirrors.normals has shape {np.shape(self.normals)}, expected {self.scene.corners.shape}")
        if not self.steps_per_sample > 0.0 or not math.isfinite(self.steps_per_sample):
            raise ValueError(f"Mirrors.steps_per_sample is {self.steps_per_sample}, expected a number > 0")
        if self.max_reflections < 0:
            raise ValueError(f"Mirrors.max_reflections is {self.max_reflections}, expected 0 or more")

    def exposure(self, lit: LitLine, L: float, sheet: LightSheet | None = None, offset: float = 0.0) -> Exposure:
        """Return the light that reaches the sensor by way of a mirror, before or after a diffuse surface.

        Parameters
        ----------
        lit
            Lines that the sheet lights.
        L
            Transport of the sensor [m].
        sheet
            Sheet of light, for the lines that mirrors light on other surfaces; None: only lines seen in mirrors are
            included.
        offset
            Distance of the sheet from the sensor's transport [m]. Default 0.0.
        """
        if not self.has_mirrors:
            return self.view.dark()
        total = self.mirrored_exposure(lit, L)
        if sheet is None:
            return total
        reflected = self.reflected_lines(lit, sheet, L + offset)
        return total + self.direct_exposure(reflected, L) + self.mirrored_exposure(reflected, L)

    @functools.cached_property
    def has_mirrors(self) -> bool:
        """Whether any triangle reflects."""
        return bool(self._surfaces.reflects.any())

    # ---- diffuse lines ---------------------------------------------------------------------------------------

    def mirrored_exposure(self, lit: LitLine, L: float) -> Exposure:
        """Return the exposure by lit lines that the sensor sees in mirrors, as diffuse lines."""
        exitance = self._exitance(lit)
        shining = np.flatnonzero(exitance > 0.0)
        lit, exitance = lit.select(shining), exitance[shining]
        if not len(exitance):
            return self.view.dark()
        return self._plane_exposure(lit, exitance, L) + self._curved_exposure(lit, exitance, L)

    def direct_exposure(self, lit: LitLine, L: float) -> Exposure:
        """Return the exposure by lit lines that the sensor sees without a mirror, as diffuse lines."""
        exitance = self._exitance(lit)
        shining = np.flatnonzero(exitance > 0.0)
        lit, exitance = lit.select(shining), exitance[shining]
        if not len(exitance):
            return self.view.dark()
        lens = self.view.lens_at(L)
        fractions = np.tile([0.0, 1.0], (len(exitance), 1))
        apex = np.broadcast_to(lens, (len(exitance), 3))
        row, share = self._visible(apex, lit.ends, np.zeros((len(exitance), 2)), fractions)
        ends = _between(lit.ends[row], share)
        return self._expose(ends, lit.normals[row], exitance[row], L)

    def _exitance(self, lit: LitLine) -> Float64:
        """Return the diffuse exitance of the lines [W/m]."""
        albedos = np.array([each.albedo for each in self.materials])
        return np.asarray(lit.power * albedos[self._surfaces.material[lit.triangle]])

    def _expose(self, ends: Float64, normals: Float64, exitance: Float64, L: float) -> Exposure:
        """Return the exposure by diffuse lines, or their mirror images, that are visible from end to end."""
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        lens = self.view.lens_at(L)

        def power_on_line(line: Integers, at: Float64) -> Float64:
            place = ends[line, 0] + at[:, None] * (ends[line, 1] - ends[line, 0])
            towards = lens - place
            cosine = np.sum(towards * normals[line], axis=1) / np.linalg.norm(towards, axis=1)
            intensity = exitance[line] / math.pi * np.maximum(cosine, 0.0) * length[line]
            return np.asarray(intensity * self.view.aperture_solid_angle(place, L))

        return expose_lines(self.view, L, ends, power_on_line)

    # ---- plane mirrors ---------------------------------------------------------------------------------------

    def _plane_exposure(self, lit: LitLine, exitance: Float64, L: float) -> Exposure:
        if not len(self._surfaces.flat):
            return self.view.dark()
        visible = self._visible_in_planes(lit, L)
        if not len(visible.line):
            return self.view.dark()
        planes = self._surfaces.planes[visible.mirror]
        ends = reflect_points(_between(lit.ends[visible.line], visible.share), planes[:, None])
        reflectance = self._surfaces.reflectance_of(self._surfaces.flat[visible.mirror])
        normals = lit.normals[visible.line]
        turned = normals - 2.0 * np.sum(normals * planes[:, :3], axis=1, keepdims=True) * planes[:, :3]
        return self._expose(ends, turned, exitance[visible.line] * reflectance, L)

    def _visible_in_planes(self, lit: LitLine, L: float) -> _MirroredParts:
        """Return the parts of lines that the lens sees in plane mirrors, unoccluded before and after the reflection."""
        lens = self.view.lens_at(L)
        line, mirror, share = mirror_windows(
            lens,
            lit.ends,
            self._surfaces.facets.corners,
            self._surfaces.planes,
            *self._candidate_pairs(lit, lens),
            min_height=self.limits.min_height,
        )
        # The lit side of the line must face the mirror image of the lens.
        apex = reflect_points(lens, self._surfaces.planes[mirror])
        facing = np.sum((apex - lit.ends[line].mean(axis=1)) * lit.normals[line], axis=1) > 0.0
        line, mirror, share, apex = line[facing], mirror[facing], share[facing], apex[facing]
        up = np.abs(heights_above(lens, self._surfaces.planes[mirror]))
        ends = _between(lit.ends[line], share)
        away = np.abs(heights_above(ends, self._surfaces.planes[mirror][:, None]))
        mirror_fraction = up[:, None] / (up[:, None] + away)
        row, beyond_mirror = self._visible(apex, ends, mirror_fraction, np.tile([0.0, 1.0], (len(line), 1)))
        line, mirror, share, apex, mirror_fraction = line[row], mirror[row], share[row], apex[row], mirror_fraction[row]
        # Points where the lines from the lens' mirror image (the apex) to the ends cross the mirror.
        ends = _between(ends[row], beyond_mirror)
        mirror_fraction = 1.0 / (
            (1.0 - beyond_mirror) / mirror_fraction[:, :1] + beyond_mirror / mirror_fraction[:, 1:]
        )
        on_mirror = apex[:, None] + mirror_fraction[..., None] * (ends - apex[:, None])
        low, width = share[:, :1], np.diff(share)
        share = low + width * beyond_mirror
        lenses = np.broadcast_to(lens, apex.shape)
        row, before = self._visible(lenses, on_mirror, np.zeros(share.shape), np.tile([0.0, 1.0], (len(row), 1)))
        # Equal fractions on the mirror are not equal on the line: a perspective map converts them.
        mirror_fraction, share = mirror_fraction[row], share[row]
        weight = np.stack([1.0 - before, before], axis=-1) * mirror_fraction[:, None, :]
        before = weight[..., 1] / weight.sum(axis=-1)
        return _MirroredParts(line[row], mirror[row], share[:, :1] + np.diff(share) * before)

    def _candidate_pairs(self, lit: LitLine, lens: Float64) -> tuple[Integers, Integers]:
        """Return the pairs of a line and a plane mirror in which it may be visible."""
        blocks = self._surfaces.facets.blocks
        line, block = np.nonzero(self._run(self._surfaces.facets, lit.ends.reshape(-1, 6), lens).near)
        count = np.diff(blocks.start)[block]
        line, mirror = np.repeat(line, count), blocks.order[concatenated_ranges(blocks.start[block], count)]
        is_front = heights_above(lens, self._surfaces.planes) * self._surfaces.sides[self._surfaces.flat] >= 0.0
        return line[is_front[mirror]], mirror[is_front[mirror]]

    def _visible(self, apex: Float64, ends: Float64, near: Float64, share: Float64) -> tuple[Integers, Float64]:
        """Return the visible parts of segments (k, 2, 3): index of the segment, and fractions of its length."""
        rows, parts = [np.zeros(0, np.int64)], [np.zeros((0, 2))]
        row = np.arange(len(apex))
        for _ in range(self.limits.max_halvings):
            if not len(row):
                break
            some = _between(ends[row], share)
            nears = 1.0 / ((1.0 - share) / np.maximum(near[row, :1], 1e-30) + share / np.maximum(near[row, 1:], 1e-30))
            result = self._run(self._fans, np.hstack([apex[row], some.reshape(-1, 6), nears]))
            which, slot = np.nonzero(np.arange(result.intervals.shape[1]) < result.interval_count[:, None])
            rows.append(row[which])
            low, width = share[which, :1], np.diff(share[which])
            parts.append(low + width * result.intervals[which, slot])
            overflowed = np.flatnonzero(result.status)
            row, middle = np.tile(row[overflowed], 2), share[overflowed].mean(axis=1)
            share = np.concatenate(
                [np.column_stack([share[overflowed, 0], middle]), np.column_stack([middle, share[overflowed, 1]])]
            )
        return np.concatenate(rows), np.concatenate(parts)

    # ---- curved mirrors --------------------------------------------------------------------------------------

    def _curved_exposure(self, lit: LitLine, exitance: Float64, L: float) -> Exposure:
        if not len(self._surfaces.curved):
            return self.view.dark()
        line, share = _steps(lit.lengths, self.step)
        place = _between(lit.ends[line], share)
        move, middle = place[:, 1] - place[:, 0], place.mean(axis=1)
        lens = self.view.lens_at(L)
        point, spot, spot_move, density, triangle = self._images(np.hstack([middle, move]), lens)
        origin = middle[point]
        towards = spot - origin
        distance = np.linalg.norm(towards, axis=1)
        cosine = np.sum(towards * lit.normals[line[point]], axis=1) / distance
        good = (cosine > 0.0) & np.isfinite(density)
        good[good] = self._is_unobstructed(origin[good], spot[good], lens, triangle[good])
        point, spot, spot_move, density, triangle, cosine = (
            each[good] for each in (point, spot, spot_move, density, triangle, cosine)
        )
        source = line[point]
        intensity = exitance[source] / math.pi * cosine * np.linalg.norm(move[point], axis=1)
        # Aperture and cosine at the lens follow from the spot's direction; the mirror changes the solid angle.
        square = np.sum((spot - lens) ** 2, axis=1) * density
        power = intensity * self._surfaces.reflectance_of(triangle) * self.view.aperture_solid_angle(spot, L) * square
        ends = np.stack([spot - 0.5 * spot_move, spot + 0.5 * spot_move], axis=1)
        return expose_lines(self.view, L, ends, lambda line, at: power[line])

    def _images(self, points: Float64, lens: Float64) -> tuple[Integers, Float64, Float64, Float64, Integers]:
        """Return images of points in curved mirrors: index of the point, position, motion, density, triangle."""
        found: list[tuple[Any, ...]] = []
        row, kept = np.arange(len(points)), _FIRST_IMAGES
        while len(row):
            images = self._run(self._points(kept), points[row], lens)
            # Points with more images than the kernel has room for are searched again with more room.
            more = (images.status & Status.AMBIGUOUS != 0) & (kept < _MAX_IMAGES)
            which, slot = np.nonzero((images.triangle >= 0) & ~more[:, None])
            found.append((row[which], *(each[which, slot] for each in images[:4])))
            row, kept = row[more], min(4 * kept, _MAX_IMAGES)
        point, spot, move, density, triangle = (np.concatenate(each) for each in zip(*found, strict=True))
        # An image on the edge of two triangles is found on both; one is kept.
        order = np.lexsort((*spot.T, point))
        is_duplicate = np.abs(np.diff(spot[order], axis=0)).max(axis=1, initial=0.0) <= self._image_tolerance
        once = order[np.append(True, ~is_duplicate | (np.diff(point[order]) != 0))[: len(order)]]
        return point[once], spot[once], move[once], density[once], triangle[once]

    def _is_unobstructed(
        self, origin: Float64, spot: Float64, lens: Float64, triangle: Integers
    ) -> npt.NDArray[np.bool_]:
        """Return whether the paths from points to spots on curved mirrors and on to the lens are free of occluders.

        The smooth surface bulges out of its triangle: that part of the way at the mirror is not tested.
        """
        bulge = self._surfaces.bulge[triangle]
        free = np.ones(len(spot), bool)
        for other in (origin, np.broadcast_to(lens, spot.shape)):
            direction = other - spot
            length = np.linalg.norm(direction, axis=1)
            along = direction / length[:, None]
            rise = np.abs(np.sum(along * self._surfaces.normal_of[triangle], axis=1))
            left_out = np.minimum(2.0 * bulge / np.maximum(rise, 1e-9) + self._surfaces.clearance, 0.5 * length)
            start = spot + left_out[:, None] * along
            free &= self._run(self._any_hit, np.hstack([start, other])).occluded == 0
        return free

    # ---- light that mirrors reflect to other surfaces ----------------------------------------------------------

    def reflected_lines(self, lit: LitLine, sheet: LightSheet, L: float) -> LitLine:
        """Return the lines that mirrors light on other surfaces, after 1 to `max_reflections` reflections.

        Parameters
        ----------
        lit
            Lines that the sheet lights.
        sheet
            Sheet of light.
        L
            Transport of the sheet [m].

        Notes
        -----
        Plane mirrors: the mirrored sheet cuts the scene exactly, and the energy is exact; `LitLine.power` is a mean, as
        the sheet's `uniformity` says. Curved mirrors: the light is taken as even between rays that are a step apart, of
        second order in the step; the end of a lit piece is located to 2^-12 of a step.
        """
        return self._interreflection.reflected_lines(lit, sheet, L, self.max_reflections)

    # ---- derived from the parameters ---------------------------------------------------------------------------

    @functools.cached_property
    def step(self) -> float:
        """Distance between the points of a line that curved mirrors image [m]."""
        middle = float(np.mean(self.view.u_edges[[0, -1]]))
        first, last = self.view.points_in_sheet(middle, self.view.v_edges[[0, -1]])
        length = float(np.linalg.norm(last - first))
        return length / self.view.samples / self.steps_per_sample

    @functools.cached_property
    def _device(self) -> Device:
        return Device.best() if self.device is None else self.device

    @functools.cached_property
    def _surfaces(self) -> MirrorSurfaces:
        return MirrorSurfaces(self.view, self.scene, self.materials, self.normals, self.limits)

    @functools.cached_property
    def _interreflection(self) -> SpecularInterreflection:
        return SpecularInterreflection(
            scene=self.scene,
            reflectance=np.array([each.mirror for each in self.materials])[self._surfaces.material],
            normals=self._surfaces.normals,
            is_curved=self._surfaces.is_curved,
            step=self.step,
            clearance=self._surfaces.clearance,
            device=self._device,
        )

    @functools.cached_property
    def _image_tolerance(self) -> float:
        """Distance of images in two triangles up to which they are one image on the common edge [m]."""
        if self._device.has_double:
            return self._surfaces.clearance
        return _SAME_IMAGE * float(np.abs(self.scene.corners).max(initial=0.0))

    @functools.cached_property
    def _fans(self) -> VisibleIntervals:
        return VisibleIntervals(scene=self.scene)

    @functools.cached_property
    def _any_hit(self) -> AnyHit:
        return AnyHit(scene=self.scene, clearance=self._surfaces.clearance)

    def _points(self, kept: int) -> MirrorPoints:
        if kept not in self._by_kept:
            some = self._surfaces.curved
            self._by_kept[kept] = MirrorPoints(
                corners=self.scene.corners[some],
                normals=self._surfaces.normals[some],
                numbers=some.astype(np.int32),
                outside=self._surfaces.sides[some] != 0,
                kept=kept,
            )
        return self._by_kept[kept]

    @functools.cached_property
    def _by_kept(self) -> dict[int, MirrorPoints]:
        return {}

    def _run(self, operation: Any, rows: Float64, *more: Float64) -> Any:
        return run_with_row_padding(operation, self._device, rows, *more)


def _between(ends: Float64, share: Float64) -> Float64:
    """Return the parts of segments (k, 2, 3) between fractions of their lengths (k, 2)."""
    return np.asarray(ends[:, :1] + share[..., None] * (ends[:, 1:] - ends[:, :1]))


def _steps(lengths: Float64, step: float) -> tuple[Integers, Float64]:
    """Divide lines into equal steps of at most ``step``; return the index of the line, and fractions (k, 2)."""
    count = np.maximum(np.ceil(lengths / step), 1).astype(np.int64)
    line = np.repeat(np.arange(len(lengths)), count)
    number = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    return line, np.stack([number, number + 1], axis=1) / count[line, None]
