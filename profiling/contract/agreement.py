"""Check of the contract: run operations on all devices, compare with float64 and between devices.

A limit is a stated factor times a quantity of the case: 4 epsilon times half the strip length. Two devices whose
results are within a limit of float64 differ by at most twice the limit (triangle inequality). Outputs that are computed
in integers, and outputs that are copied or compared only, are equal on all devices.
"""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Operation, to_numpy
from gpuvision.profiling import harness
from gpuvision.profiling.run import Failure

REFERENCE = "float64"
"""Name of the reference in the place of a device."""
_SINGLE, _DOUBLE = (float(np.finfo(real).eps) for real in (np.float32, np.float64))


@dataclass(frozen=True)
class Limit:
    """Stated largest difference of outputs of an operation from float64.

    Attributes
    ----------
    outputs : tuple of str
        Names of the outputs.
    single, double : float
        Factor of the quantity for float32 and for float64 outputs; 0: equal.
    quantity : str
        Description of the quantity, with its unit; empty where the outputs are equal.
    reason : str
        Origin of the factor in the error model.
    when : str
        Settings of the operation that the limit is for; empty: all others.
    """

    outputs: tuple[str, ...]
    single: float
    double: float
    quantity: str
    reason: str
    when: str = ""

    def factor(self, dtype: npt.DTypeLike) -> float:
        """Return the factor for outputs of a type."""
        return self.double if np.dtype(dtype) == np.float64 else self.single


def roundings(count: float, *outputs: str, of: str, reason: str, when: str = "") -> Limit:
    """Return a limit of a number of epsilons: each rounding to nearest is half an epsilon of its value."""
    return Limit(outputs, count * _SINGLE, count * _DOUBLE, of, reason, when)


def equal(*outputs: str, reason: str, when: str = "") -> Limit:
    """Return the limit of outputs that are equal on all devices."""
    return Limit(outputs, 0.0, 0.0, "", reason, when)


