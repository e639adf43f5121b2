"""Settings of a thread with small and steady delays: they hold inside the body and return to those of before."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Iterator

import pytest

from gpuvision.servoing import low_latency as module
from gpuvision.servoing.low_latency import low_latency, real_time_is_allowed


@pytest.fixture
def without_frozen_objects() -> Iterator[None]:
    """Start without the objects that the test session froze (`conftest.py`); a collection then takes 0.4 s."""
    gc.unfreeze()
    yield
    gc.freeze()


@pytest.mark.usefixtures("without_frozen_objects")
def test_no_garbage_collection_inside() -> None:
    assert gc.isenabled()
    before = gc.get_freeze_count()
    with low_latency():
        assert not gc.isenabled()
        assert gc.get_freeze_count() > before
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_disabled_collection_stays_disabled() -> None:
    gc.disable()
    try:
        with low_latency():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


@pytest.mark.usefixtures("without_frozen_objects")
def test_objects_that_the_caller_froze_stay_frozen() -> None:
    gc.freeze()
    try:
        before = gc.get_freeze_count()
        assert before > 0
        with low_latency():
            assert not gc.isenabled()
        # Frozen objects whose last reference goes are freed, so that a few may be missing.
        assert 0.99 * before < gc.get_freeze_count() <= before
    finally:
        gc.unfreeze()


@pytest.mark.usefixtures("without_frozen_objects")
def test_collection_stays_off_until_the_last_thread_leaves() -> None:
    entered, left = threading.Event(), threading.Event()
    inside: list[bool] = []

    def first() -> None:
        with low_latency():
            entered.set()
            assert second_inside.wait(10)
        left.set()

    second_inside, thread = threading.Event(), threading.Thread(target=first)
    thread.start()
    assert entered.wait(10)
    with low_latency():
        second_inside.set()
        assert left.wait(10)
        inside += [gc.isenabled(), gc.get_freeze_count() > 0]
    thread.join()
    assert inside == [False, True]
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_the_thread_runs_on_its_core_and_others_do_not() -> None:
    before = os.sched_getaffinity(0)
    core = max(before)
    others: list[set[int]] = []
    inside, thread = threading.Event(), threading.Thread(target=lambda: (inside.wait(), others.append(_affinity())))
    thread.start()
    with low_latency(core=core):
        assert os.sched_getaffinity(0) == {core}
        inside.set()
        thread.join()
    assert os.sched_getaffinity(0) == before
    assert others == [before]


def test_settings_return_after_an_error() -> None:
    before = os.sched_getaffinity(0)
    with pytest.raises(KeyError), low_latency(core=max(before)):
        raise KeyError
    assert os.sched_getaffinity(0) == before
    assert gc.isenabled()


def _affinity() -> set[int]:
    return os.sched_getaffinity(threading.get_native_id())


def test_priority_holds_inside() -> None:
    if not real_time_is_allowed():
        with (
            pytest.raises(PermissionError, match="the priority 7 is not permitted: run as root"),
            low_latency(priority=7),
        ):
            pass
        return
    with low_latency(priority=7):
        assert os.sched_getscheduler(0) == os.SCHED_FIFO
        assert os.sched_getparam(0).sched_priority == 7
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"core": -1}, "core is -1"),
        ({"core": 100_000}, "core is 100000, expected one of"),
        ({"priority": 100}, "priority is 100"),
        ({"priority": -1}, "priority is -1"),
    ],
)
def test_wrong_arguments_change_nothing(given: dict[str, int], message: str) -> None:
    before = os.sched_getaffinity(0), os.sched_getscheduler(0)
    with pytest.raises(ValueError, match=message), low_latency(**given):
        pass
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == before
    assert gc.isenabled()


def test_other_operating_systems_say_that_they_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setaffinity")
    monkeypatch.delattr(os, "sched_setscheduler")
    assert not real_time_is_allowed()
    with pytest.raises(OSError, match="cannot set the core"), low_latency(core=0):
        pass
    with pytest.raises(OSError, match="no real-time priorities"), low_latency(priority=1):
        pass


def test_a_refused_priority_says_how_to_allow_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(module.os, "sched_setscheduler", refuse)
    assert not real_time_is_allowed()
    with pytest.raises(PermissionError, match="rtprio"), low_latency(priority=1):
        pass
    assert gc.isenabled()
