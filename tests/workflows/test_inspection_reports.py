"""Rows, verdicts, warnings and reports of `PasteInspection` and `LeadInspection`: every entry."""

from __future__ import annotations

import math
from dataclasses import fields
from importlib.metadata import version
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.inspection.alignment import Alignment
from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.coplanarity import Coplanarity
from gpuvision.inspection.paste import Deposits, PasteSettings
from gpuvision.ranging.height_map import Grid
from gpuvision.workflows.inspecting_leads import LeadInspection
from gpuvision.workflows.inspecting_paste import PasteInspection, ScaleSigma, VolumeLimits

GRID = Grid(left=0.001, top=0.002, cell_x=2e-5, cell_y=3e-5, columns=40, rows=50)
GRID_REPORT = {"left": 0.001, "top": 0.002, "cell_x": 2e-5, "cell_y": 3e-5, "columns": 40, "rows": 50}
# Volumes over the expected volumes of 1, 2, ...: at a limit, beyond a limit, no volume.
STATUS = ("measured", "measured", "missing", "measured", "measured", "holes")
RATIOS = np.array([0.5, 0.4, 0.1, 1.5, 1.6, np.nan])
EXPECTED = np.arange(1.0, 7.0)


def paste(**changes: Any) -> PasteInspection:
    """Return an inspection whose numbers all differ."""
    count = len(STATUS)
    values: dict[str, Any] = {}
    for number, name in enumerate(Deposits._fields):
        values[name] = number + np.arange(1.0, count + 1.0) / 16.0
    values |= {name: number + np.arange(2.0 * count).reshape(count, 2) for number, name in enumerate(TWO_COLUMNS)}
    values |= {"names": tuple("ABCDEF"), "status": STATUS, "expected_volume": EXPECTED, "volume": RATIOS * EXPECTED}
    values |= {"noise": 2e-6, "board_scatter": 3e-6, "correlation_area": 2.5}
    return PasteInspection(
        **{
            "heights": SimpleNamespace(grid=GRID),
            "apertures": tuple(SimpleNamespace(centroid=np.array([k, -k])) for k in range(count)),
            "settings": PasteSettings(stencil=120e-6, threshold=30e-6),
            "placement": BoardPlacement(x=1e-3, y=-2e-3, theta=math.radians(0.5)),
            "alignment": None,
            "deposits": Deposits(**values | changes.pop("deposits", {})),
            "limits": VolumeLimits(),
            "scale_sigma": ScaleSigma(height=0.01, lateral=0.02),
            "files": {"height_map": "map.tiff"},
            **changes,
        }
    )


TWO_COLUMNS = ("centre", "offset", "offset_sigma")
ALIGNMENT = Alignment(
    placement=BoardPlacement(x=1e-3, y=-2e-3, theta=0.0),
    covariance=np.diag([1.0, 2.0, 3.0]),
    centre=np.array([4.0, 5.0]),
    residual_scale=6e-6,
    count=7,
    correlation=0.8,
    second_correlation=0.5,
)


def test_verdicts_of_deposits() -> None:
    assert paste().verdicts() == ("pass", "low", "low", "pass", "high", "holes")
    assert paste(limits=VolumeLimits(minimum=0.3, maximum=1.55)).verdicts()[1:5] == ("pass", "low", "pass", "high")


