"""Figures that the pictures of a test draw."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Figure]]:
    """Figures that are saved from now on; their texts must lie on the page, and their colour bars beside the panes."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **how: figures.append(figure))
    yield figures
    for figure in figures:
        for text in figure.texts:
            assert all(0.0 <= each <= 1.0 for each in text.get_position()), f"{text.get_text()!r} is not on the page"
        panes: list[Any] = list(figure.axes)
        for axes in panes:
            for each in axes.collections:
                assert not isinstance(each, Quiver) or 5e-4 < each.width < 5e-3, "arrows are not thin lines"
            if hasattr(axes, "_colorbar"):  # a colour bar
                heights = {pane.get_position(original=True).height for pane in panes if pane is not axes}
                assert any(0.6 < axes.get_position(original=True).height / each <= 1.0 for each in heights), (
                    "a bar beside no pane"
                )