@dataclass(frozen=True)
class Case:
    """Inputs of an operation with their float64 results.

    Attributes
    ----------
    operation : str
        Name of the public operation.
    name : str
        Description of the inputs.
    template : Operation
        Operation with its parameters.
    inputs : tuple of numpy.ndarray
        Arguments of the operation.
    exact : mapping
        float64 results by the name of the output; flags and indices as integers.
    quantities : mapping
        Quantity that multiplies the factor of a limit, by the name of the output: a number, or an array that has the
        shape of the output. Outputs that are equal need none.
    undecided : numpy.ndarray, optional
        Samples whose decision (a threshold, the choice among candidates) lies within the rounding of a device: their
        outputs may differ and are not compared. It has the leading axes of the outputs.
    when : str
        `Limit.when` of the limits that hold for the settings.
    """

    operation: str
    name: str
    template: Operation[Any]
    inputs: tuple[npt.NDArray[Any], ...]
    exact: Mapping[str, npt.NDArray[Any]]
    quantities: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    undecided: npt.NDArray[np.bool_] | None = None
    when: str = ""

    def runs_on(self, device: Device) -> bool:
        """Return whether the device has the precision of the case."""
        is_double = getattr(self.template, "precision", None) == "double"
        return device.has_double or not (is_double or any(each.dtype == np.float64 for each in self.inputs))

    def run(self, device: Device) -> dict[str, npt.NDArray[Any]]:
        """Return the compared outputs of a device."""
        result = self.template(*self.inputs, device=device)
        return {name: np.asarray(to_numpy(getattr(result, name))) for name in self.exact}

    def is_compared(self, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
        """Return which elements of an output are compared."""
        if self.undecided is None:
            return np.ones(shape, bool)
        trailing = (1,) * (len(shape) - self.undecided.ndim)
        return np.broadcast_to(~self.undecided.reshape(*self.undecided.shape, *trailing), shape)


@dataclass(frozen=True)
class Comparison:
    """Comparison of an output of two devices, or of a device and float64.

    Attributes
    ----------
    operation, case, output
        Names of the operation, of the case and of the output.
    first, second
        Labels of the devices; `second` may be `REFERENCE`.
    elements, undecided
        Numbers of compared elements, and of elements whose decision lies within rounding.
    largest
        Largest difference, in the unit of the output; infinite where only one result is NaN.
    fraction
        Largest ratio of a difference and its limit; infinite where equal outputs differ.
    broken
        Number of elements beyond the limit.
    """

    operation: str
    case: str
    output: str
    first: str
    second: str
    elements: int
    undecided: int
    largest: float
    fraction: float
    broken: int


@dataclass(frozen=True)
class Agreement:
    """Report of the check.

    Attributes
    ----------
    comparisons
        Comparisons of all cases.
    failures
        Operations that raised an exception on a device.
    without
        Public operations that were asked for and have no contract yet.
    """

    comparisons: Sequence[Comparison]
    failures: Sequence[Failure]
    without: Sequence[str]

    @property
    def broken(self) -> list[Comparison]:
        """Comparisons with a difference beyond its limit."""
        return [each for each in self.comparisons if each.broken]

    def to_dict(self) -> dict[str, Any]:
        """Return limits, comparisons and failures for JSON."""
        return {
            "limits": {name: [asdict(each) for each in stated] for name, stated in stated_limits().items()},
            "comparisons": [asdict(each) for each in self.comparisons],
            "failures": [asdict(each) for each in self.failures],
            "without": list(self.without),
        }


def module_of(operation: str) -> Any:
    """Return the module with the contract of a public operation; None if it has none yet."""
    name = f"gpuvision.profiling.contract.{harness.OPERATIONS[harness.MEASURED[operation]]}"
    if importlib.util.find_spec(name) is None:
        return None
    module = importlib.import_module(name)
    return module if operation in module.LIMITS else None


def stated_limits() -> dict[str, tuple[Limit, ...]]:
    """Return the stated limits of all public operations that have a contract."""
    modules = {operation: module_of(operation) for operation in harness.MEASURED}
    return {operation: module.LIMITS[operation] for operation, module in modules.items() if module is not None}


def check(
    operations: Sequence[str],
    devices: Sequence[Device],
    *,
    progress: Callable[[str], None] = lambda line: None,
) -> Agreement:
    """Run all cases of public operations on the devices and compare the results.

    Parameters
    ----------
    operations : sequence of str
        Names of public operations, as in `harness.MEASURED`.
    devices : sequence of Device
        Devices to compare. A device without doubles takes no part in cases of double precision.
    progress : callable
        Function that is called with lines of text about the progress.
    """
    modules = {operation: module_of(operation) for operation in operations}
    comparisons: list[Comparison] = []
    failures: list[Failure] = []
    for operation, module in modules.items():
        for case in () if module is None else cases_of(operation, module):
            progress(f"{operation}: {case.name}")
            comparisons += compare(case, module.LIMITS[operation], _run(case, devices, failures))
    without = [operation for operation, module in modules.items() if module is None]
    return Agreement(comparisons, failures, without)


def cases_of(operation: str, module: Any) -> Iterator[Case]:
    """Yield the cases of an operation; its module may have cases of others."""
    return (case for case in module.cases() if case.operation == operation)


def _run(case: Case, devices: Sequence[Device], failures: list[Failure]) -> dict[str, dict[str, npt.NDArray[Any]]]:
    """Return the outputs by device; a device that raises an exception is added to the failures."""
    results = {}
    for device in devices:
        if case.runs_on(device):
            try:
                results[device.label] = case.run(device)
            except Exception as error:
                failures.append(harness.failure_of(case.operation, device, error))
    return results


def compare(
    case: Case, limits: Sequence[Limit], results: Mapping[str, Mapping[str, npt.NDArray[Any]]]
) -> list[Comparison]:
    """Compare the outputs of devices with float64, and of each pair of devices."""
    comparisons = []
    for output, exact in case.exact.items():
        limit = limit_of(output, case.when, limits)
        for label, found in results.items():
            size = limit.factor(found[output].dtype) * np.asarray(case.quantities.get(output, 0.0), np.float64)
            comparisons.append(_comparison(case, output, (label, REFERENCE), (found[output], exact), size))
        for one, two in itertools.combinations(results, 2):
            pair = results[one][output], results[two][output]
            size = 2.0 * limit.factor(pair[0].dtype) * np.asarray(case.quantities.get(output, 0.0), np.float64)
            comparisons.append(_comparison(case, output, (one, two), pair, size))
    return comparisons


def limit_of(output: str, when: str, limits: Sequence[Limit]) -> Limit:
    """Return the limit of an output for the settings of a case; the general one if they have none."""
    found = [each for each in limits if output in each.outputs and each.when in (when, "")]
    return max(found, key=lambda each: bool(each.when))


def _comparison(
    case: Case,
    output: str,
    labels: tuple[str, str],
    pair: tuple[npt.NDArray[Any], npt.NDArray[Any]],
    size: npt.NDArray[np.float64],
) -> Comparison:
    away = deviation(*pair)
    chosen = case.is_compared(away.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        fractions = np.where(away == 0.0, 0.0, away / size)[chosen]
    return Comparison(
        case.operation, case.name, output, *labels,
        elements=int(chosen.sum()),
        undecided=int((~chosen).sum()),
        largest=float(away[chosen].max(initial=0.0)),
        fraction=float(np.where(np.isnan(fractions), math.inf, fractions).max(initial=0.0)),
        broken=int(np.sum(~(fractions <= 1.0))),
    )  # fmt: skip


def deviation(first: npt.ArrayLike, second: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return absolute differences; 0 where both are NaN or equal infinities, infinite where only one is finite."""
    a, b = (np.asarray(each, np.float64) for each in (first, second))
    if a.shape != b.shape:
        raise ValueError(f"outputs of shapes {a.shape} and {b.shape} cannot be compared")
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore"):
        away = np.abs(a - b)
    return np.where(same, 0.0, np.where(np.isfinite(away), away, math.inf))
