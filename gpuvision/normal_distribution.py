"""Constants of the normal distribution."""

from __future__ import annotations

from typing import Final

#: Standard deviation of a normal distribution over its median absolute deviation: 1 / ``scipy.special.ndtri(0.75)``.
MAD_TO_SIGMA: Final = 1.4826022185056018
