"""Fuzz the readers: ``python tests/fuzz/run.py [--runs N] [--seconds S] [READER ...]``; `make fuzz` calls it.

Each reader runs in a separate process. A run fails if it raises anything except an error with a message of one line,
ends the process, takes longer than 10 s of the processor or 120 s in all, or raises the memory of the process by more
than 256 MiB. A busy machine must not fail a run. Failures are written
to ``build/fuzz``, and the exit code is then 1. With ``--engine atheris`` the mutations follow the coverage of the
package's code.
"""

from __future__ import annotations

import argparse
import mmap
import os
import signal
import struct
import sys
import time
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from fuzz.mutation import mutated  # noqa: E402

OUT = ROOT / "build" / "fuzz"
_SECONDS = 10  # processor time of one run
_WAITED = 120  # [s] of one run in all: it may wait for something that never comes
_GROWTH = 256 << 10  # [KiB] limit on the memory above that after the first run; seeds take less than 1 MiB


class TooSlow(BaseException):
    """A run takes too long; no reader catches it."""


def _peak() -> int:
    """Return the largest resident memory of this process [KiB]."""
    return next(int(line.split()[1]) for line in Path("/proc/self/status").open() if line.startswith("VmHWM"))


def _interrupt(*_: object) -> None:
    raise TooSlow(f"takes more than {_SECONDS} s of the processor, or {_WAITED} s")


def _report(name: str, content: bytes, problem: str) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    path = OUT / f"{len(list(OUT.iterdir()))}-{name}"
    path.write_bytes(content)
    print(f"{name}: {problem}; see {path}", flush=True)


def _work(name: str, first: int, runs: int, end: float, shared: mmap.mmap) -> None:
    """Run mutations until their number or the time is reached; write the number of runs and of failures to `shared`."""
    from fuzz.readers import READERS

    reader = READERS[name]
    seed = reader.content()
    reader.accepts(seed)
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 2)  # messages of decoders
    for kind in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(kind, _interrupt)
    before = _peak()
    accepted, failed = struct.unpack_from("QQ", shared, 8)
    for number in range(first, runs):
        struct.pack_into("QQQ", shared, 0, number, accepted, failed)
        if time.monotonic() > end:
            return
        content = mutated(seed, number)
        signal.alarm(_WAITED)
        signal.setitimer(signal.ITIMER_PROF, _SECONDS)
        try:
            accepted += reader.accepts(content)
        except BaseException as error:
            failed += 1
            _report(name, content, f"{type(error).__name__}: {str(error)[:300]}")
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        if _peak() > before + _GROWTH:
            failed += 1
            _report(name, content, f"takes {(_peak() - before) >> 10} MiB more than the seed")
            before = _peak()
    struct.pack_into("QQQ", shared, 0, runs, accepted, failed)


def _fuzz(name: str, runs: int, seconds: float) -> int:
    """Fuzz one reader; return the number of failures."""
    shared = mmap.mmap(-1, 24)
    start, first = time.monotonic(), 0
    end = start + seconds
    while True:
        child = os.fork()
        if child == 0:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                _work(name, first, runs, end, shared)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        number, accepted, failed = struct.unpack_from("QQQ", shared, 0)
        if os.waitstatus_to_exitcode(status) == 0:
            break
        from fuzz.readers import READERS

        failed += 1
        _report(name, mutated(READERS[name].content(), number), f"ended with {os.waitstatus_to_exitcode(status)}")
        first = number + 1
        struct.pack_into("QQQ", shared, 0, first, accepted, failed)
    took = time.monotonic() - start
    print(f"{name:15} {number:7} runs, {accepted:6} accepted, {failed} failures, {took:.0f} s", flush=True)
    return failed


def _follow_coverage(name: str, runs: int, seconds: float) -> int:
    """Fuzz one reader with atheris in a child process; return 1 if it finds a failure, else 0."""
    child = os.fork()
    if child:
        return int(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0)
    import atheris

    with atheris.instrument_imports(include=["gpuvision", "gerbonara", "tomllib"]):
        from fuzz.readers import READERS
    corpus = OUT / "corpus" / name
    corpus.mkdir(parents=True, exist_ok=True)
    (corpus / "seed").write_bytes(READERS[name].content())
    how = [f"-runs={runs}", f"-max_total_time={int(seconds)}", f"-timeout={_SECONDS}", "-rss_limit_mb=2048"]
    atheris.Setup([name, *how, "-max_len=65536", f"-artifact_prefix={OUT}/", str(corpus)], READERS[name].accepts)
    atheris.Fuzz()
    return 0


def main() -> int:
    """Fuzz the readers that the command line names, or all; return the exit code."""
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("readers", nargs="*", metavar="READER")
    arguments.add_argument("--runs", type=int, default=1000)
    arguments.add_argument("--seconds", type=float, default=600.0, help="most seconds of a reader")
    arguments.add_argument("--engine", choices=("mutation", "atheris"), default="mutation")
    given = arguments.parse_args()
    if given.engine == "mutation":
        from fuzz.readers import LIMITS, READERS

        os.environ |= LIMITS
        names, fuzz = given.readers or list(READERS), _fuzz
    else:
        seeds = (ROOT / "tests" / "fuzz" / "seeds").iterdir()
        names = given.readers or sorted(each.name for each in seeds if each.is_file())
        fuzz = _follow_coverage
        os.environ |= {"GPUVISION_MAX_PIXELS": "1e6", "GPUVISION_MAX_TRIANGLES": "1e4"}
    return int(sum(fuzz(name, given.runs, given.seconds) for name in names) > 0)


if __name__ == "__main__":
    sys.exit(main())
