"""Files of a board: checks of their sizes before gerbonara reads them, and the layers that they hold.

gerbonara builds every repeated object in memory, and its regular expressions take a time that grows with the square of
the length of a number or of text that is no command. The checks here take a time proportional to the file.
"""

from __future__ import annotations

import contextlib
import glob
import io
import itertools
import operator
import os
import re
import shlex
import tempfile
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gerbonara import LayerStack
from gerbonara.cam import LazyCamFile
from gerbonara.excellon import ExcellonFile
from gerbonara.layer_rules import MATCH_RULES
from gerbonara.layers import _best_match, _do_autoguess, identify_file
from gerbonara.rs274x import GerberFile

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import FileLimit, check_archive, reading
from gpuvision.host.text import printable
from gpuvision.matching.artwork.gerber_parser import MAX_BOARD_OBJECTS, parse_gerber

MAX_BOARD_FILES = FileLimit("GPUVISION_MAX_BOARD_FILES", 1000)
"""Files in the folder or ZIP file of a board. Chosen: 1000; boards have 10 to 60."""
MAX_BOARD_BYTES = FileLimit("GPUVISION_MAX_BOARD_BYTES", 1 << 28)
"""Bytes of a file of a board. Chosen: 256 MiB."""
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
_HEAD_CHARACTERS = 16384  # of a file, to determine its kind; gerbonara reads as many of a header
_MOST_NAMES = 12  # of files in a message
_KNOWN_LAYER = re.compile(
    r"(top|bottom) (copper|mask|silk|paste)|mechanical outline|drill (plated|nonplated|unknown)|inner_\w+ copper"
)
_HEADER_RULES = {name: list(rules["header regex"]) for name, rules in MATCH_RULES.items() if "header regex" in rules}


@contextlib.contextmanager
def board_folder(path: Path) -> Iterator[Path]:
    """Check the files of a board, and yield their folder: the folder itself, or the unpacked ZIP.

    Raises
    ------
    FileNotFoundError
        There is no such folder or file.
    ReadError
        The ZIP is damaged, or the board exceeds a `FileLimit`.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder or ZIP of Gerber files")
    with _unpacked(path) as place:
        _check_files(place, path)
        yield place


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
        The layers cannot be determined, the ZIP is damaged, or the board exceeds a `FileLimit`.
    """
    with board_folder(path) as place:
        yield open_layers(place, path, layers)


def open_layers(place: Path, path: Path, layers: Mapping[str, str] | None) -> LayerStack:
    """Return the layers of the files in a folder, not parsed yet.

    Parameters
    ----------
    place, path : pathlib.Path
        Folder of the files, and the name of the board in messages.
    layers : mapping of str to str, optional
        As in `gpuvision.matching.artwork.artwork.read_artwork`.

    Raises
    ------
    ReadError
        The layers cannot be determined; the message proposes ``--layers``.
    """
    # gerbonara derives the name of the board from the names of the files, and fails at names of one letter.
    how: dict[str, Any] = {"board_name": path.name}
    how |= {"overrides": dict(layers) if layers else None, "autoguess": not layers}
    with warnings.catch_warnings(), reading(path, "board", hint="name its files with layers"):
        warnings.simplefilter("ignore")  # of old spellings, and of layers determined by contents
        _restore_layer_rules()
        # gerbonara prints the files of Allegro's boards.
        with contextlib.redirect_stdout(io.StringIO()):
            try:
                return LayerStack.open(place, lazy=True, **how)
            except (ValueError, SystemError, UnboundLocalError) as problem:
                if layers or isinstance(problem, UnicodeDecodeError):
                    raise
                raise ReadError(f"{path}: not a readable board: {propose_layers(board_layer_files(place))}") from None
            except AttributeError:
                # gerbonara scales Allegro's drill files to the copper: it has to parse them at once.
                for file in _files(place):
                    with contextlib.suppress(UnicodeDecodeError):
                        check_gerber(file.read_text(), file.name)
                return LayerStack.open(place, **how)


def _restore_layer_rules() -> None:
    """Restore gerbonara's rules of file headers, which it removes when it opens the first board of a process."""
    for generator, rules in _HEADER_RULES.items():
        MATCH_RULES[generator]["header regex"] = list(rules)


def board_layer_files(place: Path) -> list[Path]:
    """Return the files with the content of a Gerber or drill file, sorted."""
    return sorted(each for each in _files(place) if each.is_file() and identify_file(_head(each)) is not None)


def _head(path: Path) -> str:
    with path.open(errors="ignore") as file:
        return file.read(_HEAD_CHARACTERS)


def unrecognised_files(stack: LayerStack, place: Path) -> list[str]:
    """Return the names of Gerber and drill files that are no layer of an opened board, sorted."""
    graphic = [layer for (side, _), layer in stack.graphic_layers.items() if side != "unknown"]
    used = {each.original_path for each in (*graphic, stack.drill_pth, stack.drill_npth, *stack._drill_layers) if each}
    return sorted(each.name for each in board_layer_files(place) if each not in used)


