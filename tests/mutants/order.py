"""Plugin of pytest that runs the tests of a list first, in the order of the list."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

LIST = "build/order.txt"  # node identifiers, one a line


@pytest.hookimpl(wrapper=True, tryfirst=True)  # after the tier's selection, which depends on the order
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Iterator[None]:
    """Sort the tests."""
    yield
    place = {name: number for number, name in enumerate(Path(LIST).read_text().splitlines())}
    items.sort(key=lambda item: place.get(item.nodeid, len(place)))
