"""Advice after a scan: each sentence from a third of the samples on, by the kind of the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gpuvision.schema import Section
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import Status
from gpuvision.workflows.scan_result import scan_advice

CAMERA, TURNING, PSD = (Sensor.load(name) for name in ("camera_line", "corner_scene", "psd_line"))
FOCUS = Sensor.from_section(
    Section(
        {
            "kind": "focus",
            "focus": {"stage_step": 1e-4, "pixel_size": 2e-6},
            "frame": {"columns": 4, "rows": 3},
            "output": {"cell": 1e-4},
        },
        "sensor.toml",
    )
)
FLAGS = ("NO_DATA", "NOT_FINITE", "LOW_SIGNAL", "AMBIGUOUS", "HORIZON", "OUT_OF_RANGE")
WORDS = {
    "NO_DATA": "many frames are damaged",
    "NOT_FINITE": "many samples have light that is not finite (infinity or NaN)",
    "camera, LOW_SIGNAL": "many samples are dark at a threshold of",
    "focus, LOW_SIGNAL": "many pixels have no texture",
    "psd, LOW_SIGNAL": "try a lower [psd] minimum_total",
    "camera, AMBIGUOUS": "many samples have several candidates for the line",
    "focus, HORIZON": "many pixels are sharpest outside the stack",
    "focus, OUT_OF_RANGE": "many pixels are sharpest outside the stack",
    "HORIZON": "many samples miss the scene",
    "OUT_OF_RANGE": "many samples miss the scene",
    "psd, AMBIGUOUS": None,
    "focus, AMBIGUOUS": None,
}


def _status(flag: Status, part: int) -> np.ndarray:
    """Return flags of which a part of 12 samples has one, beside another flag without advice."""
    status = np.full(12, int(Status.SATURATED), np.uint8)
    status[:part] |= np.uint8(flag)
    return status.reshape(3, 4)


@pytest.mark.parametrize("sensor", [CAMERA, TURNING, PSD, FOCUS], ids=["camera", "turning", "psd", "focus"])
@pytest.mark.parametrize("flag", FLAGS)
def test_each_flag(sensor: Sensor, flag: str) -> None:
    words = WORDS.get(f"{sensor.kind}, {flag}", WORDS.get(flag))
    found = scan_advice(_status(Status[flag], 4), sensor)
    assert len(found) == (words is not None)
    assert words is None or words in found[0]
    assert scan_advice(_status(Status[flag], 3), sensor) == ()


def test_names_of_the_keys() -> None:
    for automatic, words in ((False, '[line] threshold = "auto"'), (True, "a lower [line] threshold,")):
        (found,) = scan_advice(_status(Status.LOW_SIGNAL, 12), replace(CAMERA, auto_threshold=automatic))
        assert words in found
        assert f"of {CAMERA.readout.threshold:g} grey levels" in found
    for sensor, words in ((CAMERA, "[axes] and baseline"), (TURNING, "[transport] angle_step and axis_direction")):
        (found,) = scan_advice(_status(Status.HORIZON, 12), sensor)
        assert words in found


def test_several_flags_in_their_order() -> None:
    status = np.full((2, 2), sum(Status[each] for each in FLAGS), np.uint8)
    for sensor, count in ((CAMERA, 5), (TURNING, 5), (PSD, 4), (FOCUS, 4)):
        found = scan_advice(status, sensor)
        assert len(found) == count
        assert "damaged" in found[0]
        assert "[output]" in found[-1]
    assert scan_advice(np.zeros((2, 2), np.uint8), CAMERA) == ()
