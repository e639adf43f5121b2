"""Tuned settings: only correct and faster ones win; damaged and stale files fall back to the defaults."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest

from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device, Launch, LaunchBuilder, Operation, Tunable, clear_cache, tuned_settings, tuning
from gpuvision.host.tuned_settings import (
    DEFAULTS,
    TunedEntry,
    TunedSettings,
    entry_of,
    keep_entries,
    settings_for,
    size_class,
    trial_of,
)
from gpuvision.host.tuning import TuningResult, _candidates, _Trial, tune
from gpuvision.profiling import tuning_inputs
from gpuvision.ranging.merge_heights import MergeHeights
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.triangulation import Triangulation

SINGLE = np.dtype(np.float32)
# `doubled` is right for every group. `wrong` depends on the group, is not written in groups of 32, and is not
# finite in groups of 16.
SOURCE = """
kernel void scale(global const float *in, global float *doubled, global float *wrong, const int count) {
    const int i = get_global_id(0), group = get_local_size(0);
    if (i >= count) return;
    doubled[i] = 2 * in[i];
    if (group != 32) wrong[i] = in[i] * (group == 128 ? 1.001f : group == 16 ? NAN : 1.0f);
}
"""


class Scaled(NamedTuple):
    """Result of `Scale`."""

    doubled: Any
    wrong: Any


@dataclass(frozen=True)
class Scale(Operation[Scaled]):
    """Operation whose field `wrong` depends on the work-group size."""

    Result = Scaled
    tunable: ClassVar[Tunable | None] = Tunable(groups=(16, 32, 64, 128))

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        build = LaunchBuilder(self, device, shape, dtype, variant="work_item")
        work = build.work(shape[0], each=1, group=8)
        return build.launch(
            "scale.cl",
            "scale",
            work=work,
            outputs=build.outputs({"doubled": shape, "wrong": shape}),
            arguments=[np.int32(shape[0])],
        )


class Tolerant(Scale):
    """The same with a tolerance for the wrong field."""

    tunable = Tunable(groups=(16, 32, 64, 128), tolerance={"wrong": 0.01})


@pytest.fixture
def scale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scale:
    (tmp_path / "scale.cl").write_text(SOURCE)
    monkeypatch.setattr(Scale, "kernel_folder", tmp_path)
    return Scale()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Use an empty cache folder, and tuned settings; return the path of their file."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(tuned_settings.VARIABLE)
    (tmp_path / "gpuvision").mkdir(mode=0o700)
    clear_cache()
    yield tmp_path / "gpuvision" / "tuned_settings.json"
    clear_cache()


def stopwatch(seconds: dict[TunedSettings, float]) -> Callable[[TunedSettings, Callable[[], object]], float]:
    """Return a clock that reads the given seconds for a call, 1 s for other settings."""

    def read(settings: TunedSettings, call: Callable[[], object]) -> float:
        call()
        return seconds.get(settings, 1.0)

    return read


def ramp(elements: int) -> list[Any]:
    return [np.linspace(1.0, 2.0, elements, dtype=np.float32)]


def groups(**seconds: float) -> dict[TunedSettings, float]:
    """Return seconds by settings: ``g64=0.5`` is a group of 64."""
    return {TunedSettings(group=int(name[1:])): each for name, each in seconds.items()}


def tune_devices(device: Device) -> Device:
    """Return the device for the group sizes of the work-item variant, as a GPU is tuned."""
    return device.without_vectors()


def test_a_wrong_result_never_wins(scale: Scale, device: Device) -> None:
    fast = groups(g16=0.01, g32=0.02, g128=0.03, g64=0.5)
    result = tune(scale, ramp, tune_devices(device), 3, stopwatch=stopwatch(fast))
    assert result.best == TunedSettings(group=64)
    assert result.gain == pytest.approx(2.0)
    assert {each.group for each in result.rejected} == {16, 32, 128}
    assert all("wrong" in reason for reason in result.rejected.values())


def test_a_tolerance_allows_small_differences_only(scale: Scale, device: Device) -> None:
    fast = groups(g16=0.01, g32=0.02, g128=0.03)
    result = tune(Tolerant(), ramp, tune_devices(device), 3, stopwatch=stopwatch(fast))
    assert result.best == TunedSettings(group=128)
    assert {each.group for each in result.rejected} == {16, 32}


def test_a_missing_write_shows_although_the_memory_holds_the_right_values(scale: Scale, device: Device) -> None:
    """The kernel does not write the field in groups of 32."""
    values = ramp(100)
    trial = _Trial(scale, tune_devices(device), values, TunedSettings(group=32))
    trial.bound.outputs.wrong.set(values[0])
    assert (
        trial.difference({"doubled": 2.0 * values[0], "wrong": values[0]}, Tunable()) == "another result: field wrong"
    )
    found = trial.result()
    np.testing.assert_array_equal(found["doubled"], 2.0 * values[0])
    assert not np.any(found["wrong"] == values[0])


class Short(Scale):
    """Scale that reads and writes its memory once: 12 bytes for each element."""

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        return replace(super().launch(device, shape, dtype), passes_once=True)


def test_inline_calls_are_offered_up_to_the_limit(
    scale: Scale, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not device.has_inline_queues:
        pytest.skip(f"{device.label} has no inline queues")
    trial = _Trial(Short(), tune_devices(device), ramp(100), DEFAULTS)
    for limit, choices in ((1200, {None, not trial.bound.inline}), (1199, {None})):
        monkeypatch.setattr(tuning, "MAX_INLINE_BYTES", limit)
        offered = [*_candidates(Tunable(groups=(16, 64)), trial)]
        assert {each.inline for each in offered} == choices
        assert {each.group for each in offered} == {None, 16, 64}
        assert len(offered) == 3 * len(choices)


class Refusing(Scale):
    """Scale that describes no launch with groups of 32."""

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        launch = super().launch(device, shape, dtype)
        if launch.local_size == (32,):
            raise ValueError("no groups of 32")
        return launch


def test_settings_that_the_operation_refuses_are_rejected(scale: Scale, device: Device) -> None:
    result = tune(Refusing(), ramp, tune_devices(device), 3, stopwatch=stopwatch(groups(g64=0.5)))
    assert result.best == TunedSettings(group=64)
    assert result.rejected[TunedSettings(group=32)] == "no groups of 32"


def test_a_result_that_changes_during_the_timed_calls_does_not_win(scale: Scale, device: Device) -> None:
    calls = 0

    def spoil(settings: TunedSettings, call: Callable[[], object]) -> float:
        nonlocal calls
        calls += 1
        call.__self__.inputs[0].fill(3.0)  # type: ignore[attr-defined]
        return 0.5 if settings.group == 64 else 1.0

    result = tune(scale, ramp, tune_devices(device), 3, stopwatch=spoil)
    assert calls
    assert result.best == DEFAULTS
    assert "after the timed calls" in result.rejected[TunedSettings(group=64)]


@pytest.mark.parametrize(("gain", "wins"), [(1.05, False), (1.3, True)])
def test_a_gain_within_the_spread_does_not_win(scale: Scale, device: Device, gain: float, wins: bool) -> None:
    """The defaults take 1 s and 1.1 s in turn: a spread of about 0.2."""
    turns = 0

    def read(settings: TunedSettings, call: Callable[[], object]) -> float:
        nonlocal turns
        if settings == DEFAULTS:
            turns += 1
            return (1.0, 1.1, 1.1, 1.0)[turns % 4]
        return 1.05 / gain if settings.group == 64 else 2.0

    result = tune(scale, ramp, tune_devices(device), 3, stopwatch=read)
    assert 0.15 < result.spread < 0.25
    assert (result.best.group == 64) is wins


def test_a_gain_in_most_rounds_does_not_hide_a_slower_median(scale: Scale, device: Device) -> None:
    """The machine is fast in a part of the rounds; the candidate gains much there, and its median time is longer."""
    calls = {DEFAULTS: 0, TunedSettings(group=64): 0}

    def read(settings: TunedSettings, call: Callable[[], object]) -> float:
        if settings not in calls:
            return 9.0
        calls[settings] += 1
        if calls[settings] <= 5:  # screening: the candidate is the favourite
            return 1.0 if settings == DEFAULTS else 0.5
        turn = (calls[settings] - 6) // (2 if settings == DEFAULTS else 1) % 9
        default, candidate = ((1.0, 0.6), (1.0, 0.6), (1.0, 0.6), (2.0, 1.2), (2.0, 1.2), *[(1.0, 1.3)] * 4)[turn]
        return default if settings == DEFAULTS else candidate

    result = tune(scale, ramp, tune_devices(device), 3, stopwatch=read)
    assert result.best == DEFAULTS


def test_equal_clocks_give_equal_results(scale: Scale, device: Device) -> None:
    results = [tune(scale, ramp, tune_devices(device), 3, stopwatch=stopwatch(groups(g64=0.7))) for _ in range(2)]
    assert results[0] == results[1]


def test_an_operation_without_settings_is_refused(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PsdReadout, "tunable", None)
    with pytest.raises(ValueError, match="PsdReadout has no settings to tune"):
        tune(PsdReadout(strip_length=6e-3), ramp, device, 3)


@pytest.mark.parametrize("name", tuning_inputs.NAMES)
def test_all_offered_settings_give_the_default_result(name: str, device: Device) -> None:
    for operation, make in tuning_inputs.cases(name):
        if make(2)[0].dtype == np.float64 and not device.has_double:
            continue
        result = tune(operation, make, device, 6, stopwatch=stopwatch({}))
        assert result.rejected == {}
        assert result.best == DEFAULTS


@pytest.mark.parametrize("operation", [PsdReadout, Triangulation, UndistortPoints])
def test_variants_that_round_differently_are_not_offered(operation: type[Operation[Any]]) -> None:
    assert operation.tunable is not None
    assert not operation.tunable.allows(TunedSettings(variant="work_item"))


def entry(device: Device, settings: TunedSettings, **changes: Any) -> TunedEntry:
    return replace(entry_of(PsdReadout(strip_length=6e-3), device, (1000, 2), SINGLE, settings, 1.5), **changes)


def warned(device: Device) -> list[str]:
    """Look the settings up twice, expect the defaults, and return the warnings."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        assert kept_for(device) == DEFAULTS
        assert kept_for(device) == DEFAULTS
    return [str(each.message) for each in seen]


