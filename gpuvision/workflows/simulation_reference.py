"""Reference of the options of a simulation's light: its readings, and the estimated error of its discretisations."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.readings import Reading
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.workflows.simulation_errors import ErrorPart, PartEstimate, Refined
from gpuvision.workflows.simulation_options import LightOptions, Option
from gpuvision.workflows.simulation_sample import Difference, join_readings

_RAYS = "nodes"  # name of the part of the error by the rays of diffuse light
# Fields of the settings, parts of the error, and error over the change from the last coarser option. Errors of first
# order halve with the step, and are as large as that change. Multi-bounce light of the reference has four times the
# rays: measured on four parts, 0.19 to 0.30 of the change.
_PARTS = (
    ("sub_sheets", "slabs", 1.0),
    ("bounce_nodes", "nodes of multi-bounce light", 0.5),
    ("patch_size", "patches", 1.0),
)
# Error of the reference over its change by coarser rays; see `SimulationReference`.
_ERROR_PER_COARSER_CHANGE = 0.5


class ReferenceErrors(NamedTuple):
    """Errors of the reference by parts, as limits over all profiles of the part.

    Attributes
    ----------
    most, least : dict of str to ErrorPart
        Upper limits, from the mean squares raised by two standard errors, and lower limits.
    """

    most: dict[str, ErrorPart]
    least: dict[str, ErrorPart]


class SimulationReference:
    """Readings of the reference on groups of profiles, and its errors; at first on the sample.

    Parameters
    ----------
    options : LightOptions
        Light of the options.

    Attributes
    ----------
    readings : list of Reading
        Readings of the reference, one for each group of profiles.

    Notes
    -----
    An error of a discretisation is of first order: it is the change by the last refinement at most. Each change is
    measured on all profiles on which the reference was read: an edge that the sheet grazes, and a ray beside a lit
    line, make large errors in few profiles.

    The error by the rays of diffuse light is half of the root mean square of both changes from the two finest options.
    Errors of spread rays are independent: then the reference, with four times the rays of the finest option and half of
    its error (measured: a half to a quarter), has 0.45 of the change from the finest option. The errors of both options
    may be equal by chance, or one of them the error of the reference: so both count.
    """

    def __init__(self, options: LightOptions) -> None:
        self._options = options
        self._settings = options.settings_of([axis[-1] for axis in options.axes])
        self._coarser = _coarser_options(options.axes)
        self._refined: list[dict[str, list[Refined]]] = []
        self.readings: list[Reading] = []
        self._add(options.sample.places, options.reference(), lambda option: option.exposures)

    def read_at(self, places: npt.NDArray[np.float64]) -> None:
        """Read the reference, and its refinements, on one more group of profiles.

        Parameters
        ----------
        places : numpy.ndarray
            (profiles,): transports [m].
        """
        light = self._options.reference_at(places)
        self._add(places, light, functools.partial(self._options.light_at, places=places))

    def errors(self) -> ReferenceErrors:
        """Return the errors by parts, from all groups of profiles.

        Raises
        ------
        ValueError
            Nothing is read.
        """
        found = {name: self._changes(name) for name in self._refined[0]}
        return ReferenceErrors(
            *(
                self._options.proven | {name: _part(each, factor, limit) for name, (each, factor) in found.items()}
                for limit in ("error", "least")
            )
        )

    def _add(
        self,
        places: npt.NDArray[np.float64],
        light: Mapping[str, Exposure],
        light_of: Callable[[Option], Mapping[str, Exposure]],
    ) -> None:
        estimate = PartEstimate(replace(self._options.sample, places=places), self._settings, light)
        refined: dict[str, list[Refined]] = {}
        for name, factor, option in self._coarser:
            refined.setdefault(name, []).append(Refined(estimate.read(light_of(option)), factor))
        refined |= {name: [each] for name, each in estimate.refine_others().items()}
        self._refined.append(refined)
        self.readings.append(estimate.reading)

    def _changes(self, name: str) -> tuple[list[Difference], float]:
        """Return the changes of all readings by the refinements of a part of the error, and the factor to the error."""
        reader, reference = self._options.sample.reader, join_readings(self.readings)
        groups = zip(*(each[name] for each in self._refined), strict=True)  # one for each refinement
        chances = self._options.sample.chances(len(self.readings) - 1)
        refined = (join_readings([each.reading for each in group]) for group in groups)
        found = [reader.compare(reference, each, chances) for each in refined]
        if not all(math.isfinite(each.error) for each in found):
            raise ValueError(f"nothing is read in {len(reference.h)} profiles of the part")
        return found, self._refined[0][name][0].factor


def _coarser_options(axes: Sequence[Sequence[Option]]) -> list[tuple[str, float, Option]]:
    """Return the options that are coarser than the reference, with the part of the error and the factor to it."""
    found = [
        (part, factor, option) for name, part, factor in _PARTS for axis in axes for option in _last_coarser(axis, name)
    ]
    rays = [each for axis in axes for each in axis if "nodes" in each.changes and not each.pairs]
    return found + [(_RAYS, _ERROR_PER_COARSER_CHANGE, each) for each in rays[-2:]]


def _last_coarser(axis: Sequence[Option], name: str) -> list[Option]:
    """Return the last option of an axis that differs from the finest one only in the field `name`, if there is any."""
    finest = axis[-1].changes
    options = [each for each in axis if not each.pairs and each.changes.keys() == finest.keys()]
    return [each for each in options if {key for key in finest if each.changes[key] != finest[key]} == {name}][-1:]


def _part(changes: Sequence[Difference], factor: float, limit: str) -> ErrorPart:
    """Return an error from the root mean square of the limits of changes ("error" or "least")."""
    share = factor / math.sqrt(len(changes))
    error, signal = (math.hypot(*(getattr(each, name) for each in changes)) for name in (limit, "signal"))
    return ErrorPart(share * error, share * signal)
