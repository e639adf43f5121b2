"""Range imaging and visual servoing in OpenCL.

Describe an operation once, then call it::

    import gpuvision as gv

    readout = gv.PsdReadout(strip_length=6e-3)
    reading = readout(currents)  # NumPy in, NumPy out

or bind it to a device and a shape for the hot path, or stream frames through it with a `Pipeline`.
"""

from gpuvision.camera.lens import Lens
from gpuvision.host import Device, GpuVisionError, Pipeline, Step, host_view, open_recording
from gpuvision.ranging.line import LineReading, LineReadout
from gpuvision.ranging.psd import PsdNoise, PsdReading, PsdReadout
from gpuvision.ranging.range_image import RangeImage, RangePoints, RotatingSheet, StraightTransport
from gpuvision.ranging.regrid import Grid, HeightMap, Regrid
from gpuvision.ranging.triangulation import SampleAxes, SheetPoints, Triangulation
from gpuvision.status import Status

__all__ = [
    "Device",
    "GpuVisionError",
    "Grid",
    "HeightMap",
    "Lens",
    "LineReading",
    "LineReadout",
    "Pipeline",
    "PsdNoise",
    "PsdReading",
    "PsdReadout",
    "RangeImage",
    "RangePoints",
    "Regrid",
    "RotatingSheet",
    "SampleAxes",
    "SheetPoints",
    "Status",
    "Step",
    "StraightTransport",
    "Triangulation",
    "host_view",
    "open_recording",
]
