"""Faults of drivers mark the affected tests of that driver, and no others."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from driver_faults import FAULTS, DriverFault, mark_faults
from tiers import collected_items

ROOT = Path(__file__).resolve().parents[1]
AFFECTED = {
    "long searches": ("tests/a/test_field_pose.py::test_clutter_of_70_percent[rusticl]", False),
    "times of events": ("tests/host/test_double_rate.py::test_the_kernel_of_the_measurement_runs[rusticl]", True),
    "accuracy of blobs": ("tests/matching/features/test_blob_accuracy.py::test_any[rusticl]", False),
    "pose of features": ("tests/a/test_feature_pose.py::test_one_kind_of_features_is_enough[rusticl-rulers]", True),
    "features behind a lens": ("tests/a/test_feature_lens.py::test_every_feature_is_measured[rusticl-lens]", True),
    "poses of a stream": ("tests/a/test_streamed_pose.py::test_poses_of_a_stream_are_those_of[rusticl-True]", True),
    "form factors": ("tests/a/test_radiosity.py::test_what_a_body_stands_on_is_not_lit[rusticl]", True),
    "affine pose": ("tests/a/test_registration_pairs.py::test_a_scale_is_not_hidden_in_a_rigid_pose[rusticl]", True),
    "board in an image": ("tests/a/test_registration.py::test_real_boards_are_found[rusticl-upverter]", True),
}
UNAFFECTED = (
    "tests/a/test_extremes.py::test_glare[rusticl]",
    "tests/a/test_predicted_errors.py::test_no_wrong_pose_of_a_disturbed_board[rusticl-x]",
    "tests/a/test_registration_pairs.py::test_copper_of_another_width_does_not_move[rusticl-2]",
    "tests/a/test_field_pose.py::test_poses_are_of_least_cost[rusticl]",
    "tests/a/test_field_pose.py::test_scores_are_sums_over_the_map[rusticl-1-work_item]",
    "tests/matching/features/test_ruler.py::test_any[rusticl]",
    "tests/ranging/test_line.py::test_not_finite[rusticl-centroid]",
    "tests/a/test_line_irradiance.py::test_sizes_and_canaries[rusticl-work_item-20011]",
    "tests/a/test_mirrors.py::test_an_image_on_an_edge_counts_once[rusticl]",
    "tests/a/test_feature_pose.py::test_wrong_frames_and_options_are_refused[rusticl]",
    "tests/a/test_feature_pose.py::test_results_must_lie_apart[rusticl]",
    "tests/a/test_registration_pairs.py::test_an_unknown_etch_bias_is_in_the_covariance",
    "tests/a/test_extremes.py::test_no_contrast_no_pose[rusticl]",
    "tests/a/test_registration.py::test_an_image_of_nothing_is_refused[rusticl]",
)


def marks_of(name: str, kind: str | None = "rusticl", driver: str = "22.3.6", *, run: bool = True) -> list[pytest.Mark]:
    """Return the marks of a test of a device."""
    marks: list[Any] = []
    device = None if kind is None else SimpleNamespace(kind=kind, driver=driver)
    item: Any = SimpleNamespace(
        nodeid=name, add_marker=marks.append, callspec=SimpleNamespace(params={"device": device} if device else {})
    )
    mark_faults([item], run=run)
    return [each.mark for each in marks]


@pytest.mark.parametrize(("name", "runs"), AFFECTED.values(), ids=AFFECTED)
def test_affected_test_is_an_expected_failure(name: str, runs: bool) -> None:
    (mark,) = marks_of(name)
    assert mark.name == "xfail"
    assert mark.kwargs["reason"].startswith("Mesa 22.3 ")
    assert (mark.kwargs["run"], mark.kwargs["strict"]) == (runs, False)
    assert [each.kwargs["run"] for each in marks_of(name, run=False)] == [False]
    for kind, driver in (("pocl", "22.3.6"), ("rusticl", "25.0.1"), (None, "")):
        assert marks_of(name, kind, driver) == []


@pytest.mark.parametrize("name", UNAFFECTED)
def test_other_tests_of_the_driver_are_not_marked(name: str) -> None:
    assert marks_of(name) == []


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.reason[:40])
def test_names_of_a_fault_are_names_of_tests(request: pytest.FixtureRequest, fault: DriverFault) -> None:
    """A renamed test would not be expected to fail; a run of other files collects none of them."""
    found = [item for item in collected_items(request.session) if f"{item.path.stem}\\.py" in fault.tests]
    assert not found or any(re.search(fault.tests, item.nodeid) for item in found)


MARKED_CASES = """
import pytest

@pytest.mark.xfail(reason="Mesa 22.3 is wrong", strict=False)
@pytest.mark.parametrize("is_wrong", [True, False])
def test_case(is_wrong):
    assert not is_wrong
"""


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_the_summary_lists_expected_failures_that_pass(tmp_path: Path, workers: int) -> None:
    (tmp_path / "conftest.py").write_text((ROOT / "tests" / "conftest.py").read_text())
    (tmp_path / "test_cases.py").write_text(MARKED_CASES)
    options = ["-p", "no:cacheprovider", "-o", f"pythonpath={ROOT / 'tests'}", "-n", str(workers)]
    command = [sys.executable, "-m", "pytest", "-q", "--tier", "fast", *options, str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert run.returncode == pytest.ExitCode.OK, run.stdout + run.stderr
    listed = [line for line in run.stdout.splitlines() if line.startswith("expected to fail, passed: ")]
    assert listed == ["expected to fail, passed: test_cases.py::test_case[False] (Mesa 22.3 is wrong)"], run.stdout
