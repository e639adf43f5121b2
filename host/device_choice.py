"""Choice between GPU and CPU for operations with little work, by measured times.

A launch on a GPU and the copies to and from it take tens of microseconds. A CPU device solves the pose of a board in
this time.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gpuvision.host.arrays import HostArray
from gpuvision.host.device import Device, requested_device
from gpuvision.host.errors import DeviceLostError, DeviceMemoryError, GpuVisionError
from gpuvision.host.kept_numbers import driver_key, kept_number
from gpuvision.host.operation import Operation
from gpuvision.host.program import sources_digest

# Calls that bind the operation and fill the caches, and timed calls, of which the median counts. Chosen: pauses of a
# shared machine hit a few calls.
_WARM_UP, _CALLS = 3, 15
# The same of a step of a job, and the time after which no more runs start [s] (chosen): a step takes up to a second.
# The first run does not count even where it takes longer: it compiles kernels.
_STEP_WARM_UP, _STEP_CALLS, _STEP_SECONDS = 1, 5, 0.2
# Age at which the times of steps are measured again (chosen): a machine changes, for example by cooling or other users.
_MAX_DAYS = 30
# First lines of the errors of devices that cannot run a step, by the key of the step's times; see `StepDevices.choose`.
_failures: dict[str, str] = {}


@dataclass(frozen=True, kw_only=True)
class DeviceChoice:
    """Device on which an operation is fastest; ``str(choice)`` states it in one line.

    Attributes
    ----------
    operation : str
        Class of the operation, or name of the step of a job.
    device : Device
        Fastest device.
    seconds : mapping of str to float
        Median time of a call on NumPy arrays [s], by the label of each measured device; empty without a choice.
    unusable : mapping of str to str
        First line of the error of each device that cannot run the operation, by its label.
    """

    operation: str
    device: Device
    seconds: Mapping[str, float]
    unusable: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.seconds:
            return f"{self.operation} on {self.device.label}"
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

    def seconds(device: Device) -> float:
        return _median_seconds(lambda: operation(*inputs, device=device), _WARM_UP, _CALLS)

    return _choose(type(operation).__name__, devices or candidate_devices(), seconds)


class StepDevices:
    """Devices of the steps of a job, such as the location of a board: each step runs where it is fastest.

    Parameters
    ----------
    device : Device or None
        Device of all steps. ``None``: of the best GPU and the best CPU device the faster one for each step, where both
        exist and ``GPUVISION_DEVICE`` is not set; otherwise `Device.best`.
    kernel_folders : sequence of pathlib.Path, optional
        Folders of the kernels that the steps run, such as ``gpuvision.operation.KERNEL_FOLDER``. Times that were kept
        with other kernels do not count.

    Attributes
    ----------
    choices : dict of str to DeviceChoice
        Device and measured times of each step so far, by name.

    Raises
    ------
    NoDeviceError
        There is no healthy device.
    """

    def __init__(self, device: Device | None, *, kernel_folders: Sequence[Path] = ()) -> None:
        self._candidates = candidate_devices() if device is None else (device,)
        self._kernel_folders = tuple(kernel_folders)
        self.choices: dict[str, DeviceChoice] = {}

    @property
    def first(self) -> Device:
        """Given device of all steps. Without a given device: the best one."""
        return self._candidates[0]

    def choose(self, step: str, run: Callable[[Device], object], *size: object) -> Device:
        """Return the device of a step.

        Parameters
        ----------
        step : str
            Name of the step.
        run : function
            Runs the step on a device. It is called only to measure: where there are two devices to choose from, and
            their times for this step and size are not kept from an earlier measurement.
        *size : object
            What determines the cost of the step, such as shape and dtype of an image. Floats are rounded to powers of
            two: numbers that are nearly equal share their times.

        Notes
        -----
        Times are kept in the file ``step_seconds.json`` of the cache folder, for the version of gpuvision and of the
        driver, for the text of the kernels in ``kernel_folders``, and for 30 days at most; delete the file to measure
        again. A measurement runs the step at least twice on each device, and up to 6 times where the runs take less
        than 0.2 s together; then the job runs the step. A device that fails while another one runs the step is left out
        until the process ends, for this size of the step. A full memory and a lost device are tried again in the next
        call.
        """
        if len(self._candidates) == 1:
            self.choices[step] = DeviceChoice(operation=step, device=self.first, seconds={})
        else:
            kernels = tuple(sources_digest(each) for each in self._kernel_folders)
            self.choices[step] = _choose_for_step(step, run, (*kernels, *size), self._candidates)
        return self.choices[step].device

    def report(self) -> dict[str, Any]:
        """Return device and measured times [s] of each step for JSON."""
        return {
            name: {"device": each.device.label, "seconds": dict(each.seconds), "unusable": dict(each.unusable)}
            for name, each in self.choices.items()
        }


def _choose_for_step(
    step: str, run: Callable[[Device], object], size: tuple[object, ...], candidates: Sequence[Device]
) -> DeviceChoice:
    """Return the device of a step; leave out the devices that failed before in this process, and note new failures."""
    keys = {each: repr(_key_of(step, size, each)) for each in candidates}
    usable = [each for each in candidates if keys[each] not in _failures] or candidates
    errors: dict[Device, Exception] = {}
    choice = _choose(step, usable, lambda device: _kept_seconds(step, run, size, device), errors)
    for device, error in errors.items():
        if not isinstance(error, DeviceLostError | DeviceMemoryError):
            _failures[keys[device]] = choice.unusable[device.label]
    known = {each.label: _failures[keys[each]] for each in candidates if each not in usable}
    return replace(choice, unusable={**known, **choice.unusable})


def _key_of(step: str, size: tuple[object, ...], device: Device) -> tuple[object, ...]:
    """Return the key of the kept time of a step on a device; floats as powers of two."""
    rounded = [math.frexp(each)[1] if isinstance(each, float) and each != 0.0 else each for each in size]
    return (version("gpuvision"), device.label, *driver_key(device.handle), step, *rounded)


def _kept_seconds(step: str, run: Callable[[Device], object], size: tuple[object, ...], device: Device) -> float:
    """Return the median time of a step on a device [s], measured now or before."""
    measure = functools.partial(_median_seconds, lambda: run(device), _STEP_WARM_UP, _STEP_CALLS, _STEP_SECONDS)
    return kept_number("step_seconds.json", _key_of(step, size, device), measure, max_days=_MAX_DAYS)


def _choose(
    name: str,
    devices: Sequence[Device],
    seconds: Callable[[Device], float],
    failures: dict[Device, Exception] | None = None,
) -> DeviceChoice:
    """Return the device with the least time; leave out devices that cannot run the operation (add to `failures`)."""
    measured: dict[Device, float] = {}
    failures = {} if failures is None else failures
    for each in devices:
        try:
            measured[each] = seconds(each)
        except (GpuVisionError, ValueError) as error:
            failures[each] = error
    if not measured:
        raise next(iter(failures.values()))
    return DeviceChoice(
        operation=name,
        device=min(measured, key=measured.__getitem__),
        seconds={each.label: s for each, s in measured.items()},
        unusable={each.label: str(error).partition("\n")[0] for each, error in failures.items()},
    )


def _median_seconds(call: Callable[[], object], warm_up: int, calls: int, limit: float = math.inf) -> float:
    """Return the median time of a call [s], of fewer calls where they take longer than a limit together [s]."""
    times: list[float] = []
    begun = time.perf_counter()
    while len(times) < warm_up + calls:
        start = time.perf_counter()
        call()
        end = time.perf_counter()
        times.append(end - start)
        if len(times) > warm_up and end - begun > limit:
            break
    timed = sorted(times[warm_up:])
    return timed[len(timed) // 2]