def kept_for(device: Device, shape: tuple[int, ...] = (1000, 2), dtype: Any = SINGLE) -> TunedSettings:
    return settings_for(PsdReadout(strip_length=6e-3), device, shape, dtype)


GROUP, STRIP = TunedSettings(group=128), TunedSettings(strip=2048)


@pytest.mark.usefixtures("cache")
def test_kept_settings_are_found_by_operation_type_size_and_device(device: Device) -> None:
    chosen = entry(device, STRIP)
    keep_entries([chosen], [chosen.key])
    assert kept_for(device) == STRIP
    assert kept_for(device, (512, 2)) == STRIP  # the smallest size of the class
    assert kept_for(device, (511, 2)) == kept_for(device, (2048, 2)) == DEFAULTS
    assert kept_for(device, dtype=np.dtype(np.uint16)) == DEFAULTS
    other = device.without_vectors()
    other.label = "another"
    assert kept_for(other) == DEFAULTS


class OtherReadout(PsdReadout):
    """Another class with the program of `PsdReadout`."""


@pytest.mark.usefixtures("cache")
def test_kept_settings_hold_for_one_class_and_program(device: Device) -> None:
    """Numbers that are arguments of the kernel do not matter; outputs and build options do."""
    keep_entries([entry(device, STRIP)], [])

    def kept(operation: PsdReadout) -> TunedSettings:
        return settings_for(operation, device, (1000, 2), SINGLE)

    assert kept(PsdReadout(strip_length=9e-3, minimum_total=1e-9)) == STRIP
    for changes in ({"outputs": ("position",)}, {"right_gain": 1.1}, {"precision": "double"}):
        if changes.get("precision") is None or device.has_double:
            assert kept(PsdReadout(strip_length=6e-3, **changes)) == DEFAULTS  # type: ignore[arg-type]
    assert kept(OtherReadout(strip_length=6e-3)) == DEFAULTS


