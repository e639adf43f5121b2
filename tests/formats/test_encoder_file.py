"""Encoder files: text, NPY and NPZ; refusals of one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.formats.encoder_file import read_encoder
from gpuvision.host import RecordingError

COUNTS = [0.0, 12.0, 25.5, -3.0]


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("0\n12\n25.5\n-3\n", None),
        ("# belt\ncount\n0\n12\n\n25.5\n-3", None),
        ("\ufeffcount\r\n0\r\n12\r\n25.5\r\n-3\r\n", "count"),
        ("time,count\n7,0\n8,12\n9,25.5\n10,-3\n", "count"),
        ("time; count ;x\n7;0;1\n8;12;1\n9;25.5;1\n10;-3;1\n", "count"),
        ('"time"\t"count"\n7\t0\n8\t12\n9\t25.5\n10\t-3\n', "count"),
    ],
)
def test_text(tmp_path: Path, text: str, key: str | None) -> None:
    path = tmp_path / "encoder.csv"
    path.write_text(text, encoding="utf-8", newline="")
    assert read_encoder(path, key).tolist() == COUNTS


def test_arrays(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([0, 2**40], np.int64))
    assert read_encoder(tmp_path / "a.npy").tolist() == [0.0, 2.0**40]
    np.savez(tmp_path / "one.npz", any=np.array([1.5, 2.5], np.float32))
    assert read_encoder(tmp_path / "one.npz").tolist() == [1.5, 2.5]
    np.savez(tmp_path / "two.npz", time=np.zeros(2), count=np.array([1, 2], np.uint8))
    assert read_encoder(tmp_path / "two.npz", "count").tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("name", "content", "key", "message"),
    [
        ("e.csv", "", None, r"e.csv: holds no value, expected one for each profile"),
        ("e.csv", "count\n", None, r"holds no value"),
        ("e.csv", "1\n2\nx3\n", None, r"line 3 has x3, expected a finite number"),
        ("e.csv", "1\n2\nnan\n", None, r"line 3 has nan, expected a finite number"),
        ("e.csv", "count\n1\n\n,\n", None, r"line 4 has 2 values, expected 1"),
        ("e.csv", "a,b\n1,2\n", None, r"several columns; name one of them as \[transport\] encoder_key \(a, b\)"),
        ("e.csv", "a,b\n1,2\n", "c", r"no column 'c'; name one of them as \[transport\] encoder_key \(a, b\)"),
        ("e.csv", "1,2\n", None, r"several columns; .* \(no named column\)"),
        ("e.csv", 'count\n"1\n2"\n', None, r"spans several lines"),
        ("e.csv", b"\xff\xfe1\x00", None, r"e.csv: not a readable encoder file"),
        ("e.npy", np.zeros((2, 2)), None, r"e.npy: holds float64 of shape \(2, 2\), expected numbers"),
        ("e.npy", np.zeros(0), None, r"shape \(0,\)"),
        ("e.npy", np.array([True]), None, r"holds bool"),
        ("e.npy", np.array([1.0, np.inf]), None, r"value 1 is inf, expected a finite number"),
        ("e.npy", np.zeros(3), "count", r"e.npy: an NPY file holds one array, without a name; leave out encoder_key"),
        ("e.npy", b"no array", None, r"e.npy: not a readable"),
        ("e.npz", b"no archive", None, r"e.npz: not a readable encoder file"),
        (
            "e.npz",
            {"a": np.array([1, None])},
            None,
            r"e.npz: not a readable encoder file: Object arrays cannot be loaded",
        ),
        ("e.npy", np.array([1, None]), None, r"e.npy: not a readable"),
        ("e.npz", {"a": np.zeros(2), "b": np.zeros(2)}, None, r"several arrays; name one of them .* \(a, b\)"),
    ],
)
def test_refusals(tmp_path: Path, name: str, content: Any, key: str | None, message: str) -> None:
    path = tmp_path / name
    if isinstance(content, np.ndarray):
        np.save(path, content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RecordingError, match=message) as raised:
        read_encoder(path, key)
    assert str(raised.value).isprintable()
    assert str(path) in str(raised.value)


def test_large_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_MAX_ENCODER_BYTES", "5")
    (tmp_path / "e.csv").write_text("1\n2\n3\n")
    with pytest.raises(RecordingError, match=r"6 bytes, expected at most 5; set GPUVISION_MAX_ENCODER_BYTES"):
        read_encoder(tmp_path / "e.csv")


def test_packed_arrays_that_are_large_are_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "e.npz", count=np.zeros(20_000_000))
    with pytest.raises(RecordingError, match=r"e\.npz: an array of 160000128 bytes, expected at most 16777216; set"):
        read_encoder(tmp_path / "e.npz")


def test_a_device_is_read_to_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_MAX_ENCODER_BYTES", "1000")
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: pytest.fail("reads without a bound"))
    (tmp_path / "e.csv").symlink_to("/dev/zero")
    with pytest.raises(RecordingError, match=r"e\.csv: 1001 bytes or more, expected at most 1000; set"):
        read_encoder(tmp_path / "e.csv")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"e\.csv"):
        read_encoder(tmp_path / "e.csv")
