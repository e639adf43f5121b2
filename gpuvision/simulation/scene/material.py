"""Materials: what the triangles of a scene are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpuvision.simulation.scene.reflectance import Brdf, Lambert, OrenNayar
from gpuvision.validation import finite

# A lobe's albedo is integrated to about this.
_EXCESS = 1e-2


@dataclass(frozen=True, kw_only=True)
class Material:
    """A surface: a diffuse part, and beside it a glossy lobe, a mirror, or neither.

    Parameters
    ----------
    diffuse
        `Lambert` or `OrenNayar`: what lights other surfaces, and what a sensor is meant to see.
    gloss
        A lobe beside it (`Phong`, `Ggx`, `Ward`); None: there is none.
    mirror
        Share of the light that an ideal mirror in the surface throws on, at any angle.
    name
        For reports.

    Raises
    ------
    TypeError
        A part is no model of reflectance.
    ValueError
        The surface throws back more than arrives: the parts' albedos (of a lobe, at normal incidence) exceed 1.
    """

    diffuse: Lambert | OrenNayar
    gloss: Brdf | None = None
    mirror: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.diffuse, Lambert | OrenNayar):
            raise TypeError(f"Material.diffuse is {self.diffuse!r}, expected Lambert or OrenNayar")
        if self.gloss is not None and not isinstance(self.gloss, Brdf):
            raise TypeError(f"Material.gloss is {self.gloss!r}, expected a Brdf such as Phong, or None")
        object.__setattr__(self, "mirror", finite(self.mirror, "Material.mirror"))
        if not 0.0 <= self.mirror <= 1.0:
            raise ValueError(f"Material.mirror is {self.mirror:g}, expected 0 to 1")
        total = self.diffuse.albedo + self.mirror + (0.0 if self.gloss is None else _facing_albedo(self.gloss))
        if total > 1.0 + _EXCESS:
            raise ValueError(f"Material throws back {total:.2f} of the light that arrives, expected 1 at most")

    @property
    def albedo(self) -> float:
        """Share of the light that leaves diffusely: what secondary light is made of."""
        return self.diffuse.albedo


def _facing_albedo(lobe: Brdf, rings: int = 400, spokes: int = 32) -> float:
    """Integrate a lobe over the half space, for light along the normal; narrow ones are near it."""
    # Half way angles are where lobes are narrow: the tangent of half the angle, spaced by its logarithm.
    step = np.linspace(-14.0, 0.0, rings + 1)
    angle = 2.0 * np.arctan(np.exp(0.5 * (step[1:] + step[:-1])))
    around = (np.arange(spokes) + 0.5) * (2.0 * np.pi / spokes)
    theta, phi = np.meshgrid(angle, around, indexing="ij")
    eye = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    light = np.broadcast_to((0.0, 0.0, 1.0), eye.shape)
    value = lobe.value(np.concatenate([light, eye], axis=-1))
    # d theta = sin theta d log tan(theta / 2)
    weight = np.cos(theta) * np.sin(theta) ** 2 * (step[1] - step[0]) * (2.0 * np.pi / spokes)
    return float(np.sum(value * weight))
