"""Exceptions of gpuvision; each message says what was wrong, what was expected, and what to do."""

from __future__ import annotations


class GpuVisionError(Exception):
    """Base class of gpuvision's exceptions; wrong arguments raise ``TypeError`` and ``ValueError``."""


class NoDeviceError(GpuVisionError):
    """There is no healthy OpenCL device, or none with the requested name."""


class DeviceUnusableError(GpuVisionError):
    """The requested device exists, and its probe failed."""


class BuildError(GpuVisionError):
    """A kernel does not compile; the message contains the compiler's log."""


class StreamError(GpuVisionError):
    """A stream stopped: a stage failed, a frame was lost under policy ``raise``, or it was used after its end."""


class RecordingError(GpuVisionError):
    """A recording cannot be read: it is missing, truncated or empty, or its frames change their size."""
