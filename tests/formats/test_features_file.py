"""Feature files: what is read from a file and written again, numbers of features, directions, and messages."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from fuzz.readers import SEEDS
from gpuvision.formats.features_file import read_features, write_features
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.imaging import Imaging
from gpuvision.schema import DescriptionError

SEED = tomllib.loads((SEEDS / "features.toml").read_text(encoding="utf-8"))
RULER = {"point": [1e-3, -2e-3], "normal": [0.6, -0.8], "spacing": 2e-4, "length": 3e-4, "sigma": 4e-6}
FIDUCIAL = {"point": [5e-3, -6e-3], "radius": 7e-4, "hole": 8e-5, "sigma": 9e-6}
IMAGING = {
    "pixel": 1e-5,
    "blur_px": 2.0,
    "motion_px": [3.0, -4.0],
    "contrast_bare": 50.0,
    "contrast_masked": 6.0,
    "width_px": 7,
    "etch_bias_sigma": 8e-6,
    "registration": 9e-6,
    "smoothing_ratio": 1.5,
    "shift": 1.1e-4,
    "angle": 1.2e-3,
}


def _read(folder: Path, **changes: Any) -> FeatureSet:
    path = folder / "features.toml"
    path.write_text(tomli_w.dumps(SEED | {"ruler": [RULER], "fiducial": [FIDUCIAL]} | changes), encoding="utf-8")
    return read_features(path)


def test_every_key_is_read_and_written(tmp_path: Path) -> None:
    covariance = [[4e-12, 1e-13, 2e-10], [1e-13, 9e-12, 3e-10], [2e-10, 3e-10, 1.6e-7]]
    described: dict[str, Any] = {
        "side": "bottom",
        "placement": [0.01, -0.02],
        "imaging": IMAGING,
        "predicted": {
            "sigma_x": 2e-6,
            "sigma_y": 3e-6,
            "sigma_theta": 4e-4,
            "condition": 5.0,
            "covariance": covariance,
        },
        "region": {"least": [-1e-3, -2e-3], "greatest": [3e-3, 4e-3], "columns_and_rows": [400, 600]},
        "ruler": [RULER, RULER | {"point": [7e-3, 8e-3], "spacing": 0.0}],
        "fiducial": [FIDUCIAL, FIDUCIAL | {"hole": 0.0}],
    }
    found = _read(tmp_path, **described)
    assert (found.side, found.condition) == ("bottom", 5.0)
    assert found.imaging == Imaging(**(IMAGING | {"motion_px": (3.0, -4.0)}))
    for name, value in (("placement", described["placement"]), ("covariance", covariance)):
        np.testing.assert_array_equal(getattr(found, name), value)
    np.testing.assert_array_equal(found.region, [[-1e-3, -2e-3], [3e-3, 4e-3]])
    np.testing.assert_array_equal(found.point, [[1e-3, -2e-3], [7e-3, 8e-3]])
    np.testing.assert_allclose(found.normal, [[0.6, -0.8]] * 2, rtol=1e-15)
    np.testing.assert_array_equal(found.spacing, [2e-4, 0.0])
    np.testing.assert_array_equal(found.length, [3e-4] * 2)
    np.testing.assert_array_equal(found.sigma, [4e-6] * 2)
    np.testing.assert_array_equal(found.fiducials.point, [[5e-3, -6e-3]] * 2)
    np.testing.assert_array_equal(found.fiducials.radius, [7e-4] * 2)
    np.testing.assert_array_equal(found.fiducials.hole, [8e-5, 0.0])
    np.testing.assert_array_equal(found.fiducials.sigma, [9e-6] * 2)
    write_features(found, tmp_path / "again.toml")
    again = tomllib.loads((tmp_path / "again.toml").read_text(encoding="utf-8"))
    # Square roots and divisions by a length of 1 may round.
    for name in ("sigma_x", "sigma_y", "sigma_theta"):
        assert again["predicted"].pop(name) == pytest.approx(described["predicted"].pop(name))
    for written, given in zip(again["ruler"], described["ruler"], strict=True):
        assert written.pop("normal") == pytest.approx(given["normal"])
    described["ruler"] = [{key: each[key] for key in each if key != "normal"} for each in described["ruler"]]
    assert again == described


def test_numbers_of_features(tmp_path: Path) -> None:
    """Three to 1000 rows: one of a ruler, two of a fiducial."""
    for rulers, fiducials in ((3, 0), (1, 1), (0, 2), (1000, 0), (0, 500)):
        found = _read(tmp_path, ruler=[RULER] * rulers, fiducial=[FIDUCIAL] * fiducials)
        assert (found.point.shape, found.fiducials.point.shape) == ((rulers, 2), (fiducials, 2))
    for rulers, fiducials in ((2, 0), (0, 1), (0, 0), (1001, 0), (1, 500)):
        message = rf"{rulers} tables \[\[ruler\]\] and {fiducials} \[\[fiducial\]\], expected 3 to 1000 rows"
        with pytest.raises(DescriptionError, match=message):
            _read(tmp_path, ruler=[RULER] * rulers, fiducial=[FIDUCIAL] * fiducials)


def test_directions_are_normalised(tmp_path: Path) -> None:
    for normal in ([0.3, 0.4], [3.0, 4.0]):
        np.testing.assert_allclose(_read(tmp_path, ruler=[RULER | {"normal": normal}]).normal, [[0.6, 0.8]], rtol=1e-15)
    with pytest.raises(DescriptionError, match=r"ruler\[1\]\.normal is \(0\.299, 0\.4\), expected a direction"):
        _read(tmp_path, ruler=[RULER, RULER | {"normal": [0.299, 0.4]}])


@pytest.mark.parametrize("table", ["imaging", "predicted", "region", "ruler", "fiducial"])
def test_unknown_keys(tmp_path: Path, table: str) -> None:
    whole = SEED | {"ruler": [RULER], "fiducial": [FIDUCIAL]}
    changed = [whole[table][0] | {"colour": 1}] if table in ("ruler", "fiducial") else whole[table] | {"colour": 1}
    with pytest.raises(DescriptionError, match=rf"unknown key '{table}(\[0\])?\.colour'"):
        _read(tmp_path, **{table: changed})
    with pytest.raises(DescriptionError, match="unknown key 'colour'"):
        _read(tmp_path, colour=1)


def test_imaging_that_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"\[imaging\]: Imaging\.blur_px is 0\.0, it must be positive"):
        _read(tmp_path, imaging=IMAGING | {"blur_px": 0.0})
