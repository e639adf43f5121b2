"""Every reader refuses damaged files in one line: mutations of a valid file of each kind."""

from __future__ import annotations

import warnings

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzz.mutation import mutated
from fuzz.readers import LIMITS, READERS


@pytest.fixture(autouse=True)
def _small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in LIMITS.items():
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize("name", READERS)
def test_seeds_are_accepted(name: str) -> None:
    assert READERS[name].accepts(READERS[name].content())


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(number=st.integers(0, 2**32))
def test_damaged_files_are_refused_in_one_line(name: str, number: int) -> None:
    reader = READERS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's of numbers that overflow
        reader.accepts(mutated(reader.content(), number))