def test_rows_of_deposits() -> None:
    inspection = paste()
    found, d = inspection.rows(), inspection.deposits
    for k, row in enumerate(found):
        volume, mean = RATIOS[k] * EXPECTED[k], d.height_mean[k]
        expected = {
            "name": "ABCDEF"[k],
            "verdict": inspection.verdicts()[k],
            "status": STATUS[k],
            "x_m": k,
            "y_m": -k,
            "expected_area_m2": d.expected_area[k],
            "expected_volume_m3": k + 1.0,
            "volume_m3": volume,
            "volume_sigma_m3": d.volume_sigma[k],
            # Both lateral scales and the scale of the heights are factors of a volume.
            "volume_systematic_sigma_m3": volume * math.hypot(0.01, 0.02 + 0.02),
            "volume_ratio": RATIOS[k],
            "area_m2": d.area[k],
            "area_sigma_m2": d.area_sigma[k],
            "area_systematic_sigma_m2": d.area[k] * 0.04,
            "height_mean_m": mean,
            "height_mean_sigma_m": d.height_mean_sigma[k],
            "height_mean_systematic_sigma_m": mean * 0.01,
            "height_max_m": d.height_max[k],
            "height_max_sigma_m": d.height_max_sigma[k],
            "offset_x_m": d.offset[k, 0],
            "offset_y_m": d.offset[k, 1],
            "offset_x_sigma_m": d.offset_sigma[k, 0],
            "offset_y_sigma_m": d.offset_sigma[k, 1],
            "valid_fraction": d.valid[k],
        }
        assert list(row) == list(expected)
        assert row == pytest.approx(expected, nan_ok=True)
    negative = paste(deposits={"volume": -EXPECTED, "height_mean": -EXPECTED}).rows()[1]
    assert negative["volume_systematic_sigma_m3"] == pytest.approx(2.0 * math.hypot(0.01, 0.04))
    assert negative["height_mean_systematic_sigma_m"] == pytest.approx(0.02)
    assert math.isnan(paste(scale_sigma=None).rows()[0]["area_systematic_sigma_m2"])


def test_report_of_paste() -> None:
    report = paste().report()
    assert [row["name"] for row in report.pop("deposits")] == list("ABCDEF")
    assert report == {
        "gpuvision": version("gpuvision"),
        "files": {"height_map": "map.tiff"},
        "summary": (
            "6 deposits: 2 pass, 2 low, 1 high, 1 holes; volumes 10 to 160 % (median 50 %); board at 1.000 mm, "
            "-2.000 mm, 0.500 deg (given); noise 2 um"
        ),
        "warnings": [],
        "settings": {
            "stencil_m": 120e-6,
            "threshold_m": 30e-6,
            "margin_m": 50e-6,
            "ring_m": 0.2e-3,
            "reference_order": 1,
            "pad_height_m": 0.0,
            "least_valid": 0.8,
            "least_reference": 30,
        },
        "limits": {"minimum": 0.5, "maximum": 1.5},
        "scale_sigma": {"height": 0.01, "lateral": 0.02},
        "pose": {"x_m": 1e-3, "y_m": -2e-3, "theta_rad": pytest.approx(math.radians(0.5)), "side": "top"},
        "alignment": None,
        "noise_m": 2e-6,
        "board_scatter_m": 3e-6,
        "correlation_area_cells": 2.5,
        "map": GRID_REPORT,
    }
    fitted = paste(alignment=ALIGNMENT, scale_sigma=None).report()
    assert "(fitted to the paste)" in fitted["summary"]
    assert fitted["scale_sigma"] is None
    assert fitted["alignment"] == {
        "covariance": np.diag([1.0, 2.0, 3.0]).tolist(),
        "centre_m": [4.0, 5.0],
        "residual_scale_m": 6e-6,
        "deposits": 7,
        "correlation": 0.8,
        "second_correlation": 0.5,
    }


def changed(**values: Any) -> Alignment:
    return Alignment(**{**{each.name: getattr(ALIGNMENT, each.name) for each in fields(Alignment)}, **values})


