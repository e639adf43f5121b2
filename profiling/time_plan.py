"""Plan of the time of a benchmark run: how long each case may be measured, so that the run ends in time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

# Assumed before the first section has ended: cases of a section, and time to prepare them (compilation of peers,
# references in double precision).
_CASES, _PREPARATION = 6.0, 5.0  # [1], [s]
_LEAST = 0.05  # shortest time to measure a case [s]


class TimePlan:
    """Plan of the time of a run. A section is one operation on one device.

    Numbers of cases and times of preparation are not known before a section has run. Those of the running section and
    of the sections to come are assumed to be the mean of the sections that have ended, beside the known times.

    Parameters
    ----------
    total : float
        Time of the whole run [s]; infinity: each case is measured for `longest`.
    longest : float
        Longest time to measure a case [s].
    known : sequence of float
        For each section of the run: the part of its preparation that is known before [s], 0 for most.
    """

    def __init__(self, total: float, longest: float, known: Sequence[float]) -> None:
        self.total, self.longest = total, longest
        self._known = list(known)
        self._left = len(self._known)  # with the running one
        # Of the sections that have ended: their number, their cases, and their time beside the measurement [s].
        self._ended, self._ended_cases, self._ended_preparation = 0, 0, 0.0
        self._begun = time.perf_counter()
        self._begin_section()

    @property
    def elapsed(self) -> float:
        """Time since the beginning of the run [s]."""
        return time.perf_counter() - self._begun

    @contextmanager
    def section(self) -> Iterator[None]:
        """Count a section, from its beginning to its end."""
        self._begin_section()
        try:
            yield
        finally:
            self._ended_preparation += max(self._prepared() - self._known.pop(0), 0.0)
            self._ended_cases += self._cases
            self._ended += 1
            self._left -= 1

    def _begin_section(self) -> None:
        self._section_begun = time.perf_counter()
        self._granted = 0.0  # time for the measurement of the cases of the section so far [s]
        self._begin_attempt()

    def _begin_attempt(self) -> None:
        self._attempt_begun = time.perf_counter()
        self._cases = 0  # of the attempt so far

    def grant(self) -> float:
        """Count a case, and return the time for which it may be measured [s]."""
        expected = max(self._ended_cases / self._ended, 1.0) if self._ended else _CASES
        cases = max(expected - self._cases, 1.0) + expected * (self._left - 1)
        here = self._preparation() + self._known[0]
        preparation = max(here - self._prepared(), 0.0) + self._preparation_to_come()
        seconds = min(max((self.total - self.elapsed - preparation) / cases, _LEAST), self.longest)
        self._granted += seconds
        self._cases += 1
        return seconds

    def allows_repetition(self) -> bool:
        """Return whether the time suffices to repeat the last attempt of the section that runs now."""
        last = time.perf_counter() - self._attempt_begun
        return self.total - self.elapsed - self._preparation_to_come() > last

    def repeat(self) -> None:
        """Begin another attempt of the section that runs now."""
        self._begin_attempt()

    def _prepared(self) -> float:
        """Return the time of the running section so far beside the measurement [s]."""
        return max(time.perf_counter() - self._section_begun - self._granted, 0.0)

    def _preparation(self) -> float:
        """Return the expected time of a section beside measurement and known time [s]: references, compilation."""
        return self._ended_preparation / self._ended if self._ended else _PREPARATION

    def _preparation_to_come(self) -> float:
        """Return the expected time beside the measurement of the sections after the running one [s]."""
        return self._preparation() * (self._left - 1) + sum(self._known[1:])
