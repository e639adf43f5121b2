"""Debug switch: programs and arrays written to the folder that the environment variable ``GPUVISION_DEBUG`` names.

With ``GPUVISION_DEBUG=FOLDER`` each build of a program writes one ``.cl`` file to the folder: all includes resolved,
macros defined at the top, device, build options and build log in comments. The file compiles alone. A comparison inside
`dump_on_failure` writes its arrays to an ``.npz`` file there when it fails; so does each test of gpuvision. A process
builds each program once per set of macros: set the variable before the process starts.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gpuvision.host.argument_table import with_argument_table
from gpuvision.host.arrays import DeviceArray, HostArray, to_numpy

VARIABLE = "GPUVISION_DEBUG"
_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]+"([^"]+)".*$', re.MULTILINE)
_GUARD = re.compile(r"#ifndef (\w+)\n#define \1\n")
_DIRECTIVE = re.compile(r"^[ \t]*#[ \t]*(\w+)", re.MULTILINE)
_LINE_END = "\n"
_UNSAFE = re.compile(r"[^\w.-]+")


def debug_folder() -> Path | None:
    """Return the folder of the variable ``GPUVISION_DEBUG``, made where it is missing; None where it is not set."""
    name = os.environ.get(VARIABLE)
    if not name:
        return None
    folder = Path(name)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def flatten_includes(folder: Path, source: str, include_folders: Sequence[Path] = ()) -> str:
    """Return a kernel file with the ``#include "..."`` lines replaced by the text of the headers.

    Parameters
    ----------
    folder : pathlib.Path
        Folder of the kernel sources.
    source : str
        Path of the kernel file relative to `folder`.
    include_folders : sequence of pathlib.Path
        More folders that are searched for headers, after the folder of the including header and `folder`.

    Returns
    -------
    str
        OpenCL C. ``#line`` directives name the original files, so that compiler messages point into them. A header
        is omitted where its include guard makes it empty: inside itself, and after an include without a condition.
        The line of a header that does not exist stays, for the compiler to report.
    """
    return _Flattener((folder, *include_folders)).text(folder / source, source)


class _Include(NamedTuple):
    """Line ``#include "..."`` whose header was found."""

    name: str
    header: Path
    conditional: bool  # whether it stands between #if and #endif, apart from the include guard of its file


class _Parts(NamedTuple):
    """Text of a file before each include line, and after the last one."""

    texts: list[str]
    includes: list[_Include]
    guarded: bool  # whether an include guard makes the file empty when it is included again

    @classmethod
    def of(cls, path: Path, name: str, folders: Sequence[Path]) -> _Parts:
        """Read a file and find its headers in the folders."""
        text = f"{path.read_text().rstrip()}\n"
        guarded = _is_guarded(text)
        parts, start = cls([f'#line 1 "{name}"\n'], [], guarded), 0
        for found in _INCLUDE.finditer(text):
            candidates = [Path(os.path.normpath(folder / found[1])) for folder in folders]
            header = next((each for each in candidates if each.is_file()), None)
            if header is None:
                continue
            before = text[: found.start()]
            parts.includes.append(_Include(found[1], header, conditional=_depths(before)[-1] > guarded))
            parts.texts[-1] += text[start : found.start()]
            parts.texts.append(f'#line {before.count(_LINE_END) + 2} "{name}"')
            start = found.end()
        parts.texts[-1] += text[start:]
        return parts


def _depths(text: str) -> list[int]:
    """Return the number of open ``#if`` conditions at the start, and after each directive."""
    kinds = [found[1] for found in _DIRECTIVE.finditer(text)]
    return list(itertools.accumulate((kind.startswith("if") - (kind == "endif") for kind in kinds), initial=0))


def _is_guarded(text: str) -> bool:
    """Return whether one include guard encloses a file: its condition is open up to the last directive."""
    first = _DIRECTIVE.search(text)
    starts = first is not None and _GUARD.match(text, first.start()) is not None
    return starts and 0 not in _depths(text)[1:-1] and text.rstrip().endswith("#endif")


