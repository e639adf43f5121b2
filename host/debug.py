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
from typing import Any

import numpy as np

from gpuvision.host.arrays import DeviceArray, HostArray, to_numpy

VARIABLE = "GPUVISION_DEBUG"
_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"]+)"')
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
        OpenCL C. ``#line`` directives name the original files, so that compiler messages point into them. A header that
        includes itself indirectly is omitted at the inner include, where the include guard would make it empty. The
        line of a header that does not exist stays, for the compiler to report.
    """
    return "".join(_flattened(folder / source, source, (folder, *include_folders), ()))


def _flattened(path: Path, name: str, folders: Sequence[Path], including: tuple[Path, ...]) -> Iterator[str]:
    yield f'#line 1 "{name}"\n'
    for number, line in enumerate(path.read_text().splitlines(), 1):
        found = _INCLUDE.match(line)
        if found is None:
            yield f"{line}\n"
            continue
        # The main file is compiled from memory: only headers are searched in the folder of the including file.
        own_folder = [path.parent] if including else []
        header = next((each / found[1] for each in (*own_folder, *folders) if (each / found[1]).is_file()), None)
        if header is None:
            yield f"{line}\n"
            continue
        if header.resolve() not in including:
            yield from _flattened(header, found[1], folders, (*including, path.resolve()))
        yield f'#line {number + 1} "{name}"\n'


def dump_program(
    handle: Any, folder: Path, source: str, options: Sequence[str], include_folders: Sequence[Path], log: str
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
    """
    target = debug_folder()
    if target is None:
        return None
    macros = [option.removeprefix("-D").partition("=") for option in options if option.startswith("-D")]
    text = "".join(
        [
            f"// {source}\n",
            f"// device: {handle.name.strip()}, driver {handle.driver_version}\n",
            f"// build options: {' '.join(options)}\n",
            # A compiler defines a macro without a value as 1.
            *(f"#define {name} {value if has_value else 1}\n" for name, has_value, value in macros),
            flatten_includes(folder, source, include_folders),
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
