"""Reflectance map of a board: its layers with exact area coverage, blurred by the lens and the area of a pixel."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry.polygon import orient

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.artwork.shapes import Float64, Shape, capsule
from gpuvision.simulation.board_image.area_coverage import add_coverage
from gpuvision.validation import finite, integer, numbers

WHITE = 65535
"""Value of the map for a reflectance of 1."""
_MOST_NODES = 1 << 28  # of a map: 512 MiB
_TAIL = 4.0  # standard deviations of the blur after which its filter ends: 6e-5 of the weight are beyond


@dataclass(frozen=True, kw_only=True, eq=False)
class ReflectanceMap:
    """Reflectance of a part of a board as a pixel of a camera sees it, at the nodes of a fine grid.

    Make it with `of`.

    Attributes
    ----------
    values : (rows, columns) uint16
        Reflectance at the nodes, `WHITE` for 1; rows towards +y.
    origin : (float, float)
        x, y of the first node [m].
    cell : float
        Distance between nodes [m].
    pixel : float
        Size of a pixel on the board [m].
    blur_px : float
        Standard deviation of the blur of the lens [px], without the area of a pixel.
    """

    values: npt.NDArray[np.uint16]
    origin: tuple[float, float]
    cell: float
    pixel: float
    blur_px: float

    @classmethod
    def of(
        cls,
        artwork: Artwork,
        *,
        pixel: float,
        region: npt.ArrayLike | None = None,
        blur_px: float = 0.5,
        nodes_per_pixel: int = 4,
        reflectance: BoardReflectance | None = None,
        etch_bias: float = 0.0,
        mask_shift: tuple[float, float] = (0.0, 0.0),
        silk_shift: tuple[float, float] = (0.0, 0.0),
    ) -> ReflectanceMap:
        """Rasterise the layers of one side of a board.

        Parameters
        ----------
        artwork : Artwork
            Side of a board.
        pixel : float
            Size of a pixel on the board [m], above 0.
        region : array_like, optional
            (2, 2) least and greatest x, y [m] that a camera may see; default: the bounds of the artwork. Beyond it
            images show the border of the map.
        blur_px : float
            Standard deviation of the blur of the lens (defocus and diffraction) [px], 0 or more, default 0.5. The area
            of a pixel is added.
        nodes_per_pixel : int
            Nodes of the map per pixel along each axis, 1 or more, default 4.
        reflectance : BoardReflectance, optional
            Reflectances of the materials. Default: `BoardReflectance`.
        etch_bias : float
            Distance from the drawn edges of the copper to its real edges [m], positive where copper is left over.
            Default 0.0.
        mask_shift, silk_shift : pair of floats
            Displacement x, y of the mask openings and of the silk [m]. Defaults ``(0.0, 0.0)`` and ``(0.0, 0.0)``.

        Returns
        -------
        ReflectanceMap

        Raises
        ------
        ValueError
            A number is out of its range, or the map would have more than 2^28 nodes.

        Notes
        -----
        The map is the exact mean of the reflectance over each cell, then filtered with the square area of a pixel and
        with the Gaussian blur. The square lies along the board's axes; the true one turns with the camera and has the
        same second moments. The sums over cells are right to contrast / (30 nodes_per_pixel^2 blur_px), with opposite
        errors on both sides of an edge. Bilinear interpolation moves an edge by less than
        0.016 / nodes_per_pixel^3 / (blur_px^2 + 1/12) pixels: 0.0008 px with the defaults. Values are rounded to
        1.5e-5.
        """
        finite(pixel, "pixel [m]", above=0.0)
        finite(blur_px, "blur_px", minimum=0.0)
        fine = integer(nodes_per_pixel, "nodes_per_pixel", minimum=1)
        low, high = np.array(numbers(artwork.bounds if region is None else region, (2, 2), "region [m]"))
        if not np.all(high > low):
            raise ValueError(f"region: from {low} to {high} m, expected the least and then the greatest x, y")
        cell = pixel / fine
        kernel = _filter(blur_px, fine)
        # Node i lies in the middle of cells i to i + len(kernel) - 1.
        nodes = np.ceil((high - low) / cell).astype(int) + 1
        if math.prod(nodes.tolist()) > _MOST_NODES:
            raise ValueError(
                f"a map of {nodes[1]} x {nodes[0]} nodes, expected 2^28 at most: give a smaller region, or fewer "
                "nodes_per_pixel"
            )
        corner = low - cell * len(kernel) / 2
        cells = nodes + len(kernel) - 1
        areas = _Areas(artwork, corner, corner + cell * cells, etch_bias, mask_shift, silk_shift)
        fine_map = areas.rasterised(reflectance or BoardReflectance(), corner, cell, (int(cells[1]), int(cells[0])))
        seen = cv2.sepFilter2D(fine_map, -1, kernel, kernel, anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
        values = np.rint(np.clip(seen[: nodes[1], : nodes[0]], 0.0, 1.0) * WHITE).astype(np.uint16)
        return cls(
            values=np.ascontiguousarray(values),
            origin=(float(low[0]), float(low[1])),
            cell=cell,
            pixel=pixel,
            blur_px=blur_px,
        )


def _filter(blur_px: float, fine: int) -> Float64:
    """Return the filter of a pixel's width and of the blur, in cells, with the sum 1."""
    sigma = blur_px * fine
    reach = math.ceil(_TAIL * sigma)
    places = np.arange(-reach, reach + 1)
    gauss = np.exp(-0.5 * (places / sigma) ** 2) if sigma > 0.0 else np.ones(1)
    return np.asarray(np.convolve(gauss / gauss.sum(), np.full(fine, 1.0 / fine)))