def propose_layers(files: list[Path]) -> str:
    """Return why the layers of files are uncertain, with the options ``--layers`` for the layers that names suggest.

    Parameters
    ----------
    files
        Gerber and drill files of a folder.
    """
    if not files:
        return "no file with the content of a Gerber or drill file; name its files with layers"
    guessed = _guess_layers(files)
    doubled = {layer: found for layer, found in guessed.items() if len(found) > 1 and not layer.startswith("drill")}
    if doubled:
        layer = "top copper" if "top copper" in doubled else min(doubled)
        boards = doubled[layer]
        folders = sorted({str(each.parent.relative_to(_common_folder(boards))) for each in boards})
        which = f"two boards in one folder or more ({layer}: {', '.join(each.name for each in boards)}); "
        if len(folders) > 1:
            return f"{which}give one of its folders: {', '.join(folders)}"
        line = _layer_options({layer: _of_board(found, boards) for layer, found in guessed.items()})
        return f"{which}name the files of one with layers, for the board of {boards[0].name}: {line}"
    line = _layer_options(guessed)
    known = {each for found in guessed.values() for each in found}
    others = [each.name for each in files if each not in known]
    rest = f" (layers unknown: {_some_names(others)})" if others else ""
    example = line or f"--layers {shlex.quote(f'{glob.escape(files[0].name)}=top copper')}"
    names = "the name of the file does" if len(files) == 1 else f"the names of {len(files)} files do"
    return f"{names} not determine the layers; name its files with layers: {example}{rest}"


def _guess_layers(files: list[Path]) -> dict[str, list[Path]]:
    """Return the files of each layer that their names suggest."""
    _restore_layer_rules()
    by_program = _best_match(files)[1]
    by_words: dict[str, list[Path]] = {}
    with contextlib.suppress(UnboundLocalError):  # gerbonara 1.5 fails where a name begins with one letter and a dot
        by_words = _do_autoguess(files)
    guess = by_program if len(by_program) >= len(by_words) else by_words
    return {layer: sorted(found) for layer, found in sorted(guess.items()) if _KNOWN_LAYER.fullmatch(layer)}


def _of_board(files: list[Path], boards: list[Path]) -> list[Path]:
    """Return the files whose names begin like the first of several boards, more than like another one."""

    def shared(file: Path, board: Path) -> int:
        return sum(itertools.accumulate((a == b for a, b in zip(file.name, board.name, strict=False)), operator.and_))

    return [each for each in files if shared(each, boards[0]) == max(shared(each, other) for other in boards)][:1]


def _common_folder(files: list[Path]) -> Path:
    return Path(os.path.commonpath([each.parent for each in files]))


def _layer_options(layers: Mapping[str, list[Path]]) -> str:
    names = [f"{glob.escape(each.name)}={layer}" for layer, found in layers.items() for each in found]
    return " ".join(f"--layers {shlex.quote(each)}" for each in names)


def _some_names(names: list[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(map(printable, names[:_MOST_NAMES])) + more


def layer_warnings(stack: LayerStack, place: Path, side: str, layers: Mapping[str, str] | None) -> tuple[str, ...]:
    """Return warnings of a missing mask, and of files that are no layer.

    Parameters
    ----------
    stack, place
        Layers, and the folder of their files.
    side
        "top" or "bottom".
    layers
        Layers as the user named them: then all other files are ignored as intended. None: gerbonara recognised them.
    """
    found = []
    if (side, "mask") not in stack.graphic_layers:
        found.append(
            f"no solder mask on the {side} side: all of its copper counts as bare; name the file of the mask with "
            f"layers ('FILE={side} mask'), if there is one"
        )
    others = [] if layers else unrecognised_files(stack, place)
    if others:
        found.append(f"files that are not recognised as a layer: {_some_names(others)}; name them with layers")
    return tuple(found)


def parsed(layer: Any) -> Any:
    """Return the objects of a layer of an opened board, after the checks of its file.

    Raises
    ------
    ReadError
        gerbonara cannot read the file, or it exceeds a `FileLimit`.
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
                MAX_BOARD_FILES.check(count, f"{path}: {count} files")
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
        MAX_BOARD_FILES.check(count, f"{path}: {count} files or more, expected the files of one board")
        size = each.stat().st_size if each.is_file() else 0
        MAX_BOARD_BYTES.check(size, f"{path}: {each.name} has {size} bytes")


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
        The objects, repeated ones included, exceed `MAX_BOARD_OBJECTS`, or the text is no Gerber.
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
                MAX_BOARD_OBJECTS.check(repeats, f"{name}: a step-and-repeat of {repeats} copies")
            if "AM" in command:
                _check_macro(command, name)
            for vertices in _POLYGON.findall(command):
                if not float(vertices) <= _MOST_VERTICES:
                    raise ReadError(f"{name}: a polygon aperture of {vertices} corners, expected 3 to 12")
        else:
            in_block += 1
    objects += in_block * repeats
    MAX_BOARD_OBJECTS.check(objects, f"{name}: {objects} objects")


def check_drill(text: str, name: str) -> None:
    """Check a drill file before it is parsed; parameters and errors as for `check_gerber`."""
    _check_runs(text, name)
    lines = text.splitlines()
    longest = max((len(line) for line in lines if not line.lstrip().startswith(";")), default=0)
    if longest > _LONGEST_LINE:
        raise ReadError(f"{name}: a line of {longest} characters, expected commands of a drill file")
    holes = len(lines) + sum(map(int, _REPEATED_HOLE.findall(text)))
    MAX_BOARD_OBJECTS.check(holes, f"{name}: {holes} holes")


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