@pytest.mark.parametrize(
    ("changes", "start"),
    [
        ({"alignment": changed(second_correlation=0.77)}, "the paste pattern fits about as well at another place"),
        ({"alignment": changed(correlation=0.29, second_correlation=0.0)}, "the height map correlates with the paste"),
        ({"alignment": changed(converged=False)}, "the fit of the board's place to the deposits did not converge"),
        ({"deposits": {"board_scatter": 4.1e-6}}, "the board scatters by 4.1 um about the reference surfaces, the sig"),
        ({"settings": PasteSettings(stencil=1e-4, threshold=7.9e-6)}, "the noise of the heights is 2 um, the threshol"),
    ],
)
def test_warnings_of_paste(changes: dict[str, Any], start: str) -> None:
    (text,) = paste(**changes).warnings()
    assert text.startswith(start)


def test_a_board_outside_of_the_map_is_a_warning() -> None:
    """At a wrong pose no deposit has a volume, and the noise is unknown."""
    nothing = {"status": ("outside",) * len(STATUS), "volume": np.full(len(STATUS), np.nan)}
    outside = paste(deposits={**nothing, "noise": math.nan, "board_scatter": math.nan})
    (text,) = outside.warnings()
    assert text.startswith("no deposit has a volume: check the pose of the board")
    assert outside.summary().endswith("0.500 deg (given)")


def test_no_warnings_within_the_limits() -> None:
    alignment = changed(correlation=0.31, second_correlation=0.29)
    settings = PasteSettings(stencil=1e-4, threshold=8.1e-6)
    assert paste(alignment=alignment, deposits={"board_scatter": 3.9e-6}, settings=settings).warnings() == ()


LEADS = Coplanarity(
    names=("1", "2", "3", "4"),
    place=np.arange(8.0).reshape(4, 2),
    top=np.array([1.0, 2.0, 3.0, np.nan]),
    top_sigma=np.array([5.0, 6.0, 7.0, 8.0]),
    gap=np.array([0.0, 5e-5, 6e-5, np.nan]),
    gap_sigma=np.array([0.1, 0.2, 0.3, 0.4]),
    deviation=np.array([1e-6, 2e-6, 6e-6, np.nan]),
    deviation_sigma=np.array([0.5, 0.6, 0.7, 0.8]),
    seats=("1", "3"),
    coplanarity=6e-5,
    coplanarity_sigma=2e-6,
    lowest="3",
    noise=3e-6,
)


def leads(maximum: float | None) -> LeadInspection:
    heights: Any = SimpleNamespace(grid=GRID)
    return LeadInspection(heights=heights, regions=(), leads=LEADS, maximum=maximum, files={"height_map": "map.tiff"})


def test_report_of_leads() -> None:
    inspection = leads(5e-5)
    assert inspection.verdicts() == ("pass", "pass", "high", "holes")
    assert leads(None).verdicts() == ("pass", "pass", "pass", "holes")
    rms = 1e6 * math.sqrt(14.0 / 3.0) * 1e-6
    summary = (
        "4 leads: coplanarity 60 um (sigma 2 um) at 3, seated on 1, 3; rms about the least-squares plane "
        f"{rms:.3g} um; noise 3 um"
    )
    assert leads(None).summary() == summary
    report = inspection.report()
    rows = report.pop("leads")
    assert report == {
        "gpuvision": version("gpuvision"),
        "files": {"height_map": "map.tiff"},
        "summary": f"{summary}; 2 leads fail",
        "warnings": [],
        "coplanarity_m": 6e-5,
        "coplanarity_sigma_m": 2e-6,
        "lowest": "3",
        "seats": ["1", "3"],
        "maximum_gap_m": 5e-5,
        "noise_m": 3e-6,
        "map": GRID_REPORT,
    }
    names = ("top", "top_sigma", "gap", "gap_sigma", "deviation", "deviation_sigma")
    for k, row in enumerate(rows):
        values = {f"{name}_m": float(getattr(LEADS, name)[k]) for name in names}
        assert row == {
            "name": str(k + 1),
            "verdict": inspection.verdicts()[k],
            "seat": k in (0, 2),
            "x_m": 2.0 * k,
            "y_m": 2.0 * k + 1.0,
            **{name: None if math.isnan(value) else value for name, value in values.items()},
        }
