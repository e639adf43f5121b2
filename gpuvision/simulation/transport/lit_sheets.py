"""Lit segments of several sheets of light: the line that each sheet lights, and its parts that the lens sees."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_parts import LensVisibility, Parts

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


class LitSheets(NamedTuple):
    """Lit segments of several sheets, moved to the sensor at transport 0.

    Attributes
    ----------
    line
        The segments (m).
    sheet
        int64 (m,): index of the sheet of each segment.
    moved
        float64 (m, 3): motion of the sensor from transport 0 to the sheet [m].
    """

    line: LitLine
    sheet: Integers
    moved: Float64

    def select(self, kept: npt.NDArray[np.bool_]) -> LitSheets:
        """Return the segments of the sheets that ``kept`` (sheets,) marks, with new numbers of the sheets."""
        which = kept[self.sheet]
        return LitSheets(self.line.select(which), (np.cumsum(kept) - 1)[self.sheet[which]], self.moved[which])


@dataclass(frozen=True, kw_only=True, eq=False)
class SheetLighting:
    """Lighting of a scene by sheets of light at any transport; compared by identity.

    Parameters
    ----------
    view
        The sensor.
    scene
        Lit surfaces, which also occlude the lens.
    sheet
        Sheet of light, on the sensor's transport.
    device
        Device on which visibility is computed.
    """

    view: SensorView
    scene: Scene
    sheet: LightSheet
    device: Device
    _visibility: LensVisibility = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_visibility", LensVisibility(scene=self.scene, device=self.device))

    def light_levels(
        self, transports: Float64, profile: Integers, t: Float64, *, with_hidden: bool = False
    ) -> tuple[LitSheets, Parts]:
        """Return the lit segments of levels across thick sheets, and their parts in view.

        Parameters
        ----------
        transports
            (profiles,): transport of each profile [m].
        profile
            (levels,): index of the profile of each level.
        t
            (levels,): position of the level across the sheet [sigmas].
        with_hidden
            Whether hidden parts are returned as well, with `Parts.visible` False. Default False.
        """
        lit = self.illuminate(transports[profile] + self.sheet.sigma * t, transports[profile])
        return lit, self.visible_parts(lit, with_hidden=with_hidden)

    def illuminate(self, sheets: Float64, transports: Float64) -> LitSheets:
        """Return the segments that sheets light on the side that the lens can see, each in a profile at a transport."""
        line, first = self.sheet.illuminate_all(self.scene, sheets)
        sheet = np.repeat(np.arange(len(sheets)), np.diff(first))
        moved = transports[sheet, None] * np.array(self.sheet.transport.direction)
        ends = line.ends - moved[:, None]
        towards = np.array(self.view.lens) - ends[:, 0]
        which = np.flatnonzero(np.sum(line.normals * towards, axis=1) > 0.0)
        return LitSheets(line._replace(ends=ends).select(which), sheet[which], moved[which])

    def visible_parts(self, lit: LitSheets, *, with_hidden: bool = False) -> Parts:
        """Return the parts of lit segments that are visible from the lens, and on request the hidden parts."""
        line = lit.line._replace(ends=lit.line.ends + lit.moved[:, None])
        return self._visibility.visible_parts(line, np.array(self.view.lens) + lit.moved, with_hidden=with_hidden)

    def shift_per_sigma(self, normal: Float64, points: Float64) -> Float64:
        """Return the motion of lit points over their planes (n, 3) [m] as the sheet moves by one sigma."""
        direction, light = np.array(self.sheet.transport.direction), self.sheet.direction_to_light(points)
        slope = (normal @ direction) / np.sum(normal * light, axis=1)
        return np.asarray(self.sheet.sigma * (direction - light * slope[:, None]))
