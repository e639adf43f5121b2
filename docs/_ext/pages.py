"""Helpers to write generated pages: reStructuredText tables, and files that change only when their text does."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path


def title(text: str, mark: str = "=") -> str:
    """Return a heading with its underline."""
    return f"{text}\n{mark * len(text)}\n"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, css_class: str = "") -> str:
    """Return a ``list-table``; the cells are reStructuredText of one line."""
    lines = [".. list-table::", "   :header-rows: 1"]
    if css_class:
        lines.append(f"   :class: {css_class}")
    lines.append("")
    for cells in (header, *rows):
        for position, cell in enumerate(cells):
            lines.append(f"   {'*' if position == 0 else ' '} - {cell}".rstrip())
    return "\n".join(lines) + "\n"


def toctree(names: Iterable[str], *, hidden: bool = True) -> str:
    """Return a ``toctree`` of the documents named."""
    option = "   :hidden:\n" if hidden else ""
    return f".. toctree::\n{option}\n" + "".join(f"   {name}\n" for name in names)


def write_pages(folder: Path, pages: dict[str, str]) -> None:
    """Write the pages, by file name, into a folder for these pages only.

    An unchanged page is not written, so that Sphinx does not read it again; a page of an earlier build that no longer
    exists is removed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
    for path in folder.iterdir():
        if path.name not in pages:
            path.unlink()