class _Flattener:
    """Writer of a file with its headers in place; a guarded header that was written before is left out."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.folders = folders
        self.known: dict[tuple[Path, str], _Parts] = {}
        self.written: set[Path] = set()  # guarded headers that the compiler has seen, whatever the macros are

    def text(self, path: Path, name: str, including: tuple[Path, ...] = (), *, conditional: bool = False) -> str:
        """Return the text of a file; `including` is the chain of files whose includes led to it."""
        if (path, name) not in self.known:
            # The main file is compiled from memory: only a header is searched beside the including file.
            places = (path.parent, *self.folders) if including else self.folders
            self.known[path, name] = _Parts.of(path, name, places)
        parts = self.known[path, name]
        if parts.guarded and not conditional:
            self.written.add(path)
        text = parts.texts[0]
        for include, after in zip(parts.includes, parts.texts[1:], strict=True):
            if include.header not in (*including, path) and include.header not in self.written:
                inside = conditional or include.conditional
                text += self.text(include.header, include.name, (*including, path), conditional=inside)
            text += after
        return text


def dump_program(
    handle: Any,
    folder: Path,
    source: str,
    options: Sequence[str],
    include_folders: Sequence[Path],
    log: str,
    *,
    in_table: str | None = None,
) -> Path | None:
    """Write a program as one file that compiles alone, and return its path; None where no debug folder is set.

    Parameters
    ----------
    handle : pyopencl.Device
        Device that the program is built for.
    folder, source, include_folders
        As in `flatten_includes`; the file is named after `source`.
    options : sequence of str
        Build options, macros (``-DNAME`` or ``-DNAME=VALUE``) among them.
    log : str
        Build log.
    in_table : str, optional
        Name of a kernel that reads its arguments from a table, see `gpuvision.host.argument_table`.
    """
    target = debug_folder()
    if target is None:
        return None
    program = flatten_includes(folder, source, include_folders)
    if in_table is not None:
        program = with_argument_table(program, in_table)
    macros = [option.removeprefix("-D").partition("=") for option in options if option.startswith("-D")]
    text = "".join(
        [
            f"// {source}\n",
            f"// device: {handle.name.strip()}, driver {handle.driver_version}\n",
            f"// build options: {' '.join(options)}\n",
            # A compiler defines a macro without a value as 1.
            *(f"#define {name} {value if has_value else 1}\n" for name, has_value, value in macros),
            program,
        ]
    )
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    path = target / f"{Path(source).stem}-{digest}.cl"
    path.write_text(f"{text}\n/* build log:\n{log.strip().replace('*/', '* /')}\n*/\n")
    return path


def dump_arrays(name: str, /, **values: Any) -> Path | None:
    """Write arrays to a new ``.npz`` file in the debug folder and return its path; None where no debug folder is set.

    Parameters
    ----------
    name : str
        Stem of the file; characters that file names do not take become ``_``.
    **values
        NumPy arrays, device arrays (copied to the host), scalars, and named tuples, sequences or mappings of them,
        such as results of operations: the field ``g`` of ``result`` is stored as ``result.g``. Other values and
        ``None`` are skipped.

    Returns
    -------
    pathlib.Path or None
        ``FOLDER/name.npz``, or ``FOLDER/name-2.npz``, ... where the file exists.
    """
    folder = debug_folder()
    if folder is None:
        return None
    arrays = dict(_named("", values))
    stem = _UNSAFE.sub("_", name).strip("_") or "arrays"
    for number in itertools.count(1):
        path = folder / (f"{stem}.npz" if number == 1 else f"{stem}-{number}.npz")
        with contextlib.suppress(FileExistsError), zipfile.ZipFile(path, "x") as file:
            for key, array in arrays.items():
                with file.open(f"{key}.npy", "w") as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
            return path
    return None


@contextlib.contextmanager
def dump_on_failure(name: str, /, **values: Any) -> Iterator[None]:
    """Write arrays with `dump_arrays` when the block fails, and name the file in the exception.

    Parameters
    ----------
    name : str
        Stem of the file.
    **values
        Inputs, results and expected values of the comparison, see `dump_arrays`.

    Examples
    --------
    >>> import numpy as np
    >>> with dump_on_failure("squares", result=np.array([1, 4]), expected=np.array([1, 4])):
    ...     np.testing.assert_array_equal(np.array([1, 2]) ** 2, [1, 4])
    """
    try:
        yield
    except Exception as error:
        path = dump_arrays(name, **values)
        if path is not None:
            error.add_note(f"arrays of the failed comparison: {path}")
        raise


def _named(name: str, value: Any) -> Iterator[tuple[str, HostArray]]:
    """Yield the arrays of a value under dotted names."""
    if isinstance(value, np.ndarray | DeviceArray):
        array = to_numpy(value)
        if not array.dtype.hasobject:
            yield name, array
    elif isinstance(value, bool | int | float | complex | np.generic):
        yield name, np.asarray(value)
    elif isinstance(value, Mapping):
        for key, each in value.items():
            yield from _named(f"{name}.{key}" if name else str(key), each)
    elif isinstance(value, tuple | list):
        keys = getattr(value, "_fields", None) or range(len(value))
        for key, each in zip(keys, value, strict=True):
            yield from _named(f"{name}.{key}", each)
