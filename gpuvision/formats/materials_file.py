"""Materials file (TOML) for ``gpuvision simulate --materials``: one table ``[[material]]`` for each mesh of the part.

===============  =====================================================================================================
``name``         name for reports
``albedo``       fraction of the light that is reflected diffusely, 0 to 1
``roughness``    roughness of the diffuse reflection, 0 (Lambert) to 1, see `OrenNayar`
``slope_sigma``  instead of ``roughness``: standard deviation of the facets' slope angles [rad], 0 to pi / 2, see
                 `OrenNayar.from_slope_sigma`
``mirror``       reflectance of an ideal mirror in the surface, 0 to 1
``gloss``        a table, the glossy lobe: ``model = "phong"`` with ``albedo``, ``exponent``; ``"ggx"`` with ``alpha``,
                 ``f0``; or ``"ward"`` with ``albedo``, ``alpha_x``, ``alpha_y``
===============  =====================================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from gpuvision.schema import Section, read_toml
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Lambert, OrenNayar, Phong, Ward


def read_materials(path: str | Path) -> tuple[Material, ...]:
    """Read the materials of a part from a TOML file.

    Parameters
    ----------
    path
        The materials file.

    Returns
    -------
    tuple of Material
        In the order of the tables, one or more.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key is unknown or missing, or a value is out of its range; the message names key, value and range.
    """
    top = read_toml(Path(path))
    materials = tuple(_material(each, top) for each in top.sections("material"))
    top.finish()
    if not materials:
        raise top.error("holds no table [[material]], expected one for each mesh of the part")
    return materials


def _material(table: Section, top: Section) -> Material:
    name = table.text("name", "")
    albedo = table.number("albedo", "", at_least=0.0, at_most=1.0)
    roughness = table.number("roughness", "", None, at_least=0.0, at_most=1.0)
    slope_sigma = table.number("slope_sigma", "rad", None, at_least=0.0, at_most=0.5 * math.pi)
    if roughness is not None and slope_sigma is not None:
        raise top.error(f"{table.name} has both roughness and slope_sigma, expected one of them")
    mirror = table.number("mirror", "", 0.0, at_least=0.0, at_most=1.0)
    lobe = table.optional_section("gloss")
    gloss = None if lobe is None else _gloss(lobe)
    table.finish()
    diffuse: Lambert | OrenNayar = Lambert(albedo=albedo)
    if slope_sigma:
        diffuse = OrenNayar.from_slope_sigma(albedo=albedo, sigma=slope_sigma)
    elif roughness:
        diffuse = OrenNayar(albedo=albedo, roughness=roughness)
    try:
        return Material(diffuse=diffuse, gloss=gloss, mirror=mirror, name=name)
    except ValueError as error:
        raise top.error(f"{table.name}: {error}") from None


_MODELS: dict[str, tuple[Callable[..., Brdf], tuple[str, ...]]] = {
    "phong": (Phong, ("albedo", "exponent")),
    "ggx": (Ggx, ("alpha", "f0")),
    "ward": (Ward, ("albedo", "alpha_x", "alpha_y")),
}


def _gloss(table: Section) -> Brdf:
    model, names = _MODELS[table.choice("model", tuple(_MODELS))]
    values = {name: table.number(name, "") for name in names}
    table.finish()
    try:
        return model(**values)
    except ValueError as error:
        raise table.error(f"{table.name}: {error}") from None
