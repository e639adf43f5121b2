"""Tuned settings of launches: declared by operations, measured by `gpuvision.host.tuning`, kept in the cache folder.

`LaunchBuilder` looks the settings up when an operation is bound. A call of a bound instance does not look anything up.
"""

from __future__ import annotations

import contextlib
import contextvars
import functools
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
from gpuvision.host.device import Device
from gpuvision.host.kept import clear_with
from gpuvision.host.kept_numbers import driver_key

VARIABLE = "GPUVISION_TUNING"
_FILE = "tuned_settings.json"
_FORMAT = 1  # changes with the meaning of an entry
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
    """Settings that were faster than the defaults, with what they were measured on.

    Attributes
    ----------
    operation, dtype, device, version : str
        Class of the operation, dtype of its first input, label of the device, version of gpuvision.
    size_class : int
        See `size_class`.
    driver : tuple of str
        Names and versions of the device and its driver.
    settings : TunedSettings
    gain : float
        Time with the defaults over the time with these settings.
    """

    operation: str
    dtype: str
    size_class: int
    device: str
    driver: tuple[str, ...]
    version: str
    settings: TunedSettings
    gain: float

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What the entry is found by; driver and version are compared after that."""
        return (self.operation, self.dtype, self.size_class, self.device)

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


def entry_of(
    operation: object, device: Device, shape: Sequence[int], dtype: Any, settings: TunedSettings, gain: float
) -> TunedEntry:
    """Return the entry of an operation for inputs of one size class on a device with its present driver."""
    return TunedEntry(
        operation=type(operation).__name__,
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


def settings_for(operation: object, device: Device, shape: Sequence[int], dtype: Any) -> TunedSettings:
    """Return the settings of a launch: the kept ones if they fit driver and version, otherwise the defaults.

    Warns
    -----
    RuntimeWarning
        The file of settings is damaged, or its settings are of another driver or version; once per process.
    """
    tunable = getattr(type(operation), "tunable", None)
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
    if kept.origin != now.origin or not tunable.allows(kept.settings):
        _warn_stale(device.label)
        return DEFAULTS
    return kept.settings


def keep_entries(entries: Sequence[TunedEntry], tuned: Sequence[tuple[str, str, int, str]]) -> Path:
    """Write entries to the cache folder, in place of the entries of all tuned keys; return the path of the file.

    Raises
    ------
    OSError
        The folder is not writable.
    """
    path = cache_folder() / _FILE
    others = [each for each in _read(path)[0].values() if each.key not in tuned]
    listed = [asdict(each) for each in (*others, *entries)]
    write_private(path, json.dumps({"format": _FORMAT, "entries": listed}, indent=1))
    _forget()
    return path


@functools.cache
def _kept() -> Mapping[tuple[str, str, int, str], TunedEntry]:
    """Return the kept entries by their keys, read once per process; warn where the file is damaged."""
    path = cache_folder() / _FILE
    entries, is_damaged = _read(path)
    if is_damaged:
        warnings.warn(f"{path} is damaged or not private: {_REMEDY}", RuntimeWarning, stacklevel=2)
    return entries


@functools.cache
def _warn_stale(label: str) -> None:
    """Warn once per device."""
    text = f"tuned settings of device {label} are of another driver or version of gpuvision: {_REMEDY}"
    warnings.warn(text, RuntimeWarning, stacklevel=2)


def _forget() -> None:
    _kept.cache_clear()
    _warn_stale.cache_clear()


clear_with(_forget)


def _read(path: Path) -> tuple[dict[tuple[str, str, int, str], TunedEntry], bool]:
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
        all(isinstance(each, str) for each in (entry.operation, entry.dtype, entry.device, entry.version))
        and all(isinstance(each, str) for each in entry.driver)
        and type(entry.size_class) is int
        and isinstance(entry.gain, float)
        and chosen.variant in (None, "work_item")
        and all(each is None or (type(each) is int and each > 0) for each in (chosen.strip, chosen.group))
        and (chosen.inline is None or isinstance(chosen.inline, bool))
    )
    return entry if is_valid else None
