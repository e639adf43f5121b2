"""Poses from a stream of frames, with the times that an observer needs."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Batch
from gpuvision.matching.pose.feature_pose import FeaturePose
from gpuvision.servoing.observer import PoseMeasurement

_SECONDS_PER_TICK = 1e-9


def streamed_pose(batch: Batch[FeaturePose], start: float = 0.0) -> PoseMeasurement:
    """Return the pose of a frame of a stream, with the times of its exposure and of its arrival at the consumer.

    Parameters
    ----------
    batch : Batch of FeaturePose
        One frame of a `gpuvision.host.Pipeline` of `EstimateFeaturePose`.
    start : float
        Time 0 of the measurement's times, in seconds of `time.perf_counter`: `WallClock.start` for a `ServoLoop` with
        this clock. Default 0.

    Returns
    -------
    PoseMeasurement
        Copies, which stay valid; times in seconds since ``start``. ``exposed`` is the arrival of the frame minus
        the `exposure_delay` of the source, ``arrived`` the time at which the result was in host memory.
    """
    result = batch.result
    return PoseMeasurement(
        exposed=_SECONDS_PER_TICK * float(batch.exposed[0]) - start,
        arrived=_SECONDS_PER_TICK * batch.delivered - start,
        pose=np.array(result.pose[0], np.float64),
        covariance=np.array(result.covariance[0], np.float64),
        status=int(np.asarray(result.status)[0]),
    )
