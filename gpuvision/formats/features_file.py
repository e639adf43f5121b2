"""Feature files: ``gpuvision select`` writes the features of a board, ``gpuvision locate --features`` reads them."""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import tomli_w

from gpuvision.host.files import atomic_write
from gpuvision.matching.artwork.artwork import Side
from gpuvision.matching.features.feature_set import MAX_ROWS, FeatureSet
from gpuvision.matching.features.fiducials import Fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.schema import Section, read_toml


def write_features(features: FeatureSet, path: str | Path, *, overwrite: bool = False) -> None:
    """Write features as TOML. On an error an existing file remains unchanged.

    Parameters
    ----------
    features : FeatureSet
        Features of a board.
    path : str or Path
        Output file; its folder must exist.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    sx, sy, sigma_theta = (float(each) for each in features.sigmas)
    table: dict[str, Any] = {
        "side": features.side,
        "placement": features.placement.tolist(),
        "imaging": asdict(features.imaging),
        "predicted": {
            "sigma_x": sx,
            "sigma_y": sy,
            "sigma_theta": sigma_theta,
            "condition": features.condition,
            "covariance": features.covariance.tolist(),
        },
        "region": {
            "least": features.region[0].tolist(),
            "greatest": features.region[1].tolist(),
            "columns_and_rows": list(features.region_px),
        },
        "ruler": [
            {
                "point": features.point[number].tolist(),
                "normal": features.normal[number].tolist(),
                "spacing": float(features.spacing[number]),
                "length": float(features.length[number]),
                "sigma": float(features.sigma[number]),
            }
            for number in range(len(features.length))
        ],
        "fiducial": [
            {"point": point.tolist(), "radius": float(radius), "hole": float(hole), "sigma": float(sigma)}
            for point, radius, hole, sigma in zip(*features.fiducials, strict=True)
        ],
    }
    with atomic_write(path, overwrite=overwrite) as file:
        tomli_w.dump(table, file)


def read_features(path: str | Path) -> FeatureSet:
    """Read features from a file of `write_features`.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    FeatureSet

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key is missing, unknown or has a wrong value; the message names the key.
    """
    top = read_toml(Path(path))
    side: Side = top.choice("side", get_args(Side))
    placement = np.array(top.numbers("placement", "m", (2,)))
    imaging = _imaging(top, top.section("imaging"))
    predicted, region = top.section("predicted"), top.section("region")
    covariance = np.array(predicted.rows("covariance", "m, rad", 3))
    condition = predicted.number("condition", "", at_least=1.0)
    for name in ("sigma_x", "sigma_y", "sigma_theta"):
        predicted.number(name, "m, rad", above=0.0)
    predicted.finish()
    bounds = np.array([region.numbers(name, "m", (2,)) for name in ("least", "greatest")])
    region.numbers("columns_and_rows", "pixel", (2,))
    region.finish()
    rows = [_ruler(table) for table in top.sections("ruler")]
    fiducials = _fiducials(top.sections("fiducial"))
    top.finish()
    if not 3 <= len(rows) + 2 * len(fiducials.radius) <= MAX_ROWS:
        raise top.error(
            f"{len(rows)} tables [[ruler]] and {len(fiducials.radius)} [[fiducial]], expected 3 to {MAX_ROWS} "
            "rows: one for each ruler, two for each fiducial"
        )
    point, normal, spacing, length, sigma = (
        np.array([row[column] for row in rows], np.float64).reshape(-1, *shape)
        for column, shape in enumerate(((2,), (2,), (), (), ()))
    )
    with top.checking():
        return FeatureSet(
            side=side,
            placement=placement,
            point=point,
            normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
            spacing=spacing,
            length=length,
            sigma=sigma,
            imaging=imaging,
            covariance=covariance,
            condition=condition,
            region=bounds,
            fiducials=fiducials,
        )


def _imaging(top: Section, table: Section) -> Imaging:
    given: dict[str, Any] = {}
    for each in fields(Imaging):
        if isinstance(each.default, tuple):
            given[each.name] = table.numbers(each.name, "", (len(each.default),))
        elif isinstance(each.default, int):
            given[each.name] = table.integer(each.name, at_least=1)
        else:
            given[each.name] = table.number(each.name, "", at_least=0.0)
    table.finish()
    try:
        return Imaging(**given)
    except ValueError as error:
        raise top.error(f"[imaging]: {error}") from None


def _ruler(table: Section) -> tuple[Any, ...]:
    point, normal = table.numbers("point", "m", (2,)), table.numbers("normal", "", (2,))
    row: tuple[Any, ...] = (point, normal, table.number("spacing", "m", at_least=0.0))
    row += (table.number("length", "m", above=0.0), table.number("sigma", "m", above=0.0))
    table.finish()
    if math.hypot(*normal) < 0.5:
        raise table.error(f"{table.dotted('normal')} is {normal}, expected a direction of length 1")
    return row


def _fiducials(tables: tuple[Section, ...]) -> Fiducials:
    rows = []
    for table in tables:
        row = (table.numbers("point", "m", (2,)), table.number("radius", "m", above=0.0))
        rows.append((*row, table.number("hole", "m", at_least=0.0), table.number("sigma", "m", above=0.0)))
        table.finish()
    return Fiducials(*(np.array(each) for each in zip(*rows, strict=True))) if rows else Fiducials.empty()
