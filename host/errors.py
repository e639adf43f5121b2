"""Exceptions of gpuvision; each message states the error, the expected value and a remedy."""

from __future__ import annotations


class GpuVisionError(Exception):
    """Base class of gpuvision's exceptions; wrong arguments raise ``TypeError`` and ``ValueError``."""


class NoDeviceError(GpuVisionError):
    """No healthy OpenCL device exists, or no healthy device has the requested name."""


class DeviceUnusableError(GpuVisionError):
    """The requested device exists, and its probe failed."""


class DeviceLostError(GpuVisionError):
    """The context of a device is lost, with all its arrays, after an error of a kernel or of the driver."""


class DeviceMemoryError(GpuVisionError, MemoryError):
    """A device cannot allocate an array, or has no memory or registers for a launch."""


class DeviceLimitError(DeviceMemoryError):
    """An array or a kernel needs more than the device ever has; freeing memory does not help."""


class BuildError(GpuVisionError):
    """A kernel does not compile; the message contains the compiler's log."""


class StreamError(GpuVisionError):
    """A stream stopped: a stage failed, a frame was lost under policy ``raise``, or it was used after its end."""


class RecordingError(GpuVisionError):
    """A recording cannot be read: it is missing, truncated or empty, or its frames change their size."""


class ReadError(GpuVisionError, ValueError):
    """A file cannot be read: it is damaged, of another format, or larger than a `FileLimit`."""
