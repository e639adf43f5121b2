"""Search in Sphinx's ``searchindex.js`` with the ranking of ``searchtools.js`` of Sphinx 9."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from sphinx.search.en import SearchEnglish

_TITLE, _PARTIAL_TITLE, _TERM, _PARTIAL_TERM = 15.0, 7.0, 5.0, 2.0
_NAME, _PART_OF_NAME = 11.0, 6.0
_PRIORITY = {0: 15.0, 1: 5.0, 2: -5.0}


class SearchIndex:
    """Search index of a build.

    Parameters
    ----------
    path
        The file ``searchindex.js``.
    """

    def __init__(self, path: Path) -> None:
        text = path.read_text(encoding="utf-8")
        found: Any = json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))
        self._index = found
        self.pages: list[str] = found["docnames"]
        self._language = SearchEnglish({})

    def search(self, query: str) -> list[str]:
        """Return the pages that the search finds for a query, best first."""
        text = query.lower().strip()
        scores: dict[str, float] = {}
        minor: dict[str, float] = {}
        for page, score in (*self._in_titles(text), *self._in_objects(text), *self._in_terms(text)):
            scores[page] = max(score, scores.get(page, -100.0))
        for page, score, is_main in self._in_entries(text):
            table = scores if is_main else minor
            table[page] = max(score, table.get(page, -100.0))
        ranked = sorted(scores, key=lambda page: (-scores[page], page))
        return ranked + sorted((page for page in minor if page not in scores), key=lambda page: (-minor[page], page))

    def _in_titles(self, asked: str) -> Iterator[tuple[str, float]]:
        for title, places in self._index["alltitles"].items():
            if asked in title.lower().strip() and len(asked) >= len(title) / 2:
                for page, _ in places:
                    is_page = self._index["titles"][page] == title
                    yield self.pages[page], round(_TITLE * len(asked) / len(title)) + is_page

    def _in_entries(self, asked: str) -> Iterator[tuple[str, float, bool]]:
        for entry, places in self._index["indexentries"].items():
            if asked in entry and len(asked) >= len(entry) / 2:
                for page, _, is_main in places:
                    yield self.pages[page], round(100 * len(asked) / len(entry)), bool(is_main)

    def _in_objects(self, asked: str) -> Iterator[tuple[str, float]]:
        words = re.findall(r"\w+", asked)
        for prefix, found in self._index["objects"].items():
            for page, kind, priority, _, name in found:
                full = f"{prefix}.{name}" if prefix else name
                last = full.lower().rpartition(".")[2]
                described = f"{prefix} {name} {self._index['objnames'][str(kind)][2]} {self._index['titles'][page]}"
                for word in words:
                    others = [each for each in words if each != word]
                    if word not in full.lower() or any(each not in described.lower() for each in others):
                        continue
                    score = _NAME if word in (last, full.lower()) else _PART_OF_NAME if word in last else 0.0
                    yield self.pages[page], score + _PRIORITY.get(priority, 0.0)

    def _in_terms(self, asked: str) -> Iterator[tuple[str, float]]:
        language = self._language
        words = {language.stem(word) for word in re.findall(r"\w+", asked) if word not in language.stopwords}
        found: dict[int, dict[str, float]] = defaultdict(dict)
        for word in words:
            for table, whole, part in (("terms", _TERM, _PARTIAL_TERM), ("titleterms", _TITLE, _PARTIAL_TITLE)):
                for term, score in _matching(word, self._index[table], whole, part):
                    for page in _listed(self._index[table][term]):
                        found[page][word] = score
        longer = sum(len(word) > 2 for word in words)
        for page, matched in found.items():
            if len(matched) in (len(words), longer):
                yield self.pages[page], max(matched.values())


def _matching(word: str, table: dict[str, Any], whole: float, part: float) -> Iterator[tuple[str, float]]:
    if word in table:
        yield word, whole
    elif len(word) > 2:
        yield from ((term, part) for term in table if word in term)


def _listed(pages: int | Iterable[int]) -> Iterable[int]:
    return [pages] if isinstance(pages, int) else pages
