"""Compile kernels: once per context, source file and set of defines."""

from __future__ import annotations

import functools
import hashlib
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyopencl as cl

from gpuvision.host.argument_table import takes_table, with_argument_table
from gpuvision.host.debug import debug_folder, dump_program, flatten_includes
from gpuvision.host.device import Device
from gpuvision.host.errors import BuildError
from gpuvision.host.kept import clear_with
from gpuvision.host.stages import stage

_COMMENT = re.compile(r"[ \t]*//[^\n]*")

Define = int | float | str | None


def options(defines: Mapping[str, Define]) -> list[str]:
    """Return compiler options for macros; the value ``None`` defines a macro without a value.

    The options never contain ``-cl-fast-relaxed-math`` or ``-cl-finite-math-only``, because range images mark missing
    points with NaN.
    """
    words = [f"-D{name}" if value is None else f"-D{name}={value}" for name, value in sorted(defines.items())]
    return ["-cl-mad-enable", *words]


def build(
    device: Device,
    folder: Path,
    source: str,
    defines: Mapping[str, Define],
    *,
    include_folders: Sequence[Path] = (),
    handle: Any = None,
    in_table: str | None = None,
) -> Any:
    """Return the program of a kernel file for a device; build it on the first call.

    Parameters
    ----------
    device : Device
    folder : pathlib.Path
        Folder of the kernel sources. Kernels include headers by their path relative to it.
    source : str
        Path of the ``.cl`` file relative to `folder`.
    defines : mapping of str to value
        Macros that change the code: the real type, the terms that exist. Sizes are kernel arguments.
    include_folders : sequence of pathlib.Path, optional
        More folders that are searched for headers, after `folder`.
    handle : pyopencl.Device, optional
        Device of the context to build for; ``device.handle`` by default.
    in_table : str, optional
        Name of a kernel that reads its arguments from a table, see `gpuvision.host.argument_table`.

    Returns
    -------
    pyopencl.Program

    Raises
    ------
    BuildError
        The source does not compile; the message contains the compiler's log.

    Notes
    -----
    Where the environment variable ``GPUVISION_DEBUG`` names a folder, each build writes its complete source there, see
    `gpuvision.host.debug`.
    """
    handle = device.handle if handle is None else handle
    return _build(device.context, handle, folder, source, tuple(options(defines)), tuple(include_folders), in_table)


@functools.cache
def sources_digest(folder: Path) -> str:
    """Return a digest of the kernel files and headers of a folder, without their comments.

    A process reads the files once: programs that it has built do not follow later changes either.
    """
    digest = hashlib.sha256()
    for path in sorted(each for each in folder.rglob("*") if each.suffix in (".cl", ".h")):
        text = _COMMENT.sub("", path.read_text(encoding="utf-8"))
        digest.update(repr((path.relative_to(folder).as_posix(), text)).encode())
    return digest.hexdigest()[:16]


@functools.cache
def can_read_table(folder: Path, source: str, include_folders: tuple[Path, ...], kernel: str) -> bool:
    """Return whether a kernel can be built to read its arguments from a table (`in_table` of `build`)."""
    return takes_table(_text(folder, source, include_folders), kernel)


def _text(folder: Path, source: str, include_folders: tuple[Path, ...]) -> str:
    """Return a kernel file with its headers, without comments."""
    return _COMMENT.sub("", flatten_includes(folder, source, include_folders))


@functools.lru_cache(maxsize=256)
def _build(
    context: Any,
    handle: Any,
    folder: Path,
    source: str,
    words: tuple[str, ...],
    include_folders: tuple[Path, ...],
    in_table: str | None,
) -> Any:
    # The compilers' caches know a program by its text and options. With the headers in the text, no comments in it and
    # no path in the options, all copies of the kernels (checkouts, an installed package) share the cached programs, and
    # a changed comment needs no compilation. The #include line of a header that is not in these folders stays in the
    # text: the compiler searches its include path for the header, and reports an error if it finds none.
    text = _text(folder, source, include_folders)
    if in_table is not None:
        text = with_argument_table(text, in_table)
    folders = (folder, *include_folders) if "#include" in text else ()
    includes = [word for each in folders for word in ("-I", os.fspath(each))]
    program = cl.Program(context, text)
    dump = functools.partial(dump_program, handle, folder, source, words, include_folders, in_table=in_table)
    try:
        with warnings.catch_warnings():
            # The CPU runtimes report success ("Device ... successfully vectorised") as compiler output.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            # A program from pyopencl's cache has no build log.
            cache_dir: Any = None if debug_folder() is None else False
            with stage("compile", source):
                built: Any = program.build(options=[*words, *includes], devices=[handle], cache_dir=cache_dir)
    except cl.RuntimeError as error:
        log = "\n".join(line for line in str(error).splitlines() if line.strip())
        dump(log)
        raise BuildError(f"{folder.name}/{source} does not build with {' '.join(words)}:\n{log}") from error
    if debug_folder() is not None:
        dump(built.get_build_info(handle, cl.program_build_info.LOG))
    return built


clear_with(can_read_table.cache_clear)
clear_with(_build.cache_clear)
clear_with(sources_digest.cache_clear)