@pytest.mark.usefixtures("cache")
def test_a_bound_instance_takes_kept_settings(device: Device) -> None:
    readout = PsdReadout(strip_length=6e-3, variant="work_item")
    keep_entries([entry_of(readout, device, (1000, 2), SINGLE, GROUP, 1.5)], [])
    assert readout.bind(device, (1000, 2), SINGLE).enqueue_arguments[3] == (128,)
    with trial_of(TunedSettings(group=32)):
        assert readout.bind(device, (1000, 2), SINGLE).enqueue_arguments[3] == (32,)


@pytest.mark.parametrize("inline", [True, False])
@pytest.mark.parametrize(("megabytes", "may_run_inline"), [(0.5, True), (1.9, True), (2.1, False)])
def test_launches_up_to_2_mib_run_inline_as_tuned(
    device: Device, megabytes: float, may_run_inline: bool, inline: bool
) -> None:
    readout = PsdReadout(strip_length=6e-3, variant="vector" if device.takes_vectors else "work_item")
    samples = int(megabytes * 2**20 / 17)  # 8 bytes of currents, 9 of position, total and status
    pairs = np.tile(np.float32([1.0, 3.0]), (samples, 1))
    with trial_of(TunedSettings(inline=inline)):
        bound = readout.bind(device, pairs.shape, pairs.dtype)
    assert bound.inline is (inline and may_run_inline and device.has_inline_queues)
    bound.inputs[0].set(pairs)
    np.testing.assert_allclose(bound.run().position.get(), 1.5e-3, rtol=1e-6)


