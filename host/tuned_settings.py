"""Tuned settings of launches: declared by operations, measured by `gpuvision.host.tuning`, kept in the cache folder.

`LaunchBuilder` looks the settings up when an operation is bound. A call of a bound instance does not look anything up.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
import hashlib
import json
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gpuvision.host.cache import cache_folder, read_private, write_private
from gpuvision.host.debug import flatten_includes
from gpuvision.host.device import Device
from gpuvision.host.files import locked_folder
from gpuvision.host.kept import clear_with
from gpuvision.host.kept_numbers import driver_key
from gpuvision.host.launch import Launchable

VARIABLE = "GPUVISION_TUNING"
_FILE = "tuned_settings.json"
_FORMAT = 2  # changes with the meaning of an entry
# Macros that depend on the size of the input, and not on the parameters of the operation.
_SIZE_MACROS = frozenset({"PAST_CACHES"})
Key = tuple[str, str, str, int, str]
_REMEDY = "defaults apply; run `gpuvision tune` again"


@dataclass(frozen=True, kw_only=True)
class Tunable:
    """Settings of an operation that a tuner may change, with their allowed values.

    Attributes
    ----------
    strips : tuple of int
        Elements of a work-item in the vector variant of the kernel. Default (): not tunable.
    groups : tuple of int
        Work-items of a work-group in the other variant. Default (): not tunable.
    variants : bool
        Whether the work-item variant may replace the vector variant. Default False.
    tolerance : mapping of str to float
        Largest allowed difference of a field of the result, relative to the largest magnitude of the field. Fields
        that are not named must be equal. Default: all fields.
    """

    strips: tuple[int, ...] = ()
    groups: tuple[int, ...] = ()
    variants: bool = False
    tolerance: Mapping[str, float] = field(default_factory=dict)

    def allows(self, settings: TunedSettings) -> bool:
        """Return whether the operation offers these settings."""
        return (
            settings.strip in (None, *self.strips)
            and settings.group in (None, *self.groups)
            and (settings.variant is None or self.variants)
        )


@dataclass(frozen=True, kw_only=True)
class TunedSettings:
    """Settings of a launch; ``None`` is the default of the operation. ``str(settings)`` names the others.

    Attributes
    ----------
    variant : {"work_item", None}
        Kernel variant where the operation has ``variant="auto"``.
    strip, group : int or None
        As in `Tunable`.
    inline : bool or None
        Whether a small launch runs in the calling thread.
    """

    variant: Literal["work_item"] | None = None
    strip: int | None = None
    group: int | None = None
    inline: bool | None = None

    def __str__(self) -> str:
        parts = [
            "" if self.variant is None else f"variant {self.variant}",
            "" if self.strip is None else f"strip {self.strip}",
            "" if self.group is None else f"group {self.group}",
            "" if self.inline is None else "inline" if self.inline else "worker threads",
        ]
        return ", ".join(filter(None, parts)) or "default"


DEFAULTS = TunedSettings()
_trial: contextvars.ContextVar[TunedSettings | None] = contextvars.ContextVar("trial", default=None)


@dataclass(frozen=True, kw_only=True)
class TunedEntry:
    """Settings that were faster than the defaults, and the operation, input, device and versions of the measurement.

    Attributes
    ----------
    operation : str
        Module and qualified name of the operation's class.
    program : str
        Digest of the program, see `program_digest`.
    dtype, device, version : str
        Dtype of the first input, label of the device, version of gpuvision.
    size_class : int
        See `size_class`.
    driver : tuple of str
        Names and versions of the device and its driver.
    settings : TunedSettings
    gain : float
        Time with the defaults over the time with these settings.
    """

    operation: str
    program: str
    dtype: str
    size_class: int
    device: str
    driver: tuple[str, ...]
    version: str
    settings: TunedSettings
    gain: float

    @property
    def key(self) -> Key:
        """Key under which the entry is kept; a lookup compares driver and version after it has found the entry."""
        return (self.operation, self.program, self.dtype, self.size_class, self.device)

    @property
    def origin(self) -> tuple[tuple[str, ...], str]:
        """Driver and version of gpuvision."""
        return (self.driver, self.version)


def size_class(shape: Sequence[int]) -> int:
    """Return the class of an input's size: sizes of class k have 4^k to 4^(k+1) - 1 elements.

    Examples
    --------
    >>> [size_class(shape) for shape in [(0,), (3,), (4,), (1000, 2), (1000, 1000)]]
    [0, 0, 1, 5, 9]
    """
    return max((math.prod(shape).bit_length() - 1) // 2, 0)


def program_digest(operation: Launchable, device: Device, shape: Sequence[int], dtype: Any) -> str:
    """Return a digest of the program that an operation runs with the default settings.

    It covers the text of the source with its headers, the kernel, its macros and the dtypes of its outputs. Values of
    kernel arguments are left out: equal digests mean the same code, not the same numbers.
    """
    with trial_of(DEFAULTS):
        launch = operation.launch(device, tuple(shape), np.dtype(dtype))
    macros = sorted((name, str(value)) for name, value in launch.defines.items() if name not in _SIZE_MACROS)
    outputs = [(name, None if spec is None else spec[1].str) for name, spec in launch.outputs.items()]
    folder = operation.kernel_folder or Path()
    source = flatten_includes(folder, launch.source, operation.include_folders)
    text = repr((source, launch.kernel, macros, outputs))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def entry_of(
    operation: Launchable, device: Device, shape: Sequence[int], dtype: Any, settings: TunedSettings, gain: float
) -> TunedEntry:
    """Return the entry of an operation for inputs of one size class on a device with its present driver."""
    kind = type(operation)
    return TunedEntry(
        operation=f"{kind.__module__}.{kind.__qualname__}",
        program=program_digest(operation, device, shape, dtype),
        dtype=np.dtype(dtype).name,
        size_class=size_class(shape),
        device=device.label,
        driver=tuple(map(str, driver_key(device.handle))),
        version=version("gpuvision"),
        settings=settings,
        gain=gain,
    )


@contextlib.contextmanager
def trial_of(settings: TunedSettings) -> Iterator[None]:
    """Bind operations with these settings instead of the kept ones, in this thread, within a ``with`` block."""
    token = _trial.set(settings)
    try:
        yield
    finally:
        _trial.reset(token)


def settings_for(operation: Launchable, device: Device, shape: Sequence[int], dtype: Any) -> TunedSettings:
    """Return the settings of a launch: the kept ones if they fit driver and version, otherwise the defaults.

    Warns
    -----
    RuntimeWarning
        The file of settings is damaged, its settings are of another driver or version, or the operation does not offer
        them; each of these once per process and device.
    """
    tunable: Tunable | None = getattr(type(operation), "tunable", None)
    if tunable is None:
        return DEFAULTS
    trial = _trial.get()
    if trial is not None:
        return trial
    if os.environ.get(VARIABLE) == "off" or not _kept():
        return DEFAULTS
    now = entry_of(operation, device, shape, dtype, DEFAULTS, 1.0)
    kept = _kept().get(now.key)
    if kept is None:
        return DEFAULTS
    if kept.origin != now.origin:
        _warn_once(f"tuned settings of device {device.label} are of another driver or version of gpuvision")
        return DEFAULTS
    if not tunable.allows(kept.settings):
        name = type(operation).__name__
        _warn_once(f"{name} does not offer the tuned settings of device {device.label} ({kept.settings})")
        return DEFAULTS
    return kept.settings


def keep_entries(entries: Sequence[TunedEntry], tuned: Sequence[Key]) -> Path:
    """Replace the kept entries of the tuned keys by these entries; return the path of the file in the cache folder.

    Processes that keep entries at the same time wait for each other, so that no entry is lost.

    Raises
    ------
    OSError
        The folder is not writable.
    """
    path = cache_folder() / _FILE
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with locked_folder(path.parent):
        others = [each for each in _read(path)[0].values() if each.key not in tuned]
        listed = [asdict(each) for each in (*others, *entries)]
        write_private(path, json.dumps({"format": _FORMAT, "entries": listed}, indent=1))
    _forget()
    return path


@functools.cache
def _kept() -> Mapping[Key, TunedEntry]:
    """Return the kept entries by their keys, read once per process; warn where the file is damaged."""
    path = cache_folder() / _FILE
    entries, is_damaged = _read(path)
    if is_damaged:
        warnings.warn(f"{path} is damaged or not private: {_REMEDY}", RuntimeWarning, stacklevel=2)
    return entries


@functools.cache
def _warn_once(defect: str) -> None:
    """Warn once of each defect."""
    warnings.warn(f"{defect}: {_REMEDY}", RuntimeWarning, stacklevel=2)


def _forget() -> None:
    _kept.cache_clear()
    _warn_once.cache_clear()


clear_with(_forget)


def _read(path: Path) -> tuple[dict[Key, TunedEntry], bool]:
    """Return the valid entries of the file, and whether anything in it is damaged."""
    if not os.path.lexists(path):
        return {}, False
    try:
        read = json.loads(read_private(path) or "")
        listed = list(read["entries"]) if read["format"] == _FORMAT else None
    except (ValueError, KeyError, TypeError, RecursionError):
        listed = None
    entries = [_entry(each) for each in listed or ()]
    return {each.key: each for each in entries if each is not None}, listed is None or None in entries


def _entry(read: Any) -> TunedEntry | None:
    """Return an entry as read from JSON; None if it is damaged."""
    try:
        entry = TunedEntry(**{**read, "driver": tuple(read["driver"]), "settings": TunedSettings(**read["settings"])})
    except (KeyError, TypeError):
        return None
    chosen = entry.settings
    is_valid = (
        all(isinstance(each, str) for each in (*entry.key[:3], entry.device, entry.version))
        and all(isinstance(each, str) for each in entry.driver)
        and type(entry.size_class) is int
        and isinstance(entry.gain, float)
        and chosen.variant in (None, "work_item")
        and all(each is None or (type(each) is int and each > 0) for each in (chosen.strip, chosen.group))
        and (chosen.inline is None or isinstance(chosen.inline, bool))
    )
    return entry if is_valid else None
