"""Contract between devices: every device within the stated limits of float64 and of the other devices."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host import Device, Operation
from gpuvision.profiling import contract, harness
from gpuvision.profiling.contract import agreement
from gpuvision.profiling.contract.agreement import Case, Limit, equal, roundings

DOCUMENTED = Path(__file__).parents[2] / "docs" / "concepts" / "device_agreement.md"
EPS = float(np.finfo(np.float32).eps)
LIMITS = (equal("status", reason="compared"), roundings(2, "value", of="value", reason="sum and product"))
# Cheap operations, for the fast tier.
CHEAP = ("MergeHeights", "PsdReadout", "Triangulation")
# Operations and drivers that broke their limits: kind of the device, and start of the version. Centres of blobs were
# off by up to 0.03 px on Mesa 22.3, with an earlier kernel; PoCL and Intel kept the limits with its work-items.
FAULTY = {"FindBlobs": ("rusticl", "22.3")}
COSTLY = sorted(set(agreement.stated_limits()) - set(CHEAP))


def one_case(**changed: object) -> Case:
    exact = {"value": np.array([1.0, 2.0, np.nan, 4.0]), "status": np.array([0, 0, 1, 0])}
    case = Case("Sum", "numbers", Operation.__new__(Operation), (), exact, {"value": np.abs(exact["value"])})
    return replace(case, **changed)


def outputs(value: object, status: object = (0, 0, 1, 0)) -> dict[str, np.ndarray]:
    return {"value": np.array(value, np.float32), "status": np.array(status, np.uint8)}


def compared(case: Case, **results: dict[str, np.ndarray]) -> dict[tuple[str, ...], agreement.Comparison]:
    return {(each.output, each.first, each.second): each for each in agreement.compare(case, LIMITS, results)}


def test_a_rounding_is_within_the_limit_and_three_are_not():
    found = compared(one_case(), one=outputs([1.0, 2.0 + 2.0 * EPS, np.nan, 4.0]))
    value = found["value", "one", "float64"]
    assert (value.elements, value.undecided, value.broken) == (4, 0, 0)
    assert value.largest == pytest.approx(2.0 * EPS)
    assert value.fraction == pytest.approx(0.5)
    assert found["status", "one", "float64"].broken == 0
    far = compared(one_case(), one=outputs([1.0 + 3.0 * EPS, 2.0, np.nan, 4.0]))["value", "one", "float64"]
    assert far.broken == 1
    assert far.fraction == pytest.approx(1.5)


def test_devices_differ_by_twice_the_limit_at_most():
    """One device above float64 and one below, each within its limit, or one of them beyond it."""
    above, below = outputs([1.0 + 2.0 * EPS, 2.0, np.nan, 4.0]), outputs([1.0 - 2.0 * EPS, 2.0, np.nan, 4.0])
    pair = compared(one_case(), one=above, two=below)["value", "one", "two"]
    assert pair.fraction == pytest.approx(1.0)
    assert pair.broken == 0
    far = outputs([1.0 - 3.0 * EPS, 2.0, np.nan, 4.0])
    assert compared(one_case(), one=above, two=far)["value", "one", "two"].broken == 1


def test_a_value_that_only_one_result_has_breaks_the_limit():
    for value in ([1.0, 2.0, 3.0, 4.0], [1.0, np.nan, np.nan, 4.0], [1.0, np.inf, np.nan, 4.0]):
        found = compared(one_case(), one=outputs(value))["value", "one", "float64"]
        assert found.broken == 1
        assert found.largest == found.fraction == np.inf


def test_equal_outputs_have_no_limit():
    found = compared(one_case(), one=outputs([1.0, 2.0, np.nan, 4.0], (0, 0, 1, 2)))["status", "one", "float64"]
    assert (found.broken, found.fraction, found.largest) == (1, np.inf, 2.0)


def test_undecided_samples_are_counted_and_not_compared():
    case = one_case(undecided=np.array([False, True, False, False]))
    found = compared(case, one=outputs([1.0, 9.0, np.nan, 4.0], (0, 1, 1, 0)))
    assert {(each.elements, each.undecided, each.broken) for each in found.values()} == {(3, 1, 0)}


def test_a_sample_is_undecided_in_all_elements_of_an_output():
    case = one_case(undecided=np.array([False, True]))
    np.testing.assert_array_equal(case.is_compared((2, 3)), [[True] * 3, [False] * 3])


def test_outputs_of_different_shapes_cannot_be_compared():
    with pytest.raises(ValueError, match=r"outputs of shapes \(2,\) and \(1,\)"):
        agreement.deviation([1.0, 2.0], [1.0])


def test_a_limit_for_the_settings_goes_before_the_general_one():
    special = Limit(("value",), 1.0, 0.5, "value", "one", when="method b")
    limits = (roundings(2, "value", of="value", reason="two"), special)
    assert agreement.limit_of("value", "method b", limits) is special
    assert agreement.limit_of("value", "method a", limits) is limits[0]
    assert special.factor(np.float32) == special.factor(np.uint8) == 1.0
    assert special.factor(np.float64) == 0.5


def test_every_module_belongs_to_a_benchmark_and_states_limits_of_its_operations():
    files = {path.stem for path in Path(contract.__file__).parent.glob("*.py")} - {"__init__", "agreement"}
    assert files <= set(harness.OPERATIONS.values())
    stated = set()
    for operation in harness.MEASURED:
        module = agreement.module_of(operation)
        if module is not None:
            stated |= {(module.__name__.rpartition(".")[2], operation)}
            assert set(module.LIMITS) <= set(harness.MEASURED)
    assert {file for file, _ in stated} == files


def rows_of_limits() -> list[str]:
    """Return the stated limits as rows of a Markdown table: operation, outputs, limits, quantity, reason."""
    rows = []
    for operation, stated in agreement.stated_limits().items():
        for each in stated:
            outputs = ", ".join(f"`{output}`" for output in each.outputs) + (f" ({each.when})" if each.when else "")
            limits = f"{each.single:.2g}, {each.double:.2g} x {each.quantity}" if each.single else "equal"
            between = f"{2.0 * each.single:.2g}, {2.0 * each.double:.2g} x the same" if each.single else "equal"
            rows.append(f"| {operation} | {outputs} | {limits} | {between} | {each.reason} |")
    return rows


def test_the_documentation_has_the_stated_limits():
    lines = DOCUMENTED.read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("| operation | outputs |"))
    rows = [line for line in lines[first + 2 :] if line.startswith("| ")]
    assert rows == rows_of_limits()


def assert_kept(operations: tuple[str, ...]) -> None:
    faulty = {FAULTY[each] for each in operations if each in FAULTY}
    devices = [
        each for each in Device.all() if not any(each.kind == kind and each.driver.startswith(v) for kind, v in faulty)
    ]
    found = agreement.check(operations, devices)
    assert not found.failures
    assert not found.without
    assert [each for each in found.comparisons if each.broken] == []
    assert {each.operation for each in found.comparisons} == set(operations)
    labels = {each.first for each in found.comparisons} | {each.second for each in found.comparisons}
    assert labels == {device.label for device in devices} | {agreement.REFERENCE}
    for each in found.comparisons:
        # Samples whose decision rounding changes are few; a case compares many others.
        assert each.elements > 4 * each.undecided, each


def test_cheap_operations_keep_their_limits_on_all_devices():
    assert_kept(CHEAP)


@pytest.mark.slow
@pytest.mark.parametrize("operation", COSTLY)
def test_operations_keep_their_limits_on_all_devices(operation):
    assert_kept((operation,))


def test_cases_are_the_same_in_every_run():
    module = agreement.module_of("PsdReadout")
    for one, other in zip(module.cases(), module.cases(), strict=True):
        for first, second in zip(one.inputs, other.inputs, strict=True):
            np.testing.assert_array_equal(first, second)


def test_the_command_writes_the_report(tmp_path):
    device = Device.best()
    words = ["profile", "merge_heights", "--contract", "--device", device.label, "--json", str(tmp_path / "c.json")]
    result = CliRunner().invoke(application(), words)
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "c.json").read_text())
    assert list(report["machine"]["devices"]) == [device.label]
    assert {each["operation"] for each in report["comparisons"]} == {"MergeHeights"}
    assert {each["second"] for each in report["comparisons"]} == {"float64"}
    assert report["failures"] == report["without"] == []
    assert set(report["limits"]) == set(agreement.stated_limits())


def test_a_broken_limit_is_named_and_the_exit_code_is_1(monkeypatch):
    module = agreement.module_of("MergeHeights")
    tight = tuple(
        replace(each, single=each.single * 1e-3, double=each.double * 1e-3) for each in module.LIMITS["MergeHeights"]
    )
    monkeypatch.setitem(module.LIMITS, "MergeHeights", tight)
    words = ["profile", "merge_heights", "--contract", "--device", Device.best().label]
    result = CliRunner().invoke(application(), words)
    assert result.exit_code == 1
    assert "broken: MergeHeights.z on " in result.output


def test_an_operation_without_a_contract_is_refused():
    result = CliRunner().invoke(application(), ["profile", "launch", "--contract"])
    assert isinstance(result.exception, ValueError)
    assert str(result.exception).startswith("no operation 'launch' with a contract; expected some of blob, board_image")
