"""Two sensors over one sheet of light: files and pictures of the pair."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from error_maps import errors_of
from gpuvision.simulation.errors.sensor_fusion import SensorFusion
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
