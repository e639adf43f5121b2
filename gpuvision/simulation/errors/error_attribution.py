"""ErrorAttribution: how far readings are from the truth, and which cause moved them by how much.

Two ways to split an error, both exact (the causes' parts add up to the error) and both blind to any order of causes:

- ``"moments"``, for PSDs: their reading is the centre of gravity of all light, so that light of power P at u moves it
  by P (u - u_true) over all power. The parts are these, times the slope of the height between truth and reading.
- ``"removal"``, for any readout: what a cause adds, averaged over all orders in which the causes may be added one after
  the other to evenly reflecting, fully visible direct light (Shapley's value). It reads the light 2^n times, n the
  number of causes that are there.

The two differ to the square of the light's share where there are several causes. Even reflection is that of a surface
which sends as much to a sample as the real one, from other places: a dark surface lets secondary light weigh more, and
that is secondary light's part.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.readings import (
    AMBIENT,
    EVEN,
    EVEN_OPEN,
    OPEN,
    PATHS,
    Reading,
    Simulator,
    Truth,
    dark_exposure,
    height_secant,
    height_slope,
    lit_by,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
Split = Literal["moments", "removal"]

CAUSES = ("shape", "occlusion", "reflectivity", "specular", "secondary", "ambient", "noise")
"""Shape is what is left of direct light that reflects evenly and is not hidden: a strip's or a spot's width on a part
that is not flat. Where the light without the other two is not given, "shape" holds all three."""
_VARIANTS = (EVEN, OPEN, EVEN_OPEN)
_SECONDARY = ("diffuse-specular", "diffuse-diffuse", "bounces")


class Verdict(enum.IntFlag):
    """What a reading is worth beside the truth (uint8; 0 is a reading of a surface)."""

    READ = 0
    """Of a surface."""
    MISSING = 1
    """A lit surface is there, and no reading of it."""
    FALSE = 2
    """A reading, and no lit surface that could be read."""
    NOTHING = 4
    """Neither a lit surface nor a reading."""
    AMBIGUOUS = 8
    """Several lit surfaces in one sample."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorAttribution:
    """Readings beside the truth, arrays (..., samples).

    Attributes
    ----------
    reading
        What the sensor says.
    truth
        What it should say.
    error
        Height read minus true height [m]; NaN where either is missing.
    causes
        Parts of the error by cause [m], NaN where the error is; they add up to it.
    light
        Light that each cause brought [W]; of "shape" all direct light, of "noise" none.
    verdict
        uint8 `Verdict` flags.
    """

    reading: Reading
    truth: Truth
    error: Float64
    causes: dict[str, Float64]
    light: dict[str, Float64] = field(repr=False)
    verdict: npt.NDArray[np.uint8]

    def dominant(self, least: float = 0.0) -> npt.NDArray[np.int8]:
        """Return the number (in `causes`) of the cause with the largest part, -1 where the error is `least` or less.

        Of a FALSE reading it is the cause that brought most of the light; where neither applies, -1.
        """
        parts = np.nan_to_num(np.abs(np.stack(list(self.causes.values()))), nan=-1.0)
        chosen = np.where(np.abs(self.error) > least, parts.argmax(axis=0), -1)
        bright = np.stack([self.light[name] for name in self.causes]).argmax(axis=0)
        return np.where(self.is_(Verdict.FALSE), bright, chosen).astype(np.int8)

    def is_(self, verdict: Verdict) -> npt.NDArray[np.bool_]:
        """Return where a flag is set; for READ, where none is."""
        return np.asarray(self.verdict == 0 if verdict == Verdict.READ else (self.verdict & verdict) != 0)

    def unread(self, limit: float) -> float:
        """Return the share of the lit surfaces' samples that are missing or off by more than a limit [m]."""
        true = np.isfinite(self.truth.h)
        wrong = true & ~(np.abs(self.error) <= limit)
        return int(wrong.sum()) / max(int(true.sum()), 1)

    def without(self, flags: Status) -> ErrorAttribution:
        """Return them as if what has any of the flags were not read."""
        dropped = (self.reading.status & flags) != 0
        values = {name: np.where(dropped, np.nan, getattr(self.reading, name)) for name in ("position", "g", "h")}
        reading = self.reading._replace(**values)
        return replace(
            self,
            reading=reading,
            error=np.where(dropped, np.nan, self.error),
            causes={name: np.where(dropped, np.nan, part) for name, part in self.causes.items()},
            verdict=verdict_of(reading.h, self.truth),
        )

    def summary(self, limit: float) -> dict[str, Any]:
        """Return the numbers of a report; errors in metres, None where there is no reading at all.

        Parameters
        ----------
        limit
            Error from which on a sample counts as wrong, and its dominant cause is counted [m].
        """
        true, error = np.isfinite(self.truth.h), np.abs(self.error[np.isfinite(self.error)])
        dominant = self.dominant(limit)
        wrong = np.abs(self.error) > limit
        causes = {
            name: {
                "rms": _rms(part[np.isfinite(part)]),
                "worst": _largest(part),
                "dominant": int(np.sum(wrong & (dominant == number))),
                "false": int(np.sum(self.is_(Verdict.FALSE) & (dominant == number))),
            }
            for number, (name, part) in enumerate(self.causes.items())
        }
        levels = np.quantile(error, [0.5, 0.95]).tolist() if error.size else [None, None]
        return {
            "samples": int(true.size),
            "surface": int(true.sum()),
            "read": int(error.size),
            "missing": int(self.is_(Verdict.MISSING).sum()),
            "false": int(self.is_(Verdict.FALSE).sum()),
            "ambiguous": int(self.is_(Verdict.AMBIGUOUS).sum()),
            "limit": limit,
            "beyond_limit": int(wrong.sum()),
            "unread_share": self.unread(limit),
            "rms": _rms(error),
            "median": levels[0],
            "p95": levels[1],
            "worst": _largest(error),
            "causes": causes,
        }


