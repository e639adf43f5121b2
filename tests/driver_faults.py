"""Faults of drivers that tests have found: each is an expected failure on that driver, with version and reason."""

from __future__ import annotations

import re
from typing import NamedTuple

import pytest

from gpuvision.host import Device
from tiers import device_of


class DriverFault(NamedTuple):
    """Fault of a driver.

    Attributes
    ----------
    kind, driver : str
        Kind of the device, and the start of the driver's version.
    tests : str
        Regular expression that is found in the names of the affected tests (``path::function[case]``).
    reason : str
        Fault and its effect.
    ends_process : bool
        Whether the test must not run: the driver ends the process, or does not finish within a minute.
    """

    kind: str
    driver: str
    tests: str
    reason: str
    ends_process: bool = False


FAULTS = (
    DriverFault(
        "rusticl",
        "22.3",
        r"test_probe\.py::test_long_loops_run_to_their_end\[",
        "Mesa 22.3 on llvmpipe ends the loops of a work-item after 65535 iterations together, without an error; passes "
        "with Mesa 25.0.7",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_double_rate\.py::test_the_kernel_of_the_measurement_runs\["
        r"|test_ring\.py::test_steps_of_a_slot_follow_one_another\[",
        "Mesa 22.3 does not measure the times of events: each command starts at 2 ns and ends at 3 ns",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_blob_accuracy\.py::|test_maps\.py::test_\w+\[\w+-blob",
        "Mesa 22.3 did not compile the blob kernel within a minute; not repeated since work-groups find blobs, "
        "which it compiles in 20 s of processor time",
        ends_process=True,
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_field_pose\.py::test_clutter_of_70_percent\[",
        "Mesa 22.3 on llvmpipe takes more than 100 s for the searches of this test, and 25.0.7 as well",
        ends_process=True,
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_feature_pose\.py::test_(pose_is|errors_are_as|a_region_of|a_mirrored_side|search_distance|a_blob_of|"
        r"one_kind_of|residuals_beyond|large_predicted|other_boards)_|"
        r"test_feature_lens\.py::test_(every_feature|errors_are_as|covariance_refers|a_region_of)_",
        "Mesa 22.3 finds no pose from rulers and blobs in an image: NaN, AMBIGUOUS or NO_DATA; passes with Mesa 25.0.7",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_streamed_pose\.py::test_(poses_of_a_stream|loop_with_a_wall_clock)_",
        "Mesa 22.3 finds no pose from rulers and blobs in an image: AMBIGUOUS; PoCL finds it with the same kernels, in "
        "work-items and without doubles",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_radiosity\.py::test_what_a_body_stands_on_|test_closed_forms\.py::test_integrating_sphere\[|"
        r"test_light_paths\.py::test_(further_bounces_|a_tolerance_is_kept\[|the_error_of_the_patches_)",
        "Mesa 22.3 computes NaN form factors; PoCL computes them right with the same kernels, in work-items without "
        "doubles; not run with Mesa 25",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_registration_pairs\.py::test_a_scale_is_not_hidden_",
        "Mesa 22.3 computed wrong pose steps with five or more unknowns (affine): AMBIGUOUS, where PoCL finds the "
        "pose; passes with Mesa 25.0.7. Not repeated since poses are solved by work-groups",
    ),
    DriverFault(
        "rusticl",
        "22.3",
        r"test_registration\.py::test_(a_board_is_found|images_of_any|another_camera|a_repeated_pitch|real_boards|"
        r"a_real_board|what_was_applied|what_leaves)_",
        "Mesa 22.3 finds no pose of a board in an image: LOW_SIGNAL; passes with Mesa 25.0.7",
    ),
)


def mark_faults(items: list[pytest.Item], *, run: bool = True) -> None:
    """Mark the tests that faults of drivers affect as expected failures.

    With `run` the marked tests run, except tests that end the process or do not end.
    """
    for item in items:
        device = device_of(item)
        for fault in FAULTS:
            if device is not None and _affects(fault, device, item.nodeid):
                item.add_marker(
                    pytest.mark.xfail(reason=fault.reason, run=run and not fault.ends_process, strict=False)
                )


def _affects(fault: DriverFault, device: Device, name: str) -> bool:
    is_driver = device.kind == fault.kind and device.driver.startswith(fault.driver)
    return is_driver and re.search(fault.tests, name) is not None
