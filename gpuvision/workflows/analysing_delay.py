"""Analysis of the delay of a servo loop from its parts or from a recording: limits, gains, margins, picture, report."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.json import json_tree, report_text
from gpuvision.formats.loop_recording import LoopRecording
from gpuvision.host.files import write_text_atomic
from gpuvision.host.outputs import Outputs
from gpuvision.plots.servoing import DelayPicture, draw_delay, draw_measured_delay
from gpuvision.servoing.controllers import PidGains, gains_without_oscillation, simc_gains
from gpuvision.servoing.delay import DelayBudget, continuous_gains, gain_limit
from gpuvision.servoing.delay_measurement import MeasuredDelay, measure_delay
from gpuvision.servoing.delay_response import (
    delay_against_frame_time,
    jitter_gain_limit,
    normal_delays,
    root_locus,
    settling_frames,
    step_response,
)
from gpuvision.servoing.margins import (
    ObserverTolerance,
    PredictorTolerance,
    margins,
    observer_tolerance,
    predictor_tolerance,
)
from gpuvision.validation import finite

DELAY_FILES = ("delay.png", "report.json")
"""Names of the files that `DelayAnalysis.write` always writes."""
MEASURED_PICTURE = "measured_delay.png"
"""Name of the picture of a recording."""

# Gains of a loop with a predictor or an observer whose tolerated model errors are reported: fractions of the predicted
# error. The observer's model has no lag; its random motion in a frame is as large as the noise of a measurement.
_PREDICTOR_GAINS, _NOISE_RATIO = (0.2, 0.5, 0.8), 1.0
# Remaining error of the reported settling time, and frames of the drawn step responses.
_SETTLED, _FRAMES = 0.01, 40
# Longest delay [frames] (chosen): the roots of its picture take 8 s, and their time grows with the third power.
_MAX_FRAMES = 100.0
# Largest jitter [frames] (chosen): four of its standard deviations are the longest delay, and the limit takes seconds.
_MAX_JITTER = 25.0
# Largest difference of the measured scale from 1, and of the frame times relative to each other, without a warning
# (chosen): a wrong unit differs by a factor of 10 and more, a calibration and a clock by a few percent.
_SCALE_ERROR, _PERIOD_ERROR = 0.2, 0.1


@dataclass(frozen=True, kw_only=True)
class DelayAnalysis:
    """Delay of a servo loop and its consequences.

    Attributes
    ----------
    budget : DelayBudget
        Parts of the delay. With a recording and no other parts: one stage, the measured delay.
    measured : MeasuredDelay or None
        Delay of the recording.
    recording : LoopRecording or None
        The recording.
    jitter : float
        Standard deviation of the delay [s].
    """

    budget: DelayBudget
    measured: MeasuredDelay | None
    recording: LoopRecording | None
    jitter: float

    @property
    def delay(self) -> float:
        """Delay from the middle of the exposure to the command [s]: the measured one if there is a recording."""
        return self.budget.latency if self.measured is None else self.measured.mean

    @property
    def frames(self) -> float:
        """Delay in frames."""
        return self.delay / self.budget.period

    def gains(self) -> dict[str, PidGains]:
        """Return the gains by each rule."""
        total = self.delay + self.budget.period / 2.0
        return {
            "non_oscillating": gains_without_oscillation(self.delay, self.budget.period),
            "simc_p": simc_gains(total, integral=False),
            "simc_pi": simc_gains(total),
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Signs of wrong units or missing parts; one line each."""
        found = []
        if self.budget.exposure > self.budget.period * (1.0 + 1e-9):
            found.append(
                f"the exposure of {1e3 * self.budget.exposure:.4g} ms is longer than a frame of "
                f"{1e3 * self.budget.period:.4g} ms; check exposure and frame rate"
            )
        if self.measured is None:
            if self.delay == 0.0:
                found.append("the delay is 0: no part of it is given; the gains hold for a loop without delay")
            return tuple(found)
        if abs(self.measured.scale - 1.0) > _SCALE_ERROR:
            found.append(
                f"the measured motion is {self.measured.scale:.3g} times the commanded motion; check the units of the "
                "columns command and measured [m] or [rad]"
            )
        if not self.measured.converged:
            found.append("the fit of the delay stopped before it converged; record more motion")
        sampled = self.measured.mean / self.measured.frames if self.measured.frames else self.budget.period
        if abs(sampled / self.budget.period - 1.0) > _PERIOD_ERROR:
            found.append(
                f"the samples of the recording are {1e3 * sampled:.4g} ms apart, the frames "
                f"{1e3 * self.budget.period:.4g} ms; check the column time [s] and the frame rate"
            )
        return tuple(found)

    def summary(self) -> str:
        """Return one line: delay, limits and bandwidth."""
        best, period = self.gains()["non_oscillating"].proportional, self.budget.period
        return (
            f"delay {1e3 * self.delay:.4g} ms = {self.frames:.3g} frames of {1e3 * period:.4g} ms: "
            f"unstable from {gain_limit(self.frames) / period:.4g} /s on, no oscillation up to {best:.4g} /s "
            f"({best / (2.0 * math.pi):.3g} Hz)"
        )

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``."""
        period, frames = self.budget.period, self.frames
        continuous = continuous_gains(self.delay + period / 2.0)
        best = self.gains()["non_oscillating"].proportional * period
        tree: dict[str, Any] = {
            "gpuvision": version("gpuvision"),
            "period_s": period,
            "parts_s": self.budget.parts,
            "delay_s": self.delay,
            "delay_frames": frames,
            "total_delay_s": self.delay + period / 2.0,
            "jitter_s": self.jitter,
            "limit_per_frame": gain_limit(frames),
            "limit_with_jitter_per_frame": self._jitter_limit(),
            "non_oscillating_per_frame": best,
            "settling_frames_to_1_percent": settling_frames(frames, best, _SETTLED),
            "continuous_limit_per_s": continuous.limit,
            "continuous_critical_per_s": continuous.critical,
            "rules": {name: self._rule(gains) for name, gains in self.gains().items()},
            "predictor": [self._predictor(gain) for gain in _PREDICTOR_GAINS],
            "observer": [self._observer(gain) for gain in _PREDICTOR_GAINS],
        }
        if self.measured is not None:
            tree["measured"] = {
                "mean_s": self.measured.mean,
                "mean_sigma_s": self.measured.mean_sigma,
                "jitter_s": self.measured.jitter,
                "jitter_sigma_s": self.measured.jitter_sigma,
                "scale": self.measured.scale,
                "noise": self.measured.noise,
                "beyond_the_budget_s": self.measured.mean - self.budget.latency,
            }
        return dict(json_tree(tree))

    def _jitter_limit(self) -> float:
        sigma = self.jitter / self.budget.period
        return jitter_gain_limit(*normal_delays(self.frames, sigma)) if sigma else gain_limit(self.frames)

    def _rule(self, gains: PidGains) -> dict[str, float]:
        found = margins(gains, self.delay, self.budget.period)
        return {
            "proportional_per_s": gains.proportional,
            "integral_s": gains.integral,
            "gain_margin": found.gain,
            "phase_margin_rad": found.phase,
            "delay_margin_s": found.delay,
            "modulus_margin": found.modulus,
            "crossover_Hz": found.crossover,
        }

    def _shorter(self, found: PredictorTolerance | ObserverTolerance) -> float | None:
        """Return the least reduction of the delay [s] that makes the loop unstable; None if no reduction does."""
        return found.shorter * self.budget.period if found.shorter < self.frames else None

    def _predictor(self, gain: float) -> dict[str, float | None]:
        found, period = predictor_tolerance(gain, self.frames), self.budget.period
        return {
            "gain_per_frame": gain,
            "unstable_from_shorter_by_s": self._shorter(found),
            "unstable_from_longer_by_s": found.longer * period,
            "unstable_from_plant_gain": found.plant_gain,
        }

    def _observer(self, gain: float) -> dict[str, float | None]:
        found, period = observer_tolerance(gain, self.frames, noise_ratio=_NOISE_RATIO), self.budget.period
        return {
            "gain_per_frame": gain,
            "noise_ratio": _NOISE_RATIO,
            "unstable_from_shorter_by_s": self._shorter(found),
            "unstable_from_longer_by_s": found.longer * period,
            "unstable_from_lag_s": found.lag * period,
            "unstable_from_plant_gain": found.plant_gain,
        }

    def sweep(self) -> npt.NDArray[np.float64]:
        """Return the frame times of the last picture [s], from a tenth of the period to ten periods."""
        # 1e-6: at the longest delay a tenth of the period is the longest delay of the gains, without its rounding.
        return np.asarray(self.budget.period * np.geomspace(0.1 * (1.0 + 1e-6), 10.0, 60), np.float64)

    def picture(self) -> DelayPicture:
        """Return the data of ``delay.png``."""
        limit, period = gain_limit(self.frames), self.budget.period
        chosen = {
            "no oscillation": self.gains()["non_oscillating"].proportional * period,
            "half of the limit": 0.5 * limit,
            "90 % of the limit": 0.9 * limit,
        }
        labels = {f"{name}: gain {gain:.3g}": gain for name, gain in chosen.items()}
        return DelayPicture(
            title=self.summary(),
            parts=self.budget.parts,
            steps=[(label, step_response(self.frames, gain, _FRAMES)) for label, gain in labels.items()],
            locus=root_locus(self.frames, np.linspace(0.0, 1.3, 400)[1:] * limit),
            marked=[(label, root_locus(self.frames, gain)[0]) for label, gain in labels.items()],
            curve=delay_against_frame_time(self.budget, self.sweep()),
            period=period,
        )

    def write(self, folder: str | Path, *, inputs: tuple[Path, ...] = (), overwrite: bool = False) -> None:
        """Write ``delay.png``, ``report.json`` and, with a recording, ``measured_delay.png``.

        Parameters
        ----------
        folder : str or Path
            Output folder; created if it is missing.
        inputs : tuple of Path
            Files that are never replaced.
        overwrite : bool
            Whether files may be replaced that no earlier analysis wrote. Default False.

        Raises
        ------
        OSError
            A file exists that is not an output of an earlier analysis, or the folder cannot be written.
        """
        outputs = Outputs("delay", inputs=inputs, overwrite=overwrite)
        with outputs.folder(folder, optional=[MEASURED_PICTURE]) as inside:
            draw_delay(inside / DELAY_FILES[0], self.picture())
            if self.measured is not None and self.recording is not None:
                draw_measured_delay(inside / MEASURED_PICTURE, *self.recording, self.measured)
            write_text_atomic(inside / DELAY_FILES[1], report_text(self.report()))


def analyse_delay(
    budget: DelayBudget | None = None, *, recording: LoopRecording | None = None, jitter: float | None = None
) -> DelayAnalysis:
    """Analyse the delay of a servo loop.

    Parameters
    ----------
    budget : DelayBudget, optional
        Parts of the delay. Default: the recording alone.
    recording : LoopRecording, optional
        Recording of an excited axis; its delay is measured and used instead of the delay of the budget.
    jitter : float, optional
        Standard deviation of the delay [s]. Default: the jitter of the recording, or 0. Range: 0 or more.

    Raises
    ------
    ValueError
        Neither a budget nor a recording is given, the recording shows no delay (see `measure_delay`), the delay is
        longer than 100 frames, or the jitter is larger than 25 frames.
    """
    if budget is None and recording is None:
        raise ValueError("give the parts of the delay, or a recording")
    measured = None if recording is None else measure_delay(*recording)
    if budget is None and measured is not None:
        budget = DelayBudget(period=measured.mean / measured.frames, stages={"measured": measured.mean})
    assert budget is not None
    known = 0.0 if measured is None else measured.jitter
    done = DelayAnalysis(
        budget=budget,
        measured=measured,
        recording=recording,
        jitter=known if jitter is None else finite(jitter, "jitter", minimum=0.0),
    )
    if done.frames > _MAX_FRAMES * (1.0 + 1e-9):
        advice = "exposure, readout, transfer and stages" if measured is None else "the recording"
        raise ValueError(
            f"the delay is {done.delay:.4g} s = {done.frames:.4g} frames of {1e3 * budget.period:.4g} ms, expected at "
            f"most {_MAX_FRAMES:g} frames; check the units of {advice}"
        )
    if done.jitter > _MAX_JITTER * budget.period:
        raise ValueError(
            f"the jitter is {done.jitter:.4g} s = {done.jitter / budget.period:.4g} frames of "
            f"{1e3 * budget.period:.4g} ms, expected at most {_MAX_JITTER:g} frames; check its unit"
        )
    return done
