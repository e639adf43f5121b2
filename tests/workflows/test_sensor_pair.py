"""Two sensors over one sheet of light: files and pictures of the pair."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from matplotlib.figure import Figure

from error_maps import errors_of
from gpuvision.cli.simulate import Rule, _run
from gpuvision.simulation.errors.sensor_fusion import SensorFusion
from gpuvision.workflows import sensor_pair, simulating
from gpuvision.workflows.sensor_pair import SensorPair


def test_pictures_of_two_sensors_have_one_scale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first sensor errs by 0.9 mm, the second one by 0.3 mm, both together by 0.1 mm: the scale is 1 mm."""
    written: list[tuple[Path, dict[str, Any]]] = []
    errors = {
        name: errors_of(np.full((5, 7), error))
        for name, error in (("first", 0.9e-3), ("second", -0.3e-3), ("both", 1e-4))
    }
    first, second = (
        SimpleNamespace(
            attribution=errors[name],
            moves_backward=False,
            write=lambda folder, **how: written.append((folder, how)),
        )
        for name in ("first", "second")
    )
    pair = SensorPair(first=first, second=second, errors=errors, fusion=SensorFusion(), limit=15e-6)
    figures: list[Figure] = []
    save = Figure.savefig

    def note(figure: Figure, *args: Any, **how: Any) -> None:
        figures.append(figure)
        save(figure, *args, **how)

    monkeypatch.setattr(Figure, "savefig", note)
    pair.write(tmp_path)
    assert pair.picture_scale == (pytest.approx(1e-3), 15e-6)
    ((folder, how),) = written
    assert folder == tmp_path / "second"
    assert how["scale"] == pair.picture_scale
    assert figures[0].axes[0].images[0].get_clim() == pytest.approx((-1.0, 1.0))
    assert figures[0].axes[1].get_ylabel().startswith("height read minus true height [mm]")
    assert json.loads((tmp_path / "both" / "report.json").read_text())["limit"] == 15e-6


def test_summary_and_report_of_a_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of the candidates in percent, in the order of their rank."""

    class Candidate(NamedTuple):
        name: str
        failed_fraction: float
        spurious_fraction: float

    ranked = [Candidate("both", 0.0625, 0.0125), Candidate("second", 0.25, 0.5)]
    asked: list[Any] = []
    monkeypatch.setattr(sensor_pair, "rank_candidates", lambda *given: asked.append(given) or ranked)
    drawn: list[Any] = []
    for name in ("draw_errors", "draw_causes"):
        monkeypatch.setattr(
            sensor_pair, name, lambda path, *given, name=name, **how: drawn.append((name, path.name, given, how))
        )
    errors = {name: SimpleNamespace(summary=lambda limit, name=name: [name, limit]) for name in ("first", "both")}
    simulated: Any = SimpleNamespace(attribution="one", moves_backward=True, write=lambda *_, **__: None)
    monkeypatch.setattr(sensor_pair.PictureScale, "of", lambda parts, limit: (tuple(parts), limit))
    pair = SensorPair(first=simulated, second=simulated, errors=errors, fusion=SensorFusion(), limit=15e-6)
    assert pair.summary() == (
        "surface samples read within 15 µm: both 93.8 % (1.2 % spurious), second 75.0 % (50.0 % spurious)"
    )
    pair.write(tmp_path)
    assert asked == [(errors, 15e-6)] * 2
    scale = (("one", "one", errors["both"]), 15e-6)
    assert drawn == [
        (f"draw_{name}", f"{name}.png", (errors["both"], "Both sensors", scale), {"backward": True})
        for name in ("errors", "causes")
    ]
    assert json.loads((tmp_path / "both" / "report.json").read_text()) == {
        "rule": SensorFusion().rule,
        "limit": 15e-6,
        "ranking": [each._asdict() for each in ranked],
        "errors": {"first": ["first", 15e-6], "both": ["both", 15e-6]},
    }


def test_the_fusion_interpolates_over_a_missing_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """Largest gap 2.5 median distances of the first sensor's samples; the larger limit; the order of the sensors."""
    asked: list[Any] = []

    def attribute(*given: Any, **how: Any) -> dict[str, Any]:
        asked.append((given, how))
        return {"both": None}

    monkeypatch.setattr(sensor_pair, "attribute_pair_errors", attribute)
    task = SimpleNamespace(transports=np.arange(3.0))
    g = np.array([[0.0, 1.0, 3.0, 6.0, np.nan], [0.0, -2.0, -7.0, np.nan, 0.0]]) * 1e-3
    first, second, blind = (
        SimpleNamespace(task=task, limit=limit, attribution=SimpleNamespace(truth=SimpleNamespace(g=each)))
        for limit, each in ((15e-6, g), (40e-6, 7.0 * g), (5e-6, g * np.nan))
    )
    fusion = SensorFusion()
    given: Any = (first, second)
    pair = SensorPair.fuse(*given, fusion)
    # Distances of 1, 2, 3, 2 and 5 mm: the median is 2 mm.
    assert asked[-1] == ((first.attribution, second.attribution, fusion), {"max_gap": pytest.approx(5e-3)})
    assert (pair.first, pair.second, pair.fusion, pair.limit) == (first, second, fusion, 40e-6)
    assert pair.errors == {"both": None}
    SensorPair.fuse(*given[::-1], fusion, limits=sensor_pair.FusionLimits(max_gap=1.5))
    assert asked[-1] == ((second.attribution, first.attribution, fusion), {"max_gap": pytest.approx(21e-3)})
    given = (blind, first)
    SensorPair.fuse(*given, fusion)
    assert asked[-1][1] == {"max_gap": np.inf}
    other: Any = SimpleNamespace(task=SimpleNamespace(transports=np.arange(4.0)))
    with pytest.raises(ValueError, match="the two sensors' profiles are not the same"):
        SensorPair.fuse(given[1], other, fusion)


@pytest.mark.parametrize("has_second", [False, True])
def test_the_command_simulates_both_sensors_and_fuses_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, has_second: bool
) -> None:
    """The first sensor is the first one of the pair; its pictures have the scale of the pair."""
    calls: list[Any] = []

    def simulate(task: Any, out: Path, *, progress: Any, **made: Any) -> Any:
        assert (out, made) == (tmp_path, {"seed": 7})
        return SimpleNamespace(
            task=task,
            summary=lambda: f"summary of {task}",
            write=lambda *given, **how: calls.append((task, given, how)),
        )

    def fuse(first: Any, second: Any, fusion: SensorFusion) -> Any:
        calls.append((first.task, second.task, fusion.rule))
        return SimpleNamespace(
            write=lambda *given, **how: calls.append(("pair", given, how)), summary=lambda: "of both", picture_scale=5.0
        )

    monkeypatch.setattr(simulating, "simulate", simulate)
    monkeypatch.setattr(SensorPair, "fuse", fuse)
    given: Any = ["one", "two"] if has_second else ["one"]
    done, summary = _run(given, Rule.mean, tmp_path, {"seed": 7}, "simulating", ["part.stl"], True)
    how = {"inputs": ["part.stl"], "overwrite": True}
    both = [("one", "two", "mean"), ("pair", (tmp_path,), how)]
    assert calls == [*(both if has_second else []), ("one", (tmp_path,), how | {"scale": 5.0 if has_second else None})]
    assert [each.task for each in done] == ["one", "two"][: 1 + has_second]
    assert summary == "summary of one" + ("\nof both" if has_second else "")
