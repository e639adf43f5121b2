"""Cache of artwork in the user's cache folder, so that a board is parsed once.

An entry is named by a digest of all that the artwork depends on: the files of the board, the parameters, the source
files of this package, and the version of gerbonara. It holds a digest of its content and an NPZ file without pickles.
Entries that another user owns or may write, or whose content has another digest, are ignored.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import os
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host.cache import cache_folder, is_private, read_private_bytes, write_private_bytes
from gpuvision.host.reading import MAX_UNPACKED_BYTES
from gpuvision.matching.artwork.board_artwork import Artwork, Holes, Pad
from gpuvision.matching.artwork.board_files import MAX_BOARD_BYTES, MAX_BOARD_FILES
from gpuvision.matching.artwork.edges import MAX_BOARD_COMPARISONS, BoardEdges
from gpuvision.matching.artwork.gerber_parser import MAX_BOARD_OBJECTS
from gpuvision.matching.artwork.shapes import MAX_BOARD_SIZE, Float64, Shape

_LIMITS = (
    MAX_UNPACKED_BYTES,
    MAX_BOARD_FILES,
    MAX_BOARD_BYTES,
    MAX_BOARD_OBJECTS,
    MAX_BOARD_SIZE,
    MAX_BOARD_COMPARISONS,
)
_DIGEST_BYTES = hashlib.sha256().digest_size
_USES = ("copper", "mask", "silk")
_PAD_WORDS = ("role", "shape", "function", "net", "part", "pin")
_PAD_NUMBERS = ("angle", "hole", "opening")
# Chosen: the largest board of the tests takes 2 MiB, and 256 MiB hold more boards than a machine sees in a year.
_MAX_BYTES = 1 << 28


def artwork_key(place: Path, parameters: Sequence[object]) -> str:
    """Return the name of the entry for the files of a folder and parameters of `read_artwork`."""
    limits = [each.value for each in _LIMITS]
    digest = hashlib.sha256(repr([_code_digest(), limits, *parameters]).encode())
    for path in sorted(each for each in place.rglob("*") if each.is_file()):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(place).as_posix()}\0{len(content)}\0".encode(errors="surrogateescape"))
        digest.update(content)
    return digest.hexdigest()


@functools.cache
def _code_digest() -> str:
    """Return a digest of the source files of this package and of the versions of gerbonara and NumPy."""
    digest = hashlib.sha256(f"{version('gerbonara')} {np.__version__}".encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def load_artwork(key: str) -> Artwork | None:
    """Return the artwork of an entry; None if it is missing, not private, or damaged."""
    path = _entry(key)
    if not is_private(path.parent):
        return None
    content = read_private_bytes(path, _MAX_BYTES)
    if content is None or hashlib.sha256(content[_DIGEST_BYTES:]).digest() != content[:_DIGEST_BYTES]:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # the entries that were not used for the longest time are removed first
    return _unpacked(content[_DIGEST_BYTES:])


def store_artwork(key: str, artwork: Artwork) -> None:
    """Write an entry, whole or not at all, and remove the oldest entries beyond the size of the cache.

    A folder that cannot be written, or a full disk, is no error.
    """
    content = _packed(artwork)
    if len(content) > _MAX_BYTES // 4:
        return
    path = _entry(key)
    with contextlib.suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if is_private(path.parent):
            if path.is_symlink():  # a file is written through a link
                path.unlink()
            write_private_bytes(path, hashlib.sha256(content).digest() + content)
            _remove_oldest(path.parent)


def _entry(key: str) -> Path:
    return cache_folder() / "artwork" / f"{key}.bin"


def _remove_oldest(folder: Path) -> None:
    entries = sorted(((each.stat(), each) for each in folder.glob("*.bin")), key=lambda pair: -pair[0].st_mtime)
    total = 0
    for info, path in entries:
        total += info.st_size
        if total > _MAX_BYTES:
            path.unlink(missing_ok=True)


def _packed(artwork: Artwork) -> bytes:
    arrays: dict[str, Any] = {"bounds": artwork.bounds}
    for use in _USES:
        shapes: tuple[Shape, ...] = getattr(artwork, use)
        _add_outlines(arrays, use, [each.outline for each in shapes])
        _add_outlines(arrays, f"{use}_holes", [hole for each in shapes for hole in each.holes])
        arrays[f"{use}_hole_counts"] = np.array([len(each.holes) for each in shapes], np.int64)
        arrays[f"{use}_dark"] = np.array([each.dark for each in shapes], np.bool_)
    arrays |= {f"holes_{name}": value for name, value in artwork.holes._asdict().items()}
    arrays |= {f"edges_{name}": value for name, value in artwork.edges._asdict().items()}
    pads = artwork.pads
    _add_outlines(arrays, "pad", [each.outline for each in pads])
    arrays["pad_centre"] = np.array([each.centre for each in pads]).reshape(-1, 2)
    arrays["pad_size"] = np.array([each.size for each in pads]).reshape(-1, 2)
    arrays["pad_numbers"] = np.array([[getattr(each, name) for name in _PAD_NUMBERS] for each in pads]).reshape(-1, 3)
    words = {
        "side": artwork.side,
        "warnings": artwork.warnings,
        "pads": [[getattr(each, name) for name in _PAD_WORDS] for each in pads],
    }
    arrays["words"] = np.frombuffer(json.dumps(words).encode(), np.uint8)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _add_outlines(arrays: dict[str, Any], name: str, outlines: list[Float64]) -> None:
    arrays[f"{name}_points"] = np.concatenate([np.empty((0, 2)), *outlines])
    arrays[f"{name}_counts"] = np.array([len(each) for each in outlines], np.int64)


def _outlines(arrays: dict[str, npt.NDArray[Any]], name: str) -> list[Float64]:
    return np.split(arrays[f"{name}_points"], np.cumsum(arrays[f"{name}_counts"]))[:-1]


def _unpacked(content: bytes) -> Artwork:
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    words = json.loads(arrays["words"].tobytes())
    layers: dict[str, Any] = {}
    for use in _USES:
        holes = iter(_outlines(arrays, f"{use}_holes"))
        layers[use] = tuple(
            Shape(outline, bool(dark), tuple(next(holes) for _ in range(count)))
            for outline, dark, count in zip(
                _outlines(arrays, use), arrays[f"{use}_dark"], arrays[f"{use}_hole_counts"], strict=True
            )
        )
    rows = zip(
        _outlines(arrays, "pad"),
        arrays["pad_centre"],
        arrays["pad_size"],
        arrays["pad_numbers"].tolist(),
        words["pads"],
        strict=True,
    )
    pads = tuple(
        Pad(
            outline=outline,
            centre=centre,
            size=size,
            **dict(zip(_PAD_NUMBERS, numbers, strict=True)),
            **dict(zip(_PAD_WORDS, names, strict=True)),
        )
        for outline, centre, size, numbers, names in rows
    )
    return Artwork(
        side=words["side"],
        holes=Holes(*(arrays[f"holes_{name}"] for name in Holes._fields)),
        pads=pads,
        edges=BoardEdges(*(arrays[f"edges_{name}"] for name in BoardEdges._fields)),
        bounds=arrays["bounds"],
        warnings=tuple(words["warnings"]),
        **layers,
    )
