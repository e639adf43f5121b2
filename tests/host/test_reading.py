"""Errors of readers: one line with the file, the expected content, the reason and the advice."""

from __future__ import annotations

import pytest

from gpuvision.host.errors import ReadError, RecordingError
from gpuvision.host.reading import reading, reason_of


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
