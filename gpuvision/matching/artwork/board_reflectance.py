"""Reflectances of the materials of a board."""

from __future__ import annotations

from dataclasses import dataclass

from gpuvision.validation import finite


@dataclass(frozen=True, kw_only=True)
class BoardReflectance:
    """Reflectances of the materials of a board, relative to white, 0 to 1.

    The defaults are chosen, not measured: they have the contrasts of a green board with gold on its pads under diffuse
    light.

    Parameters
    ----------
    laminate_masked, copper_masked : float
        Laminate and copper under the solder mask. Defaults 0.24 and 0.43. Range: 0 to 1.
    laminate, copper : float
        Laminate and copper in the openings of the mask. Defaults 0.35 and 0.78. Range: 0 to 1.
    silk : float
        Silk. Default 0.94. Range: 0 to 1.
    hole : float
        Holes. Default 0.06. Range: 0 to 1.

    Raises
    ------
    ValueError
        A reflectance is out of its range.
    """

    laminate_masked: float = 0.24
    copper_masked: float = 0.43
    laminate: float = 0.35
    copper: float = 0.78
    silk: float = 0.94
    hole: float = 0.06

    def __post_init__(self) -> None:
        for name in ("laminate_masked", "copper_masked", "laminate", "copper", "silk", "hole"):
            finite(getattr(self, name), f"BoardReflectance.{name}", minimum=0.0, maximum=1.0)