@pytest.mark.usefixtures("cache")
def test_an_explicit_variant_stays(device: Device) -> None:
    merge = MergeHeights(tolerance=1e-5)
    keep_entries([entry_of(merge, device, (1000,), SINGLE, TunedSettings(variant="work_item"), 1.5)], [])
    auto, explicit = (
        LaunchBuilder(merge, device, (1000,), SINGLE, variant=variant)
        for variant in ("auto", "vector" if device.takes_vectors else "work_item")
    )
    assert not auto.uses_vectors
    assert explicit.uses_vectors is device.takes_vectors


@pytest.mark.usefixtures("cache")
def test_the_variable_ignores_kept_settings(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    keep_entries([entry(device, STRIP)], [])
    monkeypatch.setenv(tuned_settings.VARIABLE, "off")
    assert kept_for(device) == DEFAULTS


@pytest.mark.usefixtures("cache")
def test_tuning_again_replaces_only_what_was_tuned(device: Device) -> None:
    codes = entry_of(PsdReadout(strip_length=6e-3), device, (1000, 2), np.uint16, STRIP, 1.5)
    first, second = entry(device, STRIP), codes
    keep_entries([first, second], [])
    keep_entries([], [first.key])
    assert kept_for(device) == DEFAULTS
    assert kept_for(device, dtype=np.dtype(np.uint16)) == STRIP


@pytest.mark.usefixtures("cache")
@pytest.mark.parametrize("changes", [{"driver": ("other",)}, {"version": "0.0"}], ids=["driver", "version"])
def test_stale_settings_are_named_once_and_not_used(device: Device, changes: dict[str, Any]) -> None:
    keep_entries([entry(device, STRIP, **changes)], [])
    (message,) = warned(device)
    assert message == (
        f"tuned settings of device {device.label} are of another driver or version of gpuvision: defaults apply; run "
        "`gpuvision tune` again"
    )


@pytest.mark.usefixtures("cache")
def test_settings_that_the_operation_does_not_offer_are_named_once_and_not_used(device: Device) -> None:
    keep_entries([entry(device, TunedSettings(strip=1000))], [])
    (message,) = warned(device)
    assert message == (
        f"PsdReadout does not offer the tuned settings of device {device.label} (strip 1000): defaults apply; run "
        "`gpuvision tune` again"
    )


def damaged(text: str, **changes: Any) -> str:
    """Return the file with changes in its first entry."""
    read = json.loads(text)
    read["entries"][0] |= changes
    return json.dumps(read)


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: "",
        lambda text: text[:-20],
        lambda _: "[]",
        lambda _: '{"format": 2}',
        lambda text: text.replace('"format": 2', '"format": 99'),
        lambda text: damaged(text, program=5),
        lambda text: damaged(text, size_class="5"),
        lambda text: damaged(text, driver=[1]),
        lambda text: damaged(text, settings={"strip": -1}),
        lambda text: damaged(text, settings={"strip": 2048.0}),
        lambda text: damaged(text, settings={"variant": "vector"}),
        lambda text: damaged(text, settings={"colour": 1}),
        lambda text: damaged(text, settings=None),
    ],
)
def test_a_damaged_file_is_named_once_and_not_used(device: Device, cache: Path, damage: Callable[[str], str]) -> None:
    keep_entries([entry(device, STRIP)], [])
    cache.write_text(damage(cache.read_text()))
    clear_cache()
    (message,) = warned(device)
    assert message.startswith(f"{cache} is damaged or not private: defaults apply")
    assert "\n" not in message


