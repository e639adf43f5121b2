"""Files of a board: checks of their sizes before gerbonara reads them, and the layers that they hold.

gerbonara builds every repeated object in memory, and its regular expressions take a time that grows with the square of
the length of a number or of text that is no command. The checks here take a time proportional to the file.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gerbonara import LayerStack
from gerbonara.cam import LazyCamFile
from gerbonara.excellon import ExcellonFile
from gerbonara.rs274x import GerberFile

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import check_archive, check_limit, reading
from gpuvision.matching.artwork.gerber_parser import parse_gerber

# A command, as gerbonara splits a file: a comment, an extended command between %, or text up to an asterisk.
_COMMAND = re.compile(r"G04[^*]*+\*|%[^%]*+%|[^*%]*+\*")
_STEP_REPEAT = re.compile(r"SRX0*(\d+)Y0*(\d+)I")
_POLYGON = re.compile(r"ADD\d+P,[^X*]*X([^X*]*)")
_REPEATED_HOLE = re.compile(r"^\s*R0*(\d+)", re.MULTILINE)
# G85 drills a slot from the point before it to the point after it. gerbonara 1.5 refuses it, and reads the same slot as
# a route: G00 to its start, M15 tool down, G01 to its end, M16 tool up, G05 drill mode.
_POINT = r"((?:X[-+.\d]+)?(?:Y[-+.\d]+)?)"
_CANNED_SLOT = re.compile(rf"^[ \t]*{_POINT}G85{_POINT}[ \t]*$", re.MULTILINE)
_LONG_NUMBER = re.compile(r"\d{101}")  # digits: coordinates have up to 9, hashes of attributes up to 64 characters
_LONG_SPACE = re.compile(r"\s{1001}")
# Characters of a block of an aperture macro (Gerber format specification 2024.05, section 4.5) and of a number's
# exponent. Python's parser, which gerbonara uses, also takes strings.
_MACRO_BLOCK = re.compile(r"[0-9.,+\-xX/()$=eE\s]*+")
_LONGEST_LINE = 1000  # characters of a line of a drill file, and of Gerber text that is no command
_LONGEST_BLOCK = 100_000  # characters of a block of a macro: an outline of 5000 corners (section 4.5.1.6) fits
_MOST_VERTICES = 1000  # of a regular polygon; the specification allows 12


@contextlib.contextmanager
def open_board(path: Path, layers: Mapping[str, str] | None) -> Iterator[LayerStack]:
    """Open a folder or a ZIP of Gerber files and determine their layers; `parsed` reads one layer.

    Parameters
    ----------
    path : pathlib.Path
    layers : mapping of str to str, optional
        As in `gpuvision.matching.artwork.artwork.read_artwork`.

    Yields
    ------
    gerbonara.LayerStack
        With files that are not parsed yet.

    Raises
    ------
    FileNotFoundError
        There is no such folder or file.
    ReadError
        The layers cannot be determined, the ZIP is damaged, or the board exceeds a limit of `FileLimits`.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder or ZIP of Gerber files")
    hint = "name its files with layers"
    with _unpacked(path) as place:
        _check_files(place, path)
        with warnings.catch_warnings(), reading(path, "board", hint=hint):
            warnings.simplefilter("ignore")  # of old spellings, and of layers determined by contents
            how = {"overrides": dict(layers) if layers else None, "autoguess": not layers}
            try:
                stack = LayerStack.open(place, lazy=True, **how)
            except AttributeError:
                # gerbonara scales Allegro's drill files to the copper: it has to parse them at once.
                for file in _files(place):
                    with contextlib.suppress(UnicodeDecodeError):
                        check_gerber(file.read_text(), file.name)
                stack = LayerStack.open(place, **how)
        yield stack


def parsed(layer: Any) -> Any:
    """Return the objects of a layer of an opened board, after the checks of its file.

    Raises
    ------
    ReadError
        gerbonara cannot read the file, or it exceeds a limit of `FileLimits`.
    """
    read_as = layer._class if isinstance(layer, LazyCamFile) else type(layer)
    if read_as is not GerberFile and not isinstance(layer, LazyCamFile):
        return layer
    path = layer.original_path
    kind = "Gerber file" if read_as is GerberFile else "drill file"
    with warnings.catch_warnings(), reading(path.name, kind):
        warnings.simplefilter("ignore")
        text = path.read_text()
        if read_as is GerberFile:
            check_gerber(text, path.name)
            return parse_gerber(text, path)
        check_drill(text, path.name)
        routed = _CANNED_SLOT.sub(r"G00\1\nM15\nG01\2\nM16\nG05", text)
        return layer.instance if routed == text else ExcellonFile.from_string(routed, filename=path, **layer._kwargs)


