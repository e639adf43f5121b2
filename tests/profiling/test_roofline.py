"""Roofline: limits and points of the picture."""

from __future__ import annotations

from typing import Any

import cv2
import pytest
from matplotlib.figure import Figure

from gpuvision.profiling import ceiling
from gpuvision.profiling.plots import draw_plots
from gpuvision.profiling.roofline import points, roof, share
from gpuvision.profiling.run import Row

DEVICES = {"pocl": {"gflops": 100.0, "bandwidths": {str(1 << 20): 50e9, str(192 << 20): 10e9}}}


def row(
    operation: str, case: str, flops: float | None, moved: int | None, seconds: float = 1e-3, launched: str = ""
) -> Row:
    counts: dict[str, Any] = {"launched": launched, "flops": flops, "bytes": moved}
    return Row(operation, case, "pocl", seconds, "numba", "1", 1e-3, 1.0, 1e-6, None, **counts)


def test_the_roof_is_the_bandwidth_up_to_the_rate() -> None:
    assert roof(0.5, 10e9, 100e9) == 5e9
    assert roof(50.0, 10e9, 100e9) == 100e9


def test_an_operation_is_shown_by_its_case_with_the_largest_traffic() -> None:
    rows = [row("psd", "small", 4e3, 100), row("psd", "large", 4e6, 10**6), row("line", "whole", None, 10)]
    assert {name: each.case for name, each in points(rows).items()} == {"psd": "large"}


def test_operations_of_one_benchmark_have_a_point_each() -> None:
    rows = [row("bvh", each, 1e6, 10, launched=name) for each, name in (("any", "AnyHit"), ("closest", "ClosestHit"))]
    assert {name: each.case for name, each in points(rows).items()} == {"AnyHit": "any", "ClosestHit": "closest"}


@pytest.mark.parametrize(
    ("flops", "moved", "expected"),
    [
        (1e7, 10**7, 1.0),  # 1 FLOP/B times 10 GB/s, the rate of the smallest copy that holds 1e7 bytes
        (1e4, 10**5, 2e-3),  # 0.1 FLOP/B times 50 GB/s
        (1e4, 10**9, 100.0),  # more than the largest copy: 1e-5 FLOP/B times 10 GB/s
        (5e7, 10**3, 0.5),  # arithmetic
    ],
)
def test_the_share_of_the_roof(flops: float, moved: int, expected: float) -> None:
    assert share(row("psd", "1e6", flops, moved), DEVICES["pocl"]) == pytest.approx(expected)


def test_the_picture_has_the_points_and_the_roofs(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, Any] = {}
    rows = [row("psd", "1e6", 4e6, 10**7, 2e-3), row("points", "1e6", 1e8, 10**6)]
    with monkeypatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda self, *_, **__: drawn.update(lines=self.axes[0].lines))
        assert draw_plots(tmp_path, rows, {"devices": DEVICES}) == ["roofline.png"]
    lines = {line.get_label(): line.get_xydata() for line in drawn["lines"]}
    assert lines["psd 1e6: 50%"].tolist() == [[0.4, 2.0]]
    assert lines["points 1e6: 100%"].tolist() == [[100.0, 100.0]]
    assert lines["1 MiB: 50 GB/s"][:, 1].max() == 100.0
    slow = lines["192 MiB: 10 GB/s"]
    assert slow[0].tolist() == pytest.approx([0.05, 0.5])


@pytest.mark.rendered
def test_the_picture_is_drawn(tmp_path: Any) -> None:
    assert draw_plots(tmp_path, [row("psd", "1e6", 4e6, 10**7)], {"devices": DEVICES}) == ["roofline.png"]
    assert cv2.imread(str(tmp_path / "roofline.png")).std() > 5


def test_the_copy_has_a_rate_for_each_size(device: Any) -> None:
    rates = ceiling.bandwidths(device)
    assert tuple(rates) == ceiling.SIZES
    assert all(1e7 < rate < 1e14 for rate in rates.values())
