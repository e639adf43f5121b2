"""README and documentation pages: their Python blocks run, and their commands exist."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from docs_inputs import INPUTS
from gpuvision.cli.main import application

ROOT = Path(__file__).resolve().parents[2]
GENERATED = {"gallery", "api", "commands", "runs"}
_FENCED = re.compile(r"^( *`{3,})([^`\n]*)\n(.*?)^\1$", re.MULTILINE | re.DOTALL)


def _pages() -> list[str]:
    pages = [path.relative_to(ROOT) for path in sorted((ROOT / "docs").rglob("*.md"))]
    return ["README.md", *(page.as_posix() for page in pages if not GENERATED & set(page.parts))]


def _python_of(page: str) -> list[tuple[int, str]]:
    """Return the line number and text of each block of Python on a page."""
    text = (ROOT / page).read_text()
    found = _FENCED.finditer(text)
    return [(text.count("\n", 0, each.start(3)) + 1, each[3]) for each in found if each[2].strip() == "python"]


# A page with the operations of another page, for which other kernels are compiled, and pages whose calibration and
# plans the tests of workflows run.
SLOW = {
    "docs/tutorials/first_pose.md",
    "docs/guides/calibrate_sensor.md",
    "docs/guides/plan_location.md",
    "docs/guides/plan_placement.md",
    "docs/guides/plan_scan.md",
    "docs/guides/plan_simulation.md",
}


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[pytest.mark.slow] if page in SLOW else []) for page in _pages() if _python_of(page)],
)
def test_python_on_pages_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of a page run in order, in one namespace, in a folder with the files that the page names."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__main__", **INPUTS.get(page, lambda folder: {})(tmp_path)}
    for line, text in _python_of(page):
        padded = "\n" * (line - 1) + text  # so that a traceback names the line on the page
        exec(compile(padded, os.fspath(ROOT / page), "exec"), names)


def test_each_directive_begins_its_line() -> None:
    """A line wrapper that joins ``:::`` lines or options such as ``:link:`` would show a directive as text."""
    wrong = [
        f"{page}:{number}: {line}"
        for page in _pages()
        for number, line in enumerate((ROOT / page).read_text().splitlines(), 1)
        if (":::" in line and not re.fullmatch(r":{3,}(\{[\w-]+\}.*)?", line))
        or re.search(r"\S +:(link|width|alt):", line)
    ]
    assert wrong == []


def _commands(page: str) -> Iterator[list[str]]:
    """Yield the words of each command line of ``gpuvision`` on a page."""
    text = (ROOT / page).read_text().replace("\\\n", " ")
    for line in text.splitlines():
        found = re.match(r"    (?:[A-Z_]+=\S+ )?gpuvision ([a-z-].*)", line)
        if found:
            yield shlex.split(found[1], comments=True)
    for words in re.findall(r"`gpuvision ([a-z-][^`]*)`", text):
        yield shlex.split(words)


def test_commands_on_pages_exist() -> None:
    """Every command that a page names exists, with every option that the page names."""
    group: Any = typer.main.get_command(application())
    shared = {name for each in group.params for name in each.opts}
    wrong, seen = [], 0
    for page in _pages():
        for words in _commands(page):
            seen += 1
            options = {word.partition("=")[0] for word in words if word.startswith("-") and len(word) > 1}
            if words[0].startswith("-"):
                known = shared
            elif words[0] in group.commands:
                known = {
                    name for each in group.commands[words[0]].params for name in (*each.opts, *each.secondary_opts)
                }
            else:
                wrong.append(f"{page}: no command {words[0]!r}")
                continue
            wrong += [f"{page}: gpuvision {words[0]} has no {option}" for option in options - known - {"--help"}]
    assert wrong == []
    assert seen > 20


def test_links_between_pages_of_the_repository_exist() -> None:
    """Links of the README, which no documentation build checks."""
    text = "".join((ROOT / name).read_text() for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))
    targets = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    assert [each for each in targets if "://" not in each and not (ROOT / each).exists()] == []
    assert len(targets) > 5
