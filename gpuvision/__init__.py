"""Range imaging and visual servoing in OpenCL.

Describe an operation once, then call it::

    import gpuvision as gv

    readout = gv.PsdReadout(strip_length=6e-3)
    reading = readout(currents)  # NumPy in, NumPy out
"""

from gpuvision.host import Device
from gpuvision.ranging.psd import PsdReading, PsdReadout
from gpuvision.status import Status

__all__ = ["Device", "PsdReading", "PsdReadout", "Status"]
