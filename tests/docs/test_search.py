"""Search terms lead to the right page in the search index of the documentation."""

from __future__ import annotations

import importlib.util

import pytest

import gpuvision
import gpuvision.host
from built_docs import built_docs

if importlib.util.find_spec("sphinx") is None:
    pytest.skip("sphinx is missing; `bash setup.sh docs` installs it", allow_module_level=True)

from search_index import SearchIndex

pytestmark = pytest.mark.slow  # builds the documentation, unless `make docs` has built it

# Number of first search results that must contain the page.
FIRST = 3

# Query, and the page that the search must find.
QUERIES = {
    "caliper": "concepts/matching",
    "edge detection": "concepts/matching",
    "sub-pixel": "concepts/range_geometry",
    "centroid": "concepts/range_geometry",
    "laser line": "concepts/range_geometry",
    "laser triangulation": "concepts/range_geometry",
    "sheet of light": "concepts/range_geometry",
    "PSD": "guides/psd_batch",
    "range image": "concepts/range_geometry",
    "height map": "concepts/range_geometry",
    "point cloud": "guides/scan_recording",
    "Scheimpflug": "concepts/tilted_cameras",
    "camera calibration": "guides/calibrate_lens",
    "lens distortion": "concepts/lens_calibration",
    "undistortion": "guides/calibrate_lens",
    "rectification": "guides/calibrate_lens",
    "hand-eye": "glossary",
    "chessboard": "guides/calibrate_lens",
    "radiosity": "concepts/simulation",
    "interreflection": "concepts/simulation",
    "occlusion": "concepts/simulation",
    "ray tracing": "concepts/simulation",
    "BRDF": "concepts/simulation",
    "photon noise": "concepts/simulation",
    "fiducial": "concepts/matching",
    "Gerber": "guides/locate_board",
    "registration": "concepts/matching",
    "pose estimation": "concepts/matching",
    "robust estimation": "concepts/matching",
    "localization": "guides/locate_robot",
    "OpenCL device": "concepts/devices",
    "PoCL": "concepts/devices",
    "latency": "guides/stream_frames",
    "saturation": "concepts/accuracy",
    "benchmark": "results/index",
    "RangeImage": "reference/api/gpuvision.RangeImage",
    "PsdReadout": "reference/api/gpuvision.PsdReadout",
}


def test_words_of_the_field_lead_to_the_right_page() -> None:
    index = SearchIndex(built_docs() / "searchindex.js")
    assert set(QUERIES.values()) - set(index.pages) == set()
    found = {query: index.search(query)[:FIRST] for query in QUERIES}
    assert {query: pages for query, pages in found.items() if QUERIES[query] not in pages} == {}


def test_every_public_name_has_its_page() -> None:
    folder = built_docs() / "reference" / "api"
    host = [name for name in gpuvision.host.__all__ if name not in gpuvision.__all__]
    expected = {f"gpuvision.{name}" for name in gpuvision.__all__} | {f"gpuvision.host.{name}" for name in host}
    assert expected - {path.stem for path in folder.glob("*.html")} == set()
    text = "".join(path.read_text(encoding="utf-8") for path in folder.glob("package-*.html"))
    assert {name for name in expected if f'href="{name}.html"' not in text} == set()
