"""Steps of opened and of simulated recordings: backgrounds, groups of frames, and the transport of even profiles."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host.sources import ArraySource
from gpuvision.ranging.background import ImageSubtracted, PairsSubtracted, PreviousSubtracted
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows import opened_recording, simulated_recording

CAMERA = Sensor.load("camera_line")


def sensor(background: Any) -> Any:
    recording = dataclasses.replace(CAMERA.recording, background=background)
    return dataclasses.replace(CAMERA, recording=recording)


# ---- transport of simulated profiles ---------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [2e-3, -2e-3])
def test_even_profiles_have_a_start_and_a_step(step: float) -> None:
    """Deviations of a thousandth of a step, or what the limit allows, are none."""
    places = 0.05 + step * np.arange(6)
    limit = simulated_recording._EVEN * 2e-3
    for shift, is_even in ((0.0, True), (0.99 * limit, True), (-0.99 * limit, True), (1.01 * limit, False)):
        moved = places.copy()
        moved[3] += shift
        task: Any = SimpleNamespace(transports=moved)
        if is_even:
            found = simulated_recording._start_and_step(task, 9.0)
            assert found == {"start": 0.05, "step": pytest.approx(step, rel=1e-12)}
        else:
            with pytest.raises(
                ValueError, match="the transports of the profiles are not evenly spaced; no sensor file"
            ):
                simulated_recording._start_and_step(task, 9.0)
    one: Any = SimpleNamespace(transports=np.array([0.03]))
    assert simulated_recording._start_and_step(one, 9.0) == {"start": 0.03, "step": 9.0}
    two: Any = SimpleNamespace(transports=np.array([0.03, 0.07]))
    assert simulated_recording._start_and_step(two, 9.0) == {"start": 0.03, "step": pytest.approx(0.04)}


def test_the_transport_of_a_recording_has_no_encoder_file() -> None:
    """A single profile has the step of the table, or the size of a count of its encoder."""
    one: Any = SimpleNamespace(transports=np.array([0.25]))
    found = simulated_recording._even_transport(one, {"kind": "straight", "step": 2e-3, "start": 7.0, "jitter": 1e-6})
    assert found == {"kind": "straight", "step": 2e-3, "start": 0.25, "jitter": 1e-6}
    table = dict.fromkeys(simulated_recording._ENCODER_KEYS, "x") | {"kind": "straight", "metres_per_count": 5e-6}
    found = simulated_recording._even_transport(one, table)
    assert found == {"kind": "straight", "metres_per_count": 5e-6, "step": 5e-6, "start": 0.25}


@pytest.mark.parametrize("kind", ["frames", "currents"])
def test_blocks_are_recorded_with_the_numbers_of_their_profiles(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def record(exposures: Any, *, seed: Any, first_profile: int) -> Any:
        asked.append((exposures, seed, first_profile))
        return np.full((exposures, 2), first_profile)

    class Psd:
        currents = staticmethod(record)

    made = Psd() if kind == "currents" else SimpleNamespace(frames=record)
    monkeypatch.setattr(simulated_recording, "PsdSimulator", Psd)
    monkeypatch.setattr(simulated_recording, "make_sensor_view", lambda given: ("view", given))
    monkeypatch.setattr(simulated_recording, "make_simulator", lambda *given: asked.append(given) or made)

    class Store(list[Any]):
        task = SimpleNamespace(sensor="a sensor")

    store: Any = Store([SimpleNamespace(exposures=count) for count in (4, 3, 2)])
    mask: Any = "a mask"
    blocks = list(simulated_recording._stored_blocks(store, mask, 5))
    assert asked == [("a sensor", ("view", "a sensor"), "a mask"), (4, 5, 0), (3, 5, 4), (2, 5, 7)]
    np.testing.assert_array_equal(np.concatenate(blocks)[:, 0], [0] * 4 + [4] * 3 + [7] * 2)


# ---- opened recordings -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("background", "kind"),
    [
        ("none", ArraySource),
        ("previous", PreviousSubtracted),
        ("dark_after", PairsSubtracted),
        ("dark_before", PairsSubtracted),
        ("median", ImageSubtracted),
    ],
)
def test_source_less_its_background(background: Any, kind: type) -> None:
    frames = np.arange(4 * 2 * 3, dtype=np.uint8).reshape(4, 2, 3)
    image = np.full((2, 3), 4, np.uint8) if background == "median" else None
    source = opened_recording._subtracted(ArraySource(frames), sensor(background), image)
    assert type(source) is kind
    out, arrived = np.zeros((1, 2, 3), source.dtype), np.zeros(1, np.int64)
    assert source.read_into(out, arrived) == 1
    light = {"dark_after": frames[0].astype(int) - frames[1], "dark_before": frames[1].astype(int) - frames[0]}
    if background in light:
        assert np.all(out[0] == np.maximum(light[background], 0)) or np.all(out[0] == light[background])


@pytest.mark.parametrize(
    ("background", "group"), [("dark_after", 2), ("dark_before", 2), ("previous", 1), ("median", 1)]
)
def test_frames_are_sampled_in_pairs_where_the_light_alternates(
    background: Any, group: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    closed: list[Any] = []
    source = SimpleNamespace(close=lambda: closed.append(1))
    monkeypatch.setattr(opened_recording, "_open", lambda *given: (source, "name"))
    monkeypatch.setattr(
        opened_recording,
        "sample_frames",
        lambda given, *, group: asked.append((given, group)) or SimpleNamespace(frames=7),
    )
    found: Any = opened_recording._sampled("r.npy", sensor(background))
    assert (found, asked, closed) == (7, [(source, group)], [1])


def test_recordings_are_opened_by_channel_and_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opened_recording, "open_recording", lambda path, **how: (path, how))
    frames = np.zeros((2, 3, 4), np.uint8)
    source = ArraySource(frames)
    assert opened_recording._open(source, CAMERA) == (source, "ArraySource")
    made, name = opened_recording._open(frames, CAMERA)
    assert (type(made), name) == (ArraySource, "array")
    recording = dataclasses.replace(CAMERA.recording, channel="red", key="frames")
    opened: Any = opened_recording._open(Path("r.npz"), dataclasses.replace(CAMERA, recording=recording))
    assert opened == ((Path("r.npz"), {"channel": "red", "key": "frames"}), "r.npz")


def test_profiles_lie_across_the_line() -> None:
    images = np.zeros((5, 2, 3))
    assert opened_recording._profiles(images, "columns").shape == (5, 3, 2)
    assert opened_recording._profiles(images, "rows") is images
