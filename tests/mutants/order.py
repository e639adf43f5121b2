"""Plugin of pytest that runs the tests of a list first, in the order of the list."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

LIST = "build/order.txt"  # node identifiers or test files, one a line


@pytest.hookimpl(wrapper=True, tryfirst=True)  # after the tier's selection, which depends on the order
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Iterator[None]:
    """Sort the tests."""
    yield
    place = {name: number for number, name in enumerate(Path(LIST).read_text().splitlines())}

    def place_of(item: pytest.Item) -> int:
        return place.get(item.nodeid, place.get(item.nodeid.partition("::")[0], len(place)))

    items.sort(key=place_of)