def _rms(values: Float64) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _largest(values: Float64) -> float | None:
    known = np.abs(values[np.isfinite(values)])
    return float(known.max()) if known.size else None


def attribute_errors(
    simulator: PsdSimulator | CameraSimulator,
    exposures: Mapping[str, Exposure],
    truth: Truth,
    *,
    seed: int | None = None,
    first: int = 0,
    split: Split | None = None,
    detail: bool = False,
    device: Device | None = None,
) -> ErrorAttribution:
    """Read light, compare it with the truth, and split the error by cause.

    Parameters
    ----------
    simulator
        The sensor; its mask and its ambient light count.
    exposures
        Light by path, (..., samples, bins). With the direct light's variants (`EVEN`, `OPEN`, `EVEN_OPEN`, all three)
        among them occlusion and reflectivity are told from shape.
    truth
        Of the same samples.
    seed, first
        As for `PsdSimulator.read`; without a seed there is no noise.
    split
        See above; None: moments for PSDs, removal for cameras. Removal counts what cannot be read as no error.
    detail
        Every path of secondary light is a cause of its own.
    device
        Where readouts run.

    Raises
    ------
    ValueError
        Shapes differ, a path is unknown, or a camera's error is to be split by moments.
    """
    chosen = split or ("moments" if isinstance(simulator, PsdSimulator) else "removal")
    if chosen == "moments" and not isinstance(simulator, PsdSimulator):
        raise ValueError("split 'moments' is for PSDs, whose reading is a centre of gravity; cameras take 'removal'")
    reading = simulator.read(exposures, seed=seed, first=first, device=device)
    if np.shape(truth.h) != reading.h.shape:
        raise ValueError(f"the truth has shape {np.shape(truth.h)}, the reading {reading.h.shape}; expected the same")
    behind = simulator.light(exposures)
    if chosen == "moments":
        clean = reading if seed is None else simulator.read(exposures, device=device)
        causes = _by_moments(simulator.view, behind, truth, clean, detail)
    else:
        causes = _by_removal(simulator, behind, truth, detail, device)
    error = reading.h - truth.h
    # Rounding, and what cannot be read without its noise.
    causes["noise"] = error - np.nan_to_num(np.sum(list(causes.values()), axis=0))
    known = np.isfinite(error)
    causes = {name: np.where(known, np.nan_to_num(part), np.nan) for name, part in causes.items()}
    return ErrorAttribution(
        reading=reading,
        truth=truth,
        error=error,
        causes=causes,
        light={name: _light_of(name, behind, detail) for name in causes},
        verdict=verdict_of(reading.h, truth),
    )


def verdict_of(h: Float64, truth: Truth) -> npt.NDArray[np.uint8]:
    """Return uint8 `Verdict` flags of heights read, NaN where there is none, beside the truth."""
    true, read = np.isfinite(truth.h), np.isfinite(h)
    several = (np.asarray(truth.status) & Status.AMBIGUOUS) != 0
    verdict = np.select([true & ~read, read & ~true, ~read & ~true], [Verdict.MISSING, Verdict.FALSE, Verdict.NOTHING])
    verdict = np.where(several & ~true, 0, verdict)
    return (verdict | np.where(several, Verdict.AMBIGUOUS, 0)).astype(np.uint8)


def _paths_of(cause: str, detail: bool) -> tuple[str, ...]:
    """Return the paths whose light makes a cause."""
    if cause == "shape":
        return ("direct",)
    if cause == "secondary" and not detail:
        return _SECONDARY
    return (cause,) if cause in (*PATHS, AMBIENT) else ()


def _beside_direct(light: Mapping[str, Exposure], detail: bool) -> list[str]:
    """Return the causes beside the direct light, whether there is such light or not."""
    ambient = [AMBIENT] if AMBIENT in light else []
    return ["specular", *(_SECONDARY if detail else ["secondary"]), *ambient]


def _light_of(cause: str, light: Mapping[str, Exposure], detail: bool) -> Float64:
    parts = [light[path].total() for path in _paths_of(cause, detail) if path in light]
    zero = np.zeros(next(iter(light.values())).power.shape[:-1])
    return np.asarray(sum(parts, start=zero))