@contextlib.contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """Unpack a ZIP to a temporary folder; yield the path itself where it is no ZIP."""
    if path.is_dir() or not (path.suffix.lower() == ".zip" or zipfile.is_zipfile(path)):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        with reading(path, "ZIP of Gerber files"):
            check_archive(path)
            with zipfile.ZipFile(path) as archive:
                count = len(archive.infolist())
                check_limit("max_board_files", count, f"{path}: {count} files")
                archive.extractall(folder)
        yield Path(folder)


def _files(place: Path) -> Iterator[Path]:
    if place.is_file():
        yield place
    for folder, _, names in os.walk(place):
        yield from (Path(folder, name) for name in names)


def _check_files(place: Path, path: Path) -> None:
    """Check number and sizes of the files of a board, and stop at the first file too many."""
    for count, each in enumerate(_files(place), 1):
        check_limit("max_board_files", count, f"{path}: {count} files or more, expected the files of one board")
        size = each.stat().st_size if each.is_file() else 0
        check_limit("max_board_bytes", size, f"{path}: {each.name} has {size} bytes")


def check_gerber(text: str, name: str) -> None:
    """Check a Gerber file before it is parsed.

    Parameters
    ----------
    text : str
        Content of the file.
    name : str
        Name of the file for the message.

    Raises
    ------
    ReadError
        The objects, repeated ones included, exceed `FileLimits.max_board_objects`, or the text is no Gerber.
    """
    _check_runs(text, name)
    objects = in_block = 0
    repeats = 1
    for command in _commands(text, name):
        if command.startswith("%"):
            if "SR" in command:
                found = _STEP_REPEAT.search(command)
                objects, in_block = objects + in_block * repeats, 0
                repeats = int(found[1]) * int(found[2]) if found else 1
                check_limit("max_board_objects", repeats, f"{name}: a step-and-repeat of {repeats} copies")
            if "AM" in command:
                _check_macro(command, name)
            for vertices in _POLYGON.findall(command):
                if not float(vertices) <= _MOST_VERTICES:
                    raise ReadError(f"{name}: a polygon aperture of {vertices} corners, expected 3 to 12")
        else:
            in_block += 1
    objects += in_block * repeats
    check_limit("max_board_objects", objects, f"{name}: {objects} objects")


def check_drill(text: str, name: str) -> None:
    """Check a drill file before it is parsed; parameters and errors as for `check_gerber`."""
    _check_runs(text, name)
    lines = text.splitlines()
    longest = max((len(line) for line in lines if not line.lstrip().startswith(";")), default=0)
    if longest > _LONGEST_LINE:
        raise ReadError(f"{name}: a line of {longest} characters, expected commands of a drill file")
    holes = len(lines) + sum(map(int, _REPEATED_HOLE.findall(text)))
    check_limit("max_board_objects", holes, f"{name}: {holes} holes")


def _check_runs(text: str, name: str) -> None:
    if _LONG_NUMBER.search(text) or _LONG_SPACE.search(text.strip()):
        raise ReadError(f"{name}: a number of more than 100 digits, or more than 1000 spaces, expected commands")


def _commands(text: str, name: str) -> Iterator[str]:
    """Yield the commands of a Gerber file; refuse long text that is no command."""
    at = skipped = 0
    while at < len(text):
        if found := _COMMAND.match(text, at):
            yield found[0]
            at = found.end()
            continue
        # Text before a % that closes no command, or after the last asterisk: gerbonara tries each of its characters.
        ends = [place for place in (text.find("%", at + 1), text.find("*", at + 1)) if place >= 0]
        end = min(ends, default=len(text))
        skipped += len(text[at:end].strip())
        at = end
        if skipped > _LONGEST_LINE:
            raise ReadError(f"{name}: {skipped} characters or more that are no command, expected Gerber")


def _check_macro(command: str, name: str) -> None:
    """Check that the blocks of an aperture macro are short expressions of numbers and variables."""
    for macro in re.findall(r"AM([^%]*)", command):
        for block in macro.split("*")[1:]:
            if block.lstrip().startswith("0 "):
                continue
            if len(block) > _LONGEST_BLOCK or not _MACRO_BLOCK.fullmatch(block):
                raise ReadError(f"{name}: an aperture macro with {block[:40]!r}, expected numbers and variables")
