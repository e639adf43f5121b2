"""Plans of scans against truth: random sensors, surfaces, tolerances and rates.

``python -m gpuvision.profiling.scan_plans`` plans them. Each job is a recording with known heights, of a camera or of
PSDs. A plan holds if the true error of its scan is at most the tolerance, and if its stream keeps up with the asked
rate: frames arrive at this rate for two seconds, the rate of the results is measured, and no frame is read later than
the planned ring allows. Its cost is its time over the time of the fastest readout that truly meets the tolerance, among
all that were tried (exhaustive search).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError
from gpuvision.host import ArraySource, Device, PacedSource, Pipeline, to_numpy
from gpuvision.profiling.plan_outcomes import Outcome, cost_of, room_of, run_jobs
from gpuvision.profiling.scan_jobs import Job, random_job
from gpuvision.workflows.planning_scan import choose_readout, try_readouts
from gpuvision.workflows.scan_plan import ReadoutTrial, ScanPlan, ScanPlanLimits
from gpuvision.workflows.scanning import measure_points, range_readout

Float64 = npt.NDArray[np.float64]

_FASTEST = 100e3  # frames/s: of a PSD; a paced source gives few more
_ENDLESS = 1 << 40  # frames: the ring of a short recording would hold all its frames
_BATCHES = (16, 128)  # frames of a batch, of which the one with the higher throughput counts
_TRIAL_SECONDS = 0.1  # duration of a stream whose throughput is measured
_SECONDS = 2.0  # duration of a stream with a rate
# Least rate of the results over the rate of the frames (chosen): results that come up to 10 ms later after a second are
# jitter, a stream that is 4 % too slow gives results 40 ms later.
_KEPT = 0.99
_SWITCH = 5e-3  # s: time after which Python switches threads, which is no wait for a slot and no late read
_SLOTS = 64  # of the ring of that stream: to set up the thousands of slots of some plans takes a minute


class Measured(NamedTuple):
    """Readout, measured against truth.

    Attributes
    ----------
    trial : ReadoutTrial
        The readout with its time, as the planner tried it.
    error : float
        Root mean square error of the heights [m].
    lost : float
        Fraction of the samples without a height.
    """

    trial: ReadoutTrial
    error: float
    lost: float


class Service(NamedTuple):
    """Service of a stream whose frames arrive at a rate.

    Attributes
    ----------
    share : float
        Rate of the results over the rate of the frames.
    waited : float
        Longest time for which a frame waited for a free slot [s].
    late : float
        Longest delay of the read of a frame after its due time [s]: several waits in a row add up to it.
    longest : float
        Longest delay at which the planned ring loses no frame [s].
    """

    share: float
    waited: float
    late: float
    longest: float

    @property
    def keeps_up(self) -> bool:
        """Whether the stream gives results at the rate of the frames, and loses none."""
        return max(self.waited, self.late) <= self.longest and self.share >= _KEPT

    def __str__(self) -> str:
        waited, late, longest = (1e3 * each for each in (self.waited, self.late, self.longest))
        return (
            f"{self.share:.4g} of the rate, a frame waited {waited:.3g} ms and was {late:.3g} of {longest:.3g} ms late"
        )


def judge(rng: np.random.Generator, device: Device, limits: ScanPlanLimits = ScanPlanLimits()) -> Outcome:
    """Plan a random job and measure the plan against truth."""
    job = random_job(rng)
    tried = try_readouts(job.frames, job.sensor, device=device, limits=limits)
    heights = true_heights(job, device)
    truth = [Measured(each, *true_error(job, each, heights, device)) for each in tried.trials]
    fewest = min(each.lost for each in truth)
    kept = [each for each in truth if each.lost <= fewest + limits.max_lost]
    tolerance = job.tolerance * min(each.error for each in kept)
    rate = job.rate * min(throughput(job, kept[0].trial, device), _FASTEST)
    meeting = [each.trial for each in kept if each.error <= tolerance]
    endless = tried._replace(sample=tried.sample._replace(length=_ENDLESS))
    try:
        plan = choose_readout(endless, tolerance=tolerance, rate=rate, limits=limits)
    except PlanError:
        rates = [throughput(job, each, device) for each in meeting]
        errors = [each.error for each in kept if each.error <= tolerance]
        room = room_of(errors, [1.0 / each for each in rates], tolerance, rate)
        return Outcome(None, tolerance, possible=room >= 1.0, room=room)
    error, _ = true_error(job, plan.chosen, heights, device)
    service = serve(job, plan, rate)
    cost = cost_of(plan, meeting)
    return Outcome(plan, tolerance, error, bool(meeting), cost, service.keeps_up, note=str(service))


def true_heights(job: Job, device: Device) -> Float64:
    """Return the heights of the true positions (frames, samples) [m]."""
    readout: Any = job.sensor.readout
    axes = readout.axes
    u = axes.position_origin + axes.position_pitch * job.true
    v = np.broadcast_to(axes.sample_origin + axes.sample_pitch * np.arange(u.shape[1]), u.shape)
    sheet = dataclasses.replace(readout.triangulation, precision="double")
    return np.asarray(to_numpy(sheet(u, np.ascontiguousarray(v), device=device).h), np.float64)


def true_error(job: Job, trial: ReadoutTrial, heights: Float64, device: Device) -> tuple[float, float]:
    """Return the root mean square error of the heights of a recording [m], and the fraction of lost samples."""
    sensor = dataclasses.replace(job.sensor, readout=trial.readout)
    operation = range_readout(sensor)
    reading = operation(job.frames, device=device)
    fields = {name: to_numpy(getattr(reading, name)) for name in operation.outputs or ()}
    found = to_numpy(measure_points(sensor, fields, np.arange(len(job.frames)), device)[0].z).astype(np.float64)
    squares = (found - heights) ** 2
    known = np.isfinite(squares)
    error = math.sqrt(float(np.mean(squares[known]))) if known.any() else math.inf
    return error, float(np.mean(~known))


def throughput(job: Job, trial: ReadoutTrial, device: Device) -> float:
    """Return the highest throughput of streams of a readout whose frames arrive without pause [frames/s]."""
    operation = range_readout(dataclasses.replace(job.sensor, readout=trial.readout))
    rates = []
    for batch in _BATCHES:
        batches = max(math.ceil(_TRIAL_SECONDS / (batch * trial.seconds)), 8)
        source = ArraySource(job.frames, batch * batches)
        stream: Pipeline[Any] = Pipeline(source, operation, device=device, batch=batch, warm_up=2)
        rates.append(stream.run().throughput)
    return max(rates)


def serve(job: Job, plan: ScanPlan, rate: float) -> Service:
    """Run the stream of a plan with frames at a rate [frames/s].

    Frames wait for a free slot of a ring that may be shorter than the planned one: the planned ring would lose a frame
    only if the read of a frame is later than the time that the missing slots take to fill.
    """
    planned = plan.stream
    assert planned is not None  # the plan has a rate
    ring = min(planned.ring, _SLOTS)
    source = PacedSource(ArraySource(job.frames, max(math.ceil(_SECONDS * rate), 20)), rate)
    settings = planned.settings | {"ring": ring, "policy": "block", "warm_up": 0}
    with Pipeline[Any](source, range_readout(plan.sensor), **settings) as stream:
        batches = [(batch.number + len(batch), batch.arrived[-1], batch.delivered) for batch in stream]
        waited = stream.report().stages["slot"].maximum
    longest = (planned.ring - ring) * planned.batch / rate + _SWITCH
    return Service(served_rate(np.array(batches)) / rate, waited, source.late * 1e-9, longest)


def served_rate(batches: npt.NDArray[np.int64]) -> float:
    """Return the rate at which a stream gives results [frames/s].

    It is the rate between two deliveries, which have the shortest latencies of the first and of the last quarter of the
    batches: there a stream is not behind by a stall from which it recovers, and is behind if it is too slow. NaN for a
    single batch.

    Parameters
    ----------
    batches : (batches, 3) int64
        Number of frames up to each batch, arrival of its last frame and delivery [ns]. Frames that wait at the source
        have arrived when they were due.
    """
    if len(batches) < 2:
        return math.nan
    quarter = max(len(batches) // 4, 1)
    first, last = (each[np.argmin(each[:, 2] - each[:, 1])] for each in (batches[:quarter], batches[-quarter:]))
    return float((last[0] - first[0]) / ((last[2] - first[2]) * 1e-9))


if __name__ == "__main__":
    raise SystemExit(run_jobs(judge, (__doc__ or "").partition("\n\n")[2]))
