"""Checked tuning: find settings of an operation that are faster than the defaults and give the same results."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host.arrays import HostArray
from gpuvision.host.bound import MAX_INLINE_BYTES, Bound
from gpuvision.host.device import Device
from gpuvision.host.errors import GpuVisionError
from gpuvision.host.launch import Launch, describe_launch
from gpuvision.host.operation import Operation
from gpuvision.host.tuned_settings import DEFAULTS, Tunable, TunedEntry, TunedSettings, entry_of, trial_of

# Duration of the calls of one turn [s], and rounds of turns (chosen): a class takes about 0.2 s and 5 ms a candidate.
_TURN, _SCREENING_ROUNDS, _FINAL_ROUNDS = 5e-4, 5, 41
# Byte that fills the outputs before a launch. Four such bytes are -2.9e-16 as float32, which no kernel computes from
# the inputs.
_POISON = 0xA5

# Runs a call with some settings for a while and returns the time of one call [s].
Stopwatch = Callable[[TunedSettings, Callable[[], object]], float]
Make = Callable[[int], Sequence[HostArray]]


@dataclass(frozen=True, kw_only=True)
class TuningResult:
    """Fastest settings of an operation for one size class on a device.

    Attributes
    ----------
    operation, dtype, device : str
    elements : int
        Elements of the first input in the timed calls.
    best : TunedSettings
        Settings that won; the defaults if none did.
    default_seconds, best_seconds : float
        Median times of a call [s].
    gain : float
        Time with the defaults over the time with the best settings: the median of the ratio over the rounds, or the
        ratio of the median times if that is smaller; 1 for the defaults.
    spread : float
        Interquartile range of the time with the defaults over the time with the defaults in the same round.
    rejected : mapping of TunedSettings to str
        Settings that failed, with the reason.
    entry : TunedEntry
        Entry to keep: `best`, or the defaults.
    """

    operation: str
    dtype: str
    device: str
    elements: int
    best: TunedSettings
    default_seconds: float
    best_seconds: float
    gain: float
    spread: float
    entry: TunedEntry
    rejected: Mapping[TunedSettings, str] = field(default_factory=dict)


def seconds_of_a_call(_: TunedSettings, call: Callable[[], object]) -> float:
    """Return the time of a call [s]: the mean over calls of 0.5 ms in all."""
    begun = time.perf_counter()
    calls, taken = 0, 0.0
    while taken < _TURN:
        call()
        calls, taken = calls + 1, time.perf_counter() - begun
    return taken / calls


def tune(
    operation: Operation[Any],
    make: Make,
    device: Device,
    size: int,
    *,
    stopwatch: Stopwatch = seconds_of_a_call,
) -> TuningResult:
    """Measure the settings that an operation offers, for inputs of one size class, and return the fastest.

    Parameters
    ----------
    operation : Operation
        Operation with `Operation.tunable`.
    make : function
        Returns the NumPy inputs for a number of elements of the first input, or nearly as many.
    device : Device
    size : int
        Size class, see `tuned_settings.size_class`.
    stopwatch : function, optional
        Returns the time of a call [s].

    Returns
    -------
    TuningResult

    Raises
    ------
    ValueError
        The operation has nothing to tune.

    Notes
    -----
    Settings win under three conditions. Their results on inputs of the smallest, a middle and the largest size of the
    class are the results of the defaults, within `Tunable.tolerance`. They are the same after the timed calls. Their
    gain, less 1, exceeds the spread of the default against itself.
    """
    tunable = type(operation).tunable
    if tunable is None:
        raise ValueError(f"{type(operation).__name__} has no settings to tune")
    first = 4**size
    inputs = [make(count) for count in (first, 2 * first + first // 3, 4 * first - 1)]
    reference = [_Trial(operation, device, each, DEFAULTS) for each in inputs]
    expected = [each.result() for each in reference]
    default = reference[1]
    trials: dict[TunedSettings, _Trial] = {}
    rejected: dict[TunedSettings, str] = {}
    seen = {_work_of(default.launch())}
    for settings in _candidates(tunable, default):
        try:
            work = _work_of(default.launch(settings))
            if work in seen:  # the launch of earlier settings
                continue
            seen.add(work)
            checked = [_Trial(operation, device, each, settings) for each in inputs]
            reasons = [each.difference(e, tunable) for each, e in zip(checked, expected, strict=True)]
            reason = next(filter(None, reasons), "")
        except (GpuVisionError, ValueError, cl.Error) as error:
            reason = (str(error) or type(error).__name__).partition("\n")[0]
        if reason:
            rejected[settings] = reason
        else:
            trials[settings] = checked[1]
    best, gain, spread, seconds = _fastest(default, trials, stopwatch)
    if best != DEFAULTS:
        reason = trials[best].difference(expected[1], tunable)
        if reason:
            rejected[best] = f"{reason} after the timed calls"
            best, gain = DEFAULTS, 1.0
    array = inputs[1][0]
    return TuningResult(
        operation=type(operation).__name__,
        dtype=array.dtype.name,
        device=device.label,
        elements=array.size,
        best=best,
        default_seconds=seconds[DEFAULTS],
        best_seconds=seconds[best],
        gain=gain,
        spread=spread,
        entry=entry_of(operation, device, array.shape, array.dtype, best, gain),
        rejected=rejected,
    )


class _Trial:
    """Operation that is bound with some settings, for inputs on the device."""

    def __init__(
        self, operation: Operation[Any], device: Device, inputs: Sequence[HostArray], settings: TunedSettings
    ) -> None:
        first = inputs[0]
        with trial_of(settings):
            self.bound: Bound[Any] = operation.bind(device, first.shape, first.dtype)
        for array, values in zip(self.bound.inputs, inputs, strict=True):
            array.set(np.ascontiguousarray(values))

    def launch(self, settings: TunedSettings = DEFAULTS) -> Launch:
        """Return the launch of the operation with some settings for the inputs of this instance."""
        first = self.bound.inputs[0]
        with trial_of(settings):
            return describe_launch(self.bound.operation, self.bound.device, first.shape, first.dtype)

    def result(self) -> dict[str, HostArray]:
        """Launch and return the computed fields. The outputs are filled first, so that a missing write shows."""
        computed = {name: array for name, array in self.bound.outputs._asdict().items() if array is not None}
        for array in computed.values():
            filler = np.full(array.nbytes, _POISON, np.uint8)
            array.set(filler.view(array.dtype).reshape(array.shape))
        self.bound.run()
        return {name: array.get() for name, array in computed.items()}

    def difference(self, expected: Mapping[str, HostArray], tunable: Tunable) -> str:
        """Return how the result differs from the expected one; empty if it does not."""
        for name, values in self.result().items():
            if not _agree(values, expected[name], tunable.tolerance.get(name, 0.0)):
                return f"another result: field {name}"
        return ""


def _agree(values: HostArray, expected: HostArray, tolerance: float) -> bool:
    """Return whether arrays are equal, NaN at the same places, or differ by a part of the largest magnitude."""
    if values.dtype.kind != "f":
        return bool(np.array_equal(values, expected))
    if tolerance == 0.0:
        same_sign = np.signbit(values) == np.signbit(expected)
        return bool(np.array_equal(values, expected, equal_nan=True) and np.all(same_sign | np.isnan(values)))
    is_finite = np.isfinite(expected)
    limit = tolerance * np.max(np.abs(expected[is_finite]), initial=0.0)
    others = np.array_equal(values[~is_finite], expected[~is_finite], equal_nan=True)
    return bool(others and np.all(np.abs(values[is_finite] - expected[is_finite]) <= limit))


def _candidates(tunable: Tunable, default: _Trial) -> Iterator[TunedSettings]:
    """Yield all settings that an operation offers on a device; several may have the same launch."""
    device, launch = default.bound.device, default.launch()
    may_run_inline = launch.passes_once and launch.nbytes <= MAX_INLINE_BYTES and device.has_inline_queues
    inline = (None, not default.bound.inline) if may_run_inline else (None,)
    if device.prefers_vectors:
        shapes = [TunedSettings(strip=each) for each in (None, *tunable.strips)]
        if tunable.variants:
            groups = (None, *tunable.groups)
            shapes += [TunedSettings(variant="work_item", group=each) for each in groups]
    else:
        shapes = [TunedSettings(group=each) for each in (None, *tunable.groups)]
    for shape in shapes:
        for each in inline:
            yield replace(shape, inline=each)


def _work_of(launch: Launch) -> tuple[object, ...]:
    """Return the parts of a launch that tuned settings change."""
    return (launch.global_size, launch.local_size, tuple(sorted(launch.defines)), launch.inline)


def _fastest(
    default: _Trial, trials: Mapping[TunedSettings, _Trial], stopwatch: Stopwatch
) -> tuple[TunedSettings, float, float, dict[TunedSettings, float]]:
    """Return the winner, its gain, the spread of the gain of the defaults, and median times [s]."""
    screened = _rounds({DEFAULTS: default, **trials}, stopwatch, _SCREENING_ROUNDS)
    medians = {settings: float(np.median(times)) for settings, times in screened.items()}
    favourite = min(medians, key=medians.__getitem__)
    if favourite == DEFAULTS:
        return DEFAULTS, 1.0, 0.0, medians
    finals = [DEFAULTS, favourite, DEFAULTS]
    times = np.array(
        [
            [stopwatch(each, (default if each == DEFAULTS else trials[each]).bound.run) for each in finals]
            for _ in range(_FINAL_ROUNDS)
        ]
    )
    low, high = np.quantile(times[:, 0] / times[:, 2], [0.25, 0.75])
    spread = float(high - low)
    medians |= {DEFAULTS: float(np.median(times[:, [0, 2]])), favourite: float(np.median(times[:, 1]))}
    # On a machine whose speed jumps, the median of the ratios and the ratio of the medians differ: take the smaller.
    ratios = 0.5 * (times[:, 0] + times[:, 2]) / times[:, 1]
    gain = min(float(np.median(ratios)), medians[DEFAULTS] / medians[favourite])
    if gain - 1.0 > spread:
        return favourite, gain, spread, medians
    return DEFAULTS, 1.0, spread, medians


def _rounds(
    trials: Mapping[TunedSettings, _Trial], stopwatch: Stopwatch, rounds: int
) -> dict[TunedSettings, list[float]]:
    """Return the times of the calls [s] of all trials, which take turns."""
    times: dict[TunedSettings, list[float]] = {settings: [] for settings in trials}
    for _ in range(rounds):
        for settings, trial in trials.items():
            times[settings].append(stopwatch(settings, trial.bound.run))
    return times
