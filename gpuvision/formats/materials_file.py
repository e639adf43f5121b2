"""Materials as a file, for ``gpuvision simulate --materials``: one ``[[material]]`` for each mesh of the part.

=============  =======================================================================================================
``name``       for reports
``albedo``     share of the light that the surface throws back diffusely
``roughness``  0 (Lambert) to 1, see `OrenNayar`
``slopes``     instead: standard deviation of the slopes of the surface's facets [rad], see `OrenNayar.of_slopes`
``mirror``     share that it throws on as an ideal mirror
``gloss``      a table: ``model = "phong"`` with ``albedo``, ``exponent``; ``"ggx"`` with ``alpha``, ``facing``; or
               ``"ward"`` with ``albedo``, ``alpha_x``, ``alpha_y``
=============  =======================================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from gpuvision.schema import DescriptionError, Section, read_toml
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Lambert, OrenNayar, Phong, Ward


def read_materials(path: str | Path) -> tuple[Material, ...]:
    """Read the materials of a part.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        It says something that it cannot say: key, value and allowed range are in the message.
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
    slopes = table.number("slopes", "rad", None, at_least=0.0, at_most=0.5 * math.pi)
    if roughness is not None and slopes is not None:
        raise top.error(f"{table.name} has roughness and slopes at once, expected one of them")
    mirror = table.number("mirror", "", 0.0, at_least=0.0, at_most=1.0)
    lobe = table.optional_section("gloss")
    gloss = None if lobe is None else _gloss(lobe)
    table.finish()
    diffuse: Lambert | OrenNayar = Lambert(albedo=albedo)
    if slopes:
        diffuse = OrenNayar.of_slopes(albedo=albedo, sigma=slopes)
    elif roughness:
        diffuse = OrenNayar(albedo=albedo, roughness=roughness)
    try:
        return Material(diffuse=diffuse, gloss=gloss, mirror=mirror, name=name)
    except ValueError as error:
        raise top.error(f"{table.name}: {error}") from None


_MODELS: dict[str, tuple[Callable[..., Brdf], tuple[str, ...]]] = {
    "phong": (Phong, ("albedo", "exponent")),
    "ggx": (Ggx, ("alpha", "facing")),
    "ward": (Ward, ("albedo", "alpha_x", "alpha_y")),
}


def _gloss(table: Section) -> Brdf:
    model, names = _MODELS[table.choice("model", tuple(_MODELS))]
    values = {name: table.number(name, "") for name in names}
    table.finish()
    try:
        return model(**values)
    except ValueError as error:
        raise DescriptionError(f"{table.name}: {error}") from None
