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

__all__ = [
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
    "Precision",
    "RecordingError",
    "StreamError",
    "Walk",
    "host_view",
    "in_strips",
    "real_defines",
    "real_of",
]
