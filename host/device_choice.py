"""Choice between GPU and CPU for operations with little work, by measured times.

A launch on a GPU and the copies to and from it take tens of microseconds. A CPU device solves the pose of a board in
this time.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gpuvision.host.arrays import HostArray
from gpuvision.host.device import Device, requested_device
from gpuvision.host.errors import GpuVisionError
from gpuvision.host.operation import Operation

# Calls that bind the operation and fill the caches, and timed calls, of which the median counts. Chosen: pauses of a
# shared machine hit a few calls.
_WARM_UP, _CALLS = 3, 15


@dataclass(frozen=True, kw_only=True)
class DeviceChoice:
    """Device on which an operation is fastest; ``str(choice)`` states it in one line.

    Attributes
    ----------
    operation : str
        Class of the operation.
    device : Device
        Fastest device.
    seconds : mapping of str to float
        Median time of a call on NumPy arrays [s], by the label of each measured device.
    unusable : mapping of str to str
        First line of the error of each device that cannot run the operation, by its label.
    """

    operation: str
    device: Device
    seconds: Mapping[str, float]
    unusable: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        others = [f"{label} {1e6 * s:.3g} us" for label, s in self.seconds.items() if label != self.device.label]
        others += [f"{label} is not usable: {reason}" for label, reason in self.unusable.items()]
        against = f" ({', '.join(others)})" if others else ""
        return f"{self.operation} on {self.device.label}, {1e6 * self.seconds[self.device.label]:.3g} us{against}"


def candidate_devices() -> tuple[Device, ...]:
    """Return the devices to choose from: the best GPU and the best CPU device, best first.

    Only the default device where the variable ``GPUVISION_DEVICE`` names it.

    Raises
    ------
    NoDeviceError
        There is no healthy device.
    """
    first = Device.best()
    if requested_device():
        return (first,)
    other = next((each for each in Device.all() if each.is_cpu is not first.is_cpu), None)
    return (first,) if other is None else (first, other)


def fastest_device(operation: Operation[Any], *inputs: HostArray, devices: Sequence[Device] = ()) -> DeviceChoice:
    """Measure an operation on each device and return the fastest one.

    Parameters
    ----------
    operation : Operation
    *inputs : numpy.ndarray
        Typical inputs.
    devices : sequence of Device, optional
        Devices to measure. Default: the best GPU and the best CPU device.

    Returns
    -------
    DeviceChoice

    Raises
    ------
    NoDeviceError
        There is no healthy device.
    TypeError
        The operation does not take such input.
    GpuVisionError, ValueError
        No device runs the operation on such input; the error is the first device's.

    Notes
    -----
    The time is the time of a call with copies to the device and back. With one device, it is measured, too.

    Examples
    --------
    >>> import numpy as np
    >>> import gpuvision as gv
    >>> choice = gv.fastest_device(gv.PsdReadout(strip_length=6e-3), np.ones((1000, 2), np.float32))
    >>> reading = gv.PsdReadout(strip_length=6e-3)(np.ones((1000, 2), np.float32), device=choice.device)
    """
    measured: dict[Device, float] = {}
    failures: dict[str, Exception] = {}
    for each in devices or candidate_devices():
        try:
            measured[each] = _seconds(operation, inputs, each)
        except (GpuVisionError, ValueError) as error:
            failures[each.label] = error
    if not measured:
        raise next(iter(failures.values()))
    return DeviceChoice(
        operation=type(operation).__name__,
        device=min(measured, key=measured.__getitem__),
        seconds={each.label: s for each, s in measured.items()},
        unusable={label: str(error).partition("\n")[0] for label, error in failures.items()},
    )


def _seconds(operation: Operation[Any], inputs: Sequence[HostArray], device: Device) -> float:
    """Return the median time of a call [s]."""
    times = []
    for _ in range(_WARM_UP + _CALLS):
        start = time.perf_counter()
        operation(*inputs, device=device)
        times.append(time.perf_counter() - start)
    return sorted(times[_WARM_UP:])[_CALLS // 2]
