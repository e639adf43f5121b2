"""Light of lit strips: our closed forms compared with Mitsuba's time for a median error of 1 % in a picture.

Mitsuba runs in its fastest variant on the machine (LLVM where it works, else scalar) with next-event estimation, which
suits these scenes best. Its time is extrapolated: the time for ``samples`` per pixel times (its median error / 1 %)^2,
because the error is inversely proportional to the root of the number of samples. Our time is the time for the centres
of all pixels and strips as lines, in single precision. Errors are relative to the closed form in double with strips
0.1 mm wide, averaged over each pixel; ``error`` is the median error of gpuvision and ``peer_error`` the median error of
Mitsuba, over the pixels that see one plane and get light.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.harness import Case
from gpuvision.profiling.mitsuba_scenes import (
    LitScene,
    best_variant,
    board,
    bound_closed_form,
    by_closed_form,
    by_mitsuba,
    groove,
)

_TARGET_ERROR = 0.01  # relative median error for which the time of Mitsuba is given


def cases(device: Device) -> Iterator[Case]:
    """Yield a corner of 90 degrees, a groove of 60 degrees, and a board with parts; nothing if Mitsuba is missing."""
    if importlib.util.find_spec("mitsuba") is None:
        print("operation mitsuba skipped: the package is missing; install it: pip install mitsuba", file=sys.stderr)
        return
    variant = best_variant()
    yield _case(device, groove(np.radians(90.0), (256, 256)), "corner/90", variant, samples=16)
    yield _case(device, groove(np.radians(60.0), (256, 256)), "groove/60", variant, samples=16)
    yield _case(device, board((56, 256)), "board", variant, samples=256, occluding=True)


def _case(device: Device, lit: LitScene, name: str, variant: str, *, samples: int, occluding: bool = False) -> Case:
    receivers, centres = lit.receivers(nodes=4), lit.receivers(nodes=1)
    exact = by_closed_form(lit, receivers, device, occluding=occluding)
    bound = bound_closed_form(lit, centres, device, occluding=occluding, across=1)
    lights = receivers.whole & (exact > 1e-3 * np.max(exact[receivers.whole]))
    picture = by_mitsuba(lit, variant)

    def median_error(made: np.ndarray) -> float:
        return float(np.median(np.abs(made[lights] / exact[lights] - 1.0)))

    theirs = median_error(picture(samples, 1))
    ours = median_error(bound.run().irradiance.get().reshape(lit.pixels).astype(np.float64))
    metadata = {
        "variant": variant,
        "pixels": int(np.prod(lit.pixels)),
        "samples": samples,
        "peer_error": theirs,
        "its_time_is_for": f"{_TARGET_ERROR:g}, extrapolated by 1/sqrt(samples)",
    }
    factors = {"mitsuba": (theirs / _TARGET_ERROR) ** 2}
    return Case(
        "mitsuba", name, bound.run, {"mitsuba": lambda: picture(samples, 2)}, ours, metadata=metadata, factors=factors
    )
