"""Run kernels: find devices, build programs, bind operations, stream frames. Knows no vision."""

from gpuvision.host.arrays import DeviceArray, HostArray, host_view
from gpuvision.host.device import Device
from gpuvision.host.errors import (
    BuildError,
    DeviceUnusableError,
    GpuVisionError,
    NoDeviceError,
    RecordingError,
    StreamError,
)
from gpuvision.host.operation import Bound, Launch, Operation, Precision, Walk, in_strips, real_defines, real_of
from gpuvision.host.pipeline import Batch, Pipeline
from gpuvision.host.plan import Plan, plan
from gpuvision.host.recordings import open_recording
from gpuvision.host.report import StreamReport
from gpuvision.host.ring import Step
from gpuvision.host.sources import ArraySource, PacedSource, Source
from gpuvision.host.trace import Trace

__all__ = [
    "ArraySource",
    "Batch",
    "Bound",
    "BuildError",
    "Device",
    "DeviceArray",
    "DeviceUnusableError",
    "GpuVisionError",
    "HostArray",
    "Launch",
    "NoDeviceError",
    "Operation",
    "PacedSource",
    "Pipeline",
    "Plan",
    "Precision",
    "RecordingError",
    "Source",
    "Step",
    "StreamError",
    "StreamReport",
    "Trace",
    "Walk",
    "host_view",
    "in_strips",
    "open_recording",
    "plan",
    "real_defines",
    "real_of",
]
