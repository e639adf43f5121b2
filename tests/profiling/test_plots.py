from __future__ import annotations

import cv2
from matplotlib.figure import Figure

from gpuvision.profiling.plots import draw_plots
from gpuvision.profiling.run import Row


def row(case: str, seconds: float, **metadata: object) -> Row:
    return Row("any", case, "pocl", seconds, "gpuvision", "1", 2.0 * seconds, 2.0, 1e-6, None, metadata=metadata)


def test_what_grows_and_what_accuracy_costs_is_drawn(tmp_path):
    rows = [row(f"growth/segments-x{k}", 1e-3 * k) for k in (1, 2, 4)]
    rows += [row(f"growth/x{k}", 1e-3 * k, tolerance=5e-6) for k in (1, 2)]
    rows += [row(f"groove/{t}", 1e-3, tolerance=t) for t in (0.0, 1e-6, 1e-5)]
    rows += [row("whole/16", 1e-3)]
    assert draw_plots(tmp_path, rows) == ["growth.png", "tolerance.png"]
    for name in ("growth.png", "tolerance.png"):
        picture = cv2.imread(str(tmp_path / name))
        assert picture.shape[1] > 1000
        assert picture.std() > 5


def test_growth_begins_at_its_base(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: drawn.update(lines=self.axes[0].lines))
    rows = [row("board/1", 1e-3), row("growth/triangles-x4", 2e-3, base="board/1"), row("board/2", 5e-3)]
    assert draw_plots(tmp_path, rows) == ["growth.png"]
    (line,) = (each for each in drawn["lines"] if each.get_label() == "triangles")
    assert line.get_xydata().tolist() == [[1.0, 1.0], [4.0, 2.0]]


def test_nothing_is_drawn_of_other_rows(tmp_path):
    assert draw_plots(tmp_path, [row("whole/16", 1e-3)]) == []
    assert not list(tmp_path.iterdir())