def _has_variants(light: Mapping[str, Exposure]) -> bool:
    given = [name in light for name in _VARIANTS]
    if any(given) and not all(given):
        raise ValueError(f"expected all of {'; '.join(_VARIANTS)} beside the direct light, or none of them")
    return all(given)


# ---- PSDs: by moments ----------------------------------------------------------------------------------------


def _by_moments(
    view: SensorView, light: Mapping[str, Exposure], truth: Truth, clean: Reading, detail: bool
) -> dict[str, Float64]:
    true_u, _ = height_slope(view, truth)
    edges = view.u_edges
    total = lit_by(light).total()
    slope = height_secant(view.triangulation, true_u, clean.position, view.v_middles)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = slope / total

        def moved(name: str) -> Float64:
            each = light[name]
            return np.asarray((each.first_moment(edges) - true_u * each.total()) * share)

        causes: dict[str, Float64] = {}
        direct = moved("direct") if "direct" in light else np.zeros(total.shape)
        if _has_variants(light):
            causes |= _direct_causes(view, light, light["direct"].total() * share)
            causes["shape"] = direct - causes["occlusion"] - causes["reflectivity"]
        else:
            causes["shape"] = direct
        for cause in _beside_direct(light, detail):
            parts = [moved(path) for path in _paths_of(cause, detail) if path in light]
            causes[cause] = np.asarray(sum(parts, start=np.zeros(total.shape)))
    return {name: causes[name] for name in (*CAUSES, *_SECONDARY) if name in causes}


def _direct_causes(view: SensorView, light: Mapping[str, Exposure], weight: Float64) -> dict[str, Float64]:
    """Return what hiding and uneven reflection do to the direct light's centre, either before the other, averaged."""
    centre = {}
    for name in ("direct", *_VARIANTS):
        each = light[name].total()
        centre[name] = np.where(each > 0.0, light[name].first_moment(view.u_edges) / each, np.nan)
    hidden = (centre["direct"] - centre[OPEN]) + (centre[EVEN] - centre[EVEN_OPEN])
    uneven = (centre["direct"] - centre[EVEN]) + (centre[OPEN] - centre[EVEN_OPEN])
    return {
        "occlusion": np.nan_to_num(0.5 * weight * hidden),
        "reflectivity": np.nan_to_num(0.5 * weight * uneven),
    }


# ---- any readout: by removal ---------------------------------------------------------------------------------


def _by_removal(
    simulator: Simulator, light: Mapping[str, Exposure], truth: Truth, detail: bool, device: Device | None
) -> dict[str, Float64]:
    beside = _beside_direct(light, detail)
    direct = _direct_signals(simulator, light)
    signals = {}
    for name in beside:
        if np.any(_light_of(name, light, detail) > 0.0):
            signals[name] = simulator.signal(
                lit_by({path: light[path] for path in _paths_of(name, detail) if path in light})
            )
    toggles = ["occlusion", "reflectivity"] if len(direct) > 1 else []
    players = toggles + list(signals)
    errors: dict[frozenset[str], Float64] = {}
    for count in range(len(players) + 1):
        for group in itertools.combinations(players, count):
            total = sum(
                (signals[name] for name in group if name in signals), start=direct[frozenset(group) & {*toggles}]
            )
            errors[frozenset(group)] = np.nan_to_num(simulator.heights(total, device) - truth.h)
    causes = {"shape": errors[frozenset()]}
    for name in toggles + beside:
        causes[name] = _shapley(name, players, errors) if name in players else np.zeros(np.shape(truth.h))
    return causes


def _direct_signals(simulator: Simulator, light: Mapping[str, Exposure]) -> dict[frozenset[str], npt.NDArray[Any]]:
    """Return the signal of the direct light for every set of its two causes; the real one's, if it alone is known."""
    real = light["direct"] if "direct" in light else dark_exposure(light)
    if not _has_variants(light):
        return {frozenset(): simulator.signal(real)}
    kinds = {
        frozenset({"occlusion", "reflectivity"}): real,
        frozenset({"reflectivity"}): light[OPEN],
        frozenset({"occlusion"}): _as_bright(light[EVEN], real),
        frozenset(): _as_bright(light[EVEN_OPEN], light[OPEN]),
    }
    return {name: simulator.signal(each) for name, each in kinds.items()}


def _as_bright(light: Exposure, like: Exposure) -> Exposure:
    """Return light scaled to the power of another in every sample."""
    total = light.total()
    factor = np.divide(like.total(), total, out=np.zeros_like(total), where=total > 0.0)[..., None]
    return Exposure(factor * light.power, factor * light.moment)


def _shapley(name: str, players: Sequence[str], errors: Mapping[frozenset[str], Float64]) -> Float64:
    others = [each for each in players if each != name]
    total = np.zeros_like(errors[frozenset()])
    for count in range(len(others) + 1):
        weight = math.factorial(count) * math.factorial(len(others) - count) / math.factorial(len(players))
        for group in itertools.combinations(others, count):
            before = frozenset(group)
            total += weight * (errors[before | {name}] - errors[before])
    return total