def test_a_file_that_others_may_write_is_not_used(device: Device, cache: Path) -> None:
    keep_entries([entry(device, STRIP)], [])
    cache.chmod(0o666)
    clear_cache()
    with pytest.warns(RuntimeWarning, match="damaged or not private"):
        assert kept_for(device) == DEFAULTS


def test_no_file_is_no_damage(device: Device, cache: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kept_for(device) == DEFAULTS
    assert not cache.exists()


def test_a_cache_that_cannot_be_written_raises(device: Device, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied", str(cache))

    monkeypatch.setattr(tuned_settings, "write_private", refuse)
    with pytest.raises(PermissionError):
        keep_entries([entry(device, STRIP)], [])
    assert kept_for(device) == DEFAULTS


@pytest.mark.parametrize(
    ("shape", "expected"), [((0,), 0), ((1,), 0), ((3,), 0), ((4,), 1), ((15,), 1), ((4, 4), 2), ((1000, 2), 5)]
)
def test_size_classes(shape: tuple[int, ...], expected: int) -> None:
    assert size_class(shape) == expected


def test_settings_in_words() -> None:
    assert str(DEFAULTS) == "default"
    chosen = TunedSettings(variant="work_item", group=64, inline=True)
    assert str(chosen) == "variant work_item, group 64, inline"
    assert str(TunedSettings(strip=512, inline=False)) == "strip 512, worker threads"


def test_the_result_states_what_was_tuned(scale: Scale, device: Device) -> None:
    result: TuningResult = tune(scale, ramp, tune_devices(device), 3, stopwatch=stopwatch(groups(g64=0.5)))
    assert (result.operation, result.dtype, result.device, result.elements) == ("Scale", "float32", device.label, 149)
    assert (result.default_seconds, result.best_seconds) == (1.0, 0.5)
    assert result.entry.settings == result.best
    assert result.entry.size_class == 3
