"""Plan of the time of a benchmark run: how long each case may be measured, so that the run ends in time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

# Assumed before the first section has ended: cases of a section, and time to prepare them (compilation of peers,
# references in double precision).
_CASES, _PREPARATION = 6.0, 5.0  # [1], [s]
_LEAST = 0.05  # shortest time to measure a case [s]


class TimePlan:
    """Plan of the time of a run. A section is one operation on one device.

    Numbers of cases and times of preparation are not known before a section has run: those of the sections to come are
    assumed to be the mean of the sections that have ended.

    Parameters
    ----------
    total : float
        Time of the whole run [s]; infinity: each case is measured for `longest`.
    longest : float
        Longest time to measure a case [s].
    sections : int
        Number of sections of the run.
    """

    def __init__(self, total: float, longest: float, sections: int) -> None:
        self.total, self.longest = total, longest
        self._left = sections
        self._ended = 0
        self._cases = 0
        self._granted = 0.0  # time for the measurement of the cases so far [s]
        self._begun = time.perf_counter()
        self._section_begun = self._begun
        self._busy = 0.0  # time of the sections that have ended [s]

    @property
    def elapsed(self) -> float:
        """Time since the beginning of the run [s]."""
        return time.perf_counter() - self._begun

    @contextmanager
    def section(self) -> Iterator[None]:
        """Count a section, from its beginning to its end."""
        self._section_begun = time.perf_counter()
        try:
            yield
        finally:
            self._busy += time.perf_counter() - self._section_begun
            self._ended += 1
            self._left -= 1

    def grant(self) -> float:
        """Count a case, and return the time for which it may be measured [s]."""
        cases = self._cases / self._ended if self._ended else _CASES
        free = self.total - self.elapsed - self._preparation() * self._left
        seconds = min(max(free / (max(cases, 1.0) * self._left), _LEAST), self.longest)
        self._granted += seconds
        self._cases += 1
        return seconds

    def allows_repetition(self) -> bool:
        """Return whether the time suffices to repeat the section that runs now."""
        so_far = time.perf_counter() - self._section_begun
        return self.total - self.elapsed - self._preparation() * (self._left - 1) > so_far

    def _preparation(self) -> float:
        """Return the expected time of a section beside the measurement [s]: references, compilation, probes."""
        return max(self._busy - self._granted, 0.0) / self._ended if self._ended else _PREPARATION
