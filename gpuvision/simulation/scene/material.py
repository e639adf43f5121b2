"""Materials of the triangles of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpuvision.simulation.scene.reflectance import Brdf, Lambert, OrenNayar
from gpuvision.validation import finite

# Allowed excess of the total albedo over 1, for the error of the numerical integration of a lobe's albedo (chosen).
_ALBEDO_TOLERANCE = 1e-2


@dataclass(frozen=True, kw_only=True)
class Material:
    """Reflectance of a surface: a diffuse component, and optionally a glossy lobe and a mirror component.

    Parameters
    ----------
    diffuse : Lambert or OrenNayar
        `Lambert` or `OrenNayar`. Only this component sends secondary light to other surfaces.
    gloss : Brdf, optional
        Glossy lobe (`Phong`, `Ggx`, `Ward`), or None.
    mirror : float
        Reflectance of an ideal mirror in the surface, for all angles, 0 to 1. Default 0.0.
    name : str
        Name for reports.

    Raises
    ------
    TypeError
        A component is not a reflectance model.
    ValueError
        The albedos of the components add up to more than 1 (the albedo of a lobe is that at normal incidence).
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
        total = self.diffuse.albedo + self.mirror + (0.0 if self.gloss is None else _normal_albedo(self.gloss))
        if total > 1.0 + _ALBEDO_TOLERANCE:
            raise ValueError(f"Material reflects {total:.2f} of the incident light, expected 1 at most")

    @property
    def albedo(self) -> float:
        """Albedo of the diffuse component, 0 to 1."""
        return self.diffuse.albedo


def _normal_albedo(lobe: Brdf) -> float:
    """Return the albedo of a lobe for normal incidence: its value times the cosine, integrated over the half space."""
    rings, spokes = 400, 32
    # At normal incidence the half-way angle is theta / 2. Nodes are evenly spaced in log(tan(theta / 2)), because
    # narrow lobes are near theta = 0.
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
