"""Plans of scans against truth: random lines, tolerances and rates: ``python -m gpuvision.profiling.scan_plans``.

Each job is a recording of a simulated line with known heights. A plan holds if the true error of its scan is at most
the tolerance, and if its stream loses no frame at the asked rate. Its cost is its time over the time of the fastest
readout that truly meets the tolerance, among all that were tried (exhaustive search).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError
from gpuvision.host import ArraySource, Device, PacedSource, Pipeline, plan_stream, to_numpy
from gpuvision.profiling.plan_outcomes import Outcome, cost_of, room_of, run_jobs
from gpuvision.ranging.line import LineReadout
from gpuvision.reference.line import pixel_gaussian
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.planning_scan import plan_scan
from gpuvision.workflows.scan_plan import ScanPlan, ScanPlanLimits, usable_trials
from gpuvision.workflows.scanning import measure_points, range_readout

Float64 = npt.NDArray[np.float64]

_FRAMES, _ROWS, _COLUMNS = 48, 64, 480  # of the sensor "camera_line"
_ENDLESS = 1 << 40  # frames
_SECONDS = 0.5  # duration of a stream


class Job(NamedTuple):
    """Recording with known truth, and what is asked of its scan.

    Attributes
    ----------
    sensor : Sensor
        Sensor with the noise of the recording.
    frames : (frames, rows, columns) uint8
        Recording.
    true : (frames, columns) float64
        True positions of the line [px].
    tolerance : float
        Largest error of the heights, as a multiple of the smallest true one.
    rate : float
        Frame rate, as a fraction of the rate at which the kernel of the fastest readout runs.
    """

    sensor: Sensor
    frames: npt.NDArray[np.uint8]
    true: Float64
    tolerance: float
    rate: float


def random_job(rng: np.random.Generator) -> Job:
    """Draw a line from 1 to 4 px wide, its light and noise, a tolerance and a rate."""
    sensor = Sensor.load("camera_line")
    sigma, peak = rng.uniform(1.0, 4.0), math.exp(rng.uniform(math.log(25.0), math.log(220.0)))
    read_noise, gain, background = rng.uniform(0.5, 2.5), math.exp(rng.uniform(math.log(0.01), math.log(0.2))), 5.0
    noise = math.hypot(read_noise, math.sqrt(gain * background))
    true = 31.0 + 8.0 * np.sin(np.arange(_COLUMNS) / 70.0 + rng.uniform(0.0, 6.0, (_FRAMES, 1)))
    light = pixel_gaussian(np.arange(_ROWS)[:, None], np.asarray(true[:, None, :]), sigma, peak, background)  # type: ignore[arg-type]
    noisy = rng.poisson(light / gain) * gain + rng.normal(0.0, read_noise, light.shape)
    given: Any = sensor.readout
    readout = dataclasses.replace(
        given,
        threshold=math.ceil(background + 4.0 * noise),
        minimum_peak=None,
        ambiguity=None,
        read_noise=read_noise,
        gain=gain,
    )
    sensor = dataclasses.replace(sensor, readout=readout, noise_known=True)
    frames = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return Job(sensor, frames, true, math.exp(rng.uniform(math.log(0.7), math.log(6.0))), rng.uniform(0.05, 0.6))


def judge(rng: np.random.Generator, device: Device, limits: ScanPlanLimits = ScanPlanLimits()) -> Outcome:
    """Plan a random job and measure the plan against truth."""
    job = random_job(rng)
    # A first plan that any readout meets gives the times and errors that the asked values are multiples of.
    free = plan_scan(job.frames, job.sensor, tolerance=1.0, device=device)
    usable = usable_trials(free.trials, limits)
    rate = job.rate / free.trials[0].seconds
    errors = {each.readout: true_error(job, each.readout, device) for each in usable}
    tolerance = job.tolerance * min(errors.values())
    meeting = {readout for readout, error in errors.items() if error <= tolerance}
    room = room_of([errors[each.readout] for each in usable], [each.seconds for each in usable], tolerance, rate)
    try:
        plan = plan_scan(job.frames, job.sensor, tolerance=tolerance, rate=rate, device=device, limits=limits)
    except PlanError:
        return Outcome(None, tolerance, possible=room >= 1.0, room=room)
    error = true_error(job, plan.chosen.readout, device)
    cost = cost_of(plan, [each for each in plan.trials if each.readout in meeting])
    return Outcome(plan, tolerance, error, room >= 1.0, cost, not _lost(job, plan, rate), room)


def true_error(job: Job, readout: LineReadout, device: Device) -> float:
    """Return the root mean square error of the heights of a recording [m]."""
    sensor = dataclasses.replace(job.sensor, readout=readout)
    operation = range_readout(sensor)
    reading = operation(job.frames, device=device)
    fields = {name: to_numpy(getattr(reading, name)) for name in operation.outputs or ()}
    found = to_numpy(measure_points(sensor, fields, np.arange(_FRAMES), device)[0].z).astype(np.float64)
    true = _true_heights(job, device)
    return math.sqrt(float(np.nanmean((found - true) ** 2)))


def _true_heights(job: Job, device: Device) -> Float64:
    """Return the heights of the true positions (frames, columns) [m]."""
    readout: Any = job.sensor.readout
    axes = readout.axes
    u = axes.position_origin + axes.position_pitch * job.true
    v = np.broadcast_to(axes.sample_origin + axes.sample_pitch * np.arange(_COLUMNS), u.shape)
    sheet = dataclasses.replace(readout.triangulation, precision="double")
    return np.asarray(to_numpy(sheet(u, np.ascontiguousarray(v), device=device).h), np.float64)


def _lost(job: Job, plan: ScanPlan, rate: float) -> int:
    """Return the number of frames that a stream of the chosen readout loses at a rate.

    It is planned as that of the plan, but for an endless recording: the ring of a short one holds all its frames.
    """
    readout = range_readout(plan.sensor)
    settings = plan_stream(
        ArraySource(job.frames, _ENDLESS),
        readout,
        rate=rate,
        margin=plan.limits.rate_margin,
        device=plan.stream.device if plan.stream else None,
        sample=job.frames,
    ).settings
    source = PacedSource(ArraySource(job.frames, max(math.ceil(_SECONDS * rate), 10)), rate)
    stream: Pipeline[Any] = Pipeline(source, readout, policy="drop_oldest", **settings)
    with stream:
        for _ in stream:
            pass
    return stream.report().dropped


if __name__ == "__main__":
    raise SystemExit(run_jobs(judge, (__doc__ or "").partition("\n\n")[2]))