class _Areas:
    """Layers of a board as areas (shapely geometries) inside a window [m]."""

    def __init__(
        self,
        artwork: Artwork,
        low: Float64,
        high: Float64,
        etch_bias: float,
        mask_shift: Sequence[float],
        silk_shift: Sequence[float],
    ) -> None:
        self._window = shapely.box(*low, *high)
        drilled = zip(artwork.holes.start, artwork.holes.end, artwork.holes.diameter, strict=True)
        self.holes = self._area([Shape(capsule(start, end, across / 2)) for start, end, across in drilled])
        self.silk = self._area(artwork.silk, silk_shift)
        copper = self._area(artwork.copper, margin=2.0 * abs(etch_bias))
        if etch_bias:
            copper = copper.buffer(etch_bias, join_style="mitre", mitre_limit=2.0)
        self.copper = copper
        self.openings = self._area(artwork.mask, mask_shift) if artwork.mask else self._window

    def _area(self, shapes: Sequence[Shape], shift: Sequence[float] = (0.0, 0.0), margin: float = 0.0) -> Any:
        """Return the area of shapes in drawing order that is near the window."""
        moved = np.asarray(numbers(shift, (2,), "shift of a layer [m]"))
        x0, y0, x1, y1 = self._window.bounds
        low, high = np.array([x0, y0]) - moved - margin, np.array([x1, y1]) - moved + margin
        near = [
            each
            for each in shapes
            if (each.outline.max(axis=0) > low).all() and (each.outline.min(axis=0) < high).all()
        ]
        area: Any = shapely.Polygon()
        for dark, group in itertools.groupby(near, key=lambda each: each.dark):
            united = shapely.union_all([_polygon(each) for each in group])
            area = shapely.union(area, united) if dark else shapely.difference(area, united)
        return shapely.transform(area, lambda points: points + moved)

    def rasterised(
        self, reflectance: BoardReflectance, corner: Float64, cell: float, shape: tuple[int, int]
    ) -> npt.NDArray[np.float32]:
        """Return the mean reflectance (rows, columns) of each cell of a grid from a corner [m]."""
        grid = np.full(shape, reflectance.laminate_masked, np.float32)
        covered = shapely.union(self.silk, self.holes)
        copper, openings = (shapely.difference(each, covered) for each in (self.copper, self.openings))
        base = reflectance.laminate_masked
        bare = reflectance.copper - reflectance.laminate - reflectance.copper_masked + base
        for area, weight in (
            (copper, reflectance.copper_masked - base),
            (openings, reflectance.laminate - base),
            (shapely.intersection(copper, openings), bare),
            (shapely.difference(self.silk, self.holes), reflectance.silk - base),
            (self.holes, reflectance.hole - base),
        ):
            add_coverage(grid, [(ring - corner) / cell for ring in _rings(area)], weight)
        return grid


def _polygon(shape: Shape) -> Any:
    """Return the area of a shape; points with an odd number of crossings to the outside are inside."""
    area = _even_odd(shape.outline)
    return (
        shapely.difference(area, shapely.union_all([_even_odd(each) for each in shape.holes])) if shape.holes else area
    )


def _even_odd(outline: Float64) -> Any:
    area = shapely.Polygon(outline)
    return area if area.is_valid else shapely.make_valid(area, method="linework")


def _rings(area: Any) -> list[Float64]:
    """Return the borders of an area: outer ones counter-clockwise, holes clockwise."""
    parts = (orient(each) for each in shapely.get_parts(area) if each.geom_type == "Polygon")
    return [np.asarray(ring.coords)[:-1] for part in parts for ring in (part.exterior, *part.interiors)]
