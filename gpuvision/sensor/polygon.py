"""Reader of the table ``[polygon]`` of a sensor file: a point sensor that looks through a polygon mirror."""

from __future__ import annotations

from gpuvision.ranging.polygon import PolygonMirror
from gpuvision.ranging.polygon_scan import PolygonScan
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.schema import Section


def read_polygon(table: Section | None, samples: int, sheet: Triangulation | None) -> PolygonScan | None:
    """Read a polygon mirror.

    Parameters
    ----------
    table : Section or None
        The table, if the file has one.
    samples : int
        Samples of a sweep.
    sheet : Triangulation or None
        Triangulation of the point sensor.

    Returns
    -------
    PolygonScan or None

    Raises
    ------
    DescriptionError
        A key is missing or unknown, or a value is out of range; the mirror reflects no sample; or the height of the
        triangulation depends on the sample, which no point sensor does.
    """
    if table is None:
        return None
    with table.checking():
        scan = PolygonScan(
            mirror=PolygonMirror(
                apothem=table.number("apothem", "m", above=0.0),
                facets=table.integer("facets", at_least=3),
                height=table.number("height", "m", above=0.0),
                height_from=table.choice("height_from", ("centre", "hit"), "centre"),
            ),
            first_rotation=table.number("first_rotation", "rad"),
            rotation_step=table.number("rotation_step", "rad per sample"),
            is_moving=table.choice("moving", ("yes", "no"), "yes") == "yes",
        )
        table.finish()
    (low, high), rotations = scan.mirror.limits, scan.rotations(samples)
    if not any(low <= each <= high for each in rotations):
        raise table.error(
            f"[{table.name}] turns from {rotations[0]:.4g} to {rotations[-1]:.4g} rad, expected a part of "
            f"{low:.4g} to {high:.4g} rad, where a facet reflects the beam"
        )
    rows = None if sheet is None else sheet.homography
    if sheet is None or sheet.lens is not None or rows is None or rows[1][1] != 0.0 or rows[2][1] != 0.0:
        raise table.error(f"[{table.name}] needs a point sensor: a triangulation with H of u alone, and no lens")
    return scan
