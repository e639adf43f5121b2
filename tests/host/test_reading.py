"""Errors of readers: one line with the file, the expected content, the reason and the advice."""

from __future__ import annotations

import pytest

from gpuvision.host.errors import ReadError, RecordingError
from gpuvision.host.reading import FileLimit, check_pixels, reading, reason_of


@pytest.mark.parametrize(
    ("hint", "message"),
    [
        ("", "a.stl: not a readable mesh: no header"),
        ("is it damaged?", "a.stl: not a readable mesh: no header; is it damaged?"),
    ],
)
def test_a_foreign_exception_becomes_one_line(hint: str, message: str) -> None:
    with pytest.raises(ReadError) as caught, reading("a.stl", "mesh", hint=hint):
        raise ValueError("no header\nsecond line")
    assert str(caught.value) == message


def test_the_class_of_the_error_is_the_caller_s() -> None:
    with pytest.raises(RecordingError), reading("a.tif", "TIFF file", RecordingError):
        raise AssertionError


def test_errors_of_this_library_and_of_the_file_system_pass_unchanged() -> None:
    for error in (ReadError("b.stl: empty"), FileNotFoundError(2, "No such file", "b.stl")):
        with pytest.raises(type(error)) as caught, reading("a.stl", "mesh"):
            raise error
        assert caught.value is error


def test_an_error_of_the_file_system_without_a_file_is_foreign() -> None:
    with pytest.raises(ReadError, match=r"^a\.stl: not a readable mesh: bad seek$"), reading("a.stl", "mesh"):
        raise OSError("bad seek")


@pytest.mark.parametrize(
    ("problem", "reason"),
    [
        (ValueError("one\ntwo"), "one"),
        (ValueError("\n  \nfirst\twords\x1b[31m"), "first words"),
        (KeyError(), "KeyError"),
        (MemoryError(), "it needs more memory than is available"),
        (RecursionError("maximum"), "it is nested too deeply"),
    ],
)
def test_reasons_are_one_printable_line(problem: BaseException, reason: str) -> None:
    assert reason_of(problem).startswith(reason)
    assert reason_of(problem).isprintable()


def test_a_limit_is_inclusive_and_may_be_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    limit = FileLimit("GPUVISION_MAX_TEST", 10)
    limit.check(10, "a.stl: 10 triangles")
    with pytest.raises(RecordingError, match=r"^a\.stl: 11 triangles"):
        limit.check(11, "a.stl: 11 triangles", RecordingError)
    monkeypatch.setenv("GPUVISION_MAX_TEST", "0.5")
    assert limit.value == 0.5
    for text in ("0", "-1", "nan", "many"):
        monkeypatch.setenv("GPUVISION_MAX_TEST", text)
        with pytest.raises(ReadError, match=f"^the environment variable GPUVISION_MAX_TEST is '{text}', expected"):
            limit.check(1, "a.stl")


@pytest.mark.parametrize(
    ("shape", "fits"), [((3, 4), True), ((3, 5), False), ((13,), False), ((), True), ((4, 3, 3), True)]
)
def test_pixels_are_rows_times_columns(shape: tuple[int, ...], fits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_MAX_PIXELS", "12")
    if fits:
        check_pixels(shape, "a.png")
    else:
        with pytest.raises(ReadError, match=rf"^a\.png: {(*shape, 1)[1]} x {shape[0]} pixels"):
            check_pixels(shape, "a.png")
