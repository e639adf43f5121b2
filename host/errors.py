"""What can go wrong below the vision: one line that says what was wrong, what was expected, what to do."""

from __future__ import annotations


class GpuVisionError(Exception):
    """Base of every error that is gpuvision's own; wrong arguments are ``TypeError`` and ``ValueError``."""


class NoDeviceError(GpuVisionError):
    """No healthy OpenCL device exists, or none of the name that was asked for."""


class DeviceUnusableError(GpuVisionError):
    """The device that was asked for exists, but its probe failed."""


class BuildError(GpuVisionError):
    """A kernel did not compile; the message carries the compiler's log."""


class StreamError(GpuVisionError):
    """A stream stopped: a stage failed, a frame was lost under policy ``raise``, or it was used after its end."""


class RecordingError(GpuVisionError):
    """A recording cannot be read: missing, truncated, empty, or of frames that change their size."""
