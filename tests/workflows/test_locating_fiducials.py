"""Locating a camera over boards by round fiducials, alone and together with rulers."""

from __future__ import annotations

import cmath
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from boards import BOARD_MIDDLE, LAYERS
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.cli import main as cli
from gpuvision.formats.features_file import read_features, write_features
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.board.view_features import select_features_in_view
from gpuvision.matching.features.feature_set import choose_features
from gpuvision.matching.features.imaging import Imaging
from gpuvision.workflows.locating_board import locate_board
from round_boards import (
    FIDUCIALS,
    LANDS,
    NOISE,
    PIXEL,
    SHAPE,
    TRACES,
    moved_picture,
    round_artwork,
    round_board,
    round_picture,
)

NEAR = (*BOARD_MIDDLE, 0.0)
# Steps of 110 in the open and of 50 under the mask; the extent of a pixel adds to the blur.
IMAGING = Imaging(pixel=PIXEL, blur_px=1.04, contrast_bare=110 / NOISE, contrast_masked=50 / NOISE, angle=5.3e-3)
VIEW = BoardView(scale=PIXEL, shape=SHAPE, pose=NEAR)
DRAWS = 40


@pytest.fixture(scope="module")
def rounds(tmp_path_factory: pytest.TempPathFactory) -> Artwork:
    """Return round pads and fiducials without straight edges."""
    return round_artwork(round_board(tmp_path_factory.mktemp("rounds")))


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Artwork:
    """Return a board that also has traces: some free, and one that ends in a pad."""
    traces = (*TRACES, (*LANDS[5], LANDS[5][0] + 2.5, LANDS[5][1] + 0.5))
    return round_artwork(round_board(tmp_path_factory.mktemp("mixed"), traces=traces))


def located(image: np.ndarray, artwork: Artwork, **more: object) -> LocatedBoard:
    return locate_board(image, artwork, scale=PIXEL, initial_pose=NEAR, copper="bright", **more)


def squares(errors: list[np.ndarray], covariances: list[np.ndarray]) -> float:
    """Return the squared Mahalanobis distance of the errors."""
    return float(sum(e @ np.linalg.inv(c) @ e for e, c in zip(errors, covariances, strict=True)))


def is_consistent(total: float, numbers: int) -> bool:
    """Return whether squared errors agree with Gaussian numbers, for all but 2 of 1e4 boards.

    The deviations themselves are within 10 %: fiducials have 1.0 to 1.2 times the bound, and 1.1 is predicted.
    """
    low, high = chi2.ppf([1e-4, 1 - 1e-4], numbers)
    return bool(0.9**2 * low <= total <= 1.1**2 * high)


@pytest.mark.slow
@pytest.mark.parametrize("board", ["rounds", "mixed"])
def test_errors_are_as_promised(board: str, device: Device, request: pytest.FixtureRequest) -> None:
    """Errors agree with the predictions of the selection and with the covariance of each pose."""
    artwork, rng = request.getfixturevalue(board), np.random.default_rng(5)
    features = select_features_in_view(artwork, VIEW, IMAGING, 40)
    assert len(features.fiducials.radius) == len(LANDS) + len(FIDUCIALS)
    assert (len(features.length) == 0) == (board == "rounds")
    picture = round_picture(artwork)
    errors, predicted = [], []
    for _ in range(DRAWS):
        image, true = moved_picture(picture, rng)
        found = located(image, artwork, features=features, device=device)
        assert found.reason == ""
        assert found.fiducials.used.sum() >= 15  # Tukey's loss rejects no more than a few of 1e3 good rows
        errors.append(np.array(found.pose) - true)
        predicted.append(found.covariance)
    assert is_consistent(squares(errors, [features.covariance] * DRAWS), 3 * DRAWS)
    assert is_consistent(squares(errors, predicted), 3 * DRAWS)
    # A hundredth of a pixel: 0.4 um.
    assert np.all(features.sigmas[:2] < 0.01 * PIXEL)


def test_marks_beside_rulers_promise_more(mixed: Artwork) -> None:
    both = select_features_in_view(mixed, VIEW, IMAGING, 40)
    rulers = select_features_in_view(replace(mixed, pads=()), VIEW, IMAGING, 40)
    assert len(both.length) == len(rulers.length) == 40
    assert np.all(both.sigmas < 0.6 * rulers.sigmas)


def shifted(artwork: Artwork, which: np.ndarray, by: np.ndarray) -> list[Shape]:
    """Areas of the copper, some of them moved by (n, 2) [m]."""
    moves = dict(zip(which.tolist(), by, strict=True))
    return [
        Shape(each.outline + by, each.dark, tuple(hole + by for hole in each.holes))
        for n, each in enumerate(artwork.copper)
        for by in (moves.get(n, np.zeros(2)),)
    ]


@pytest.mark.parametrize(
    ("how", "board"),
    [("missing", "rounds"), ("apart", "rounds"), ("together", "rounds"), ("far", "rounds"), ("apart", "mixed")],
)
def test_bad_marks_do_not_spoil_a_pose(
    board: str, how: str, device: Device, request: pytest.FixtureRequest, draws: Callable[[int, int], int]
) -> None:
    """Five of 16 fiducials are missing or displaced: individually, all equally, or beyond the search range.

    One of the two uncovered fiducials is among them; it has more information than half of all others.
    """
    artwork, rng = request.getfixturevalue(board), np.random.default_rng(11)
    first = len(artwork.copper) - len(LANDS) - len(FIDUCIALS)
    features = select_features_in_view(artwork, VIEW, IMAGING, 40)
    errors, predicted = [], []
    for _ in range(draws(2, 3)):
        bad = np.append(rng.choice(len(LANDS), 4, replace=False), len(LANDS) + rng.integers(len(FIDUCIALS)))
        direction = rng.normal(size=(5, 2)) if how != "together" else np.tile(rng.normal(size=2), (5, 1))
        by = direction / np.hypot(*direction.T)[:, None] * {"far": 700e-6, "missing": 0.0}.get(how, 60e-6)
        changed = replace(artwork, copper=tuple(shifted(artwork, first + bad, by)))
        picture = round_picture(changed, missing=first + bad if how == "missing" else ())
        for _ in range(draws(2, 4)):
            image, true = moved_picture(picture, rng)
            found = located(image, artwork, features=features, device=device)
            assert found.reason == ""
            errors.append(np.array(found.pose) - true)
            predicted.append(found.covariance)
            places = np.stack([artwork.pads[n].centre for n in bad])
            mine = np.hypot(*(found.fiducials.point[:, None] - places).T).min(axis=0) < 1e-6
            assert mine.sum() == 5
            assert not found.fiducials.used[mine].any()
            assert found.fiducials.used[~mine].sum() >= 10
            assert how in ("apart", "together") or not found.fiducials.found[mine].any()
    assert squares(errors, predicted) < 1.1**2 * chi2.ppf(1 - 1e-4, 3 * len(errors))


def test_fiducials_that_agree_with_nothing_are_no_pose(rounds: Artwork, device: Device) -> None:
    """Two uncovered fiducials outweigh a few pads under the mask; displaced together they are rejected."""
    both = np.arange(len(LANDS), len(LANDS) + len(FIDUCIALS))
    board = replace(rounds, copper=tuple(shifted(rounds, both, np.tile([50e-6, -40e-6], (len(both), 1)))))
    picture, rng = round_picture(board), np.random.default_rng(12)
    for _ in range(4):
        image, true = moved_picture(picture, rng)
        found = located(image, rounds, device=device)
        assert found.reason == ""
        assert np.abs((np.array(found.pose) - true) / found.sigmas).max() < 4.5
        assert not found.fiducials.used[:2].any()


def test_a_board_of_marks_is_not_searched(rounds: Artwork) -> None:
    """The search needs straight edges; without straight edges the message names the remedy."""
    image, _ = moved_picture(round_picture(rounds), np.random.default_rng(13))
    found = locate_board(image, rounds, scale=PIXEL)
    assert "too few straight edges are in view; give an initial pose" in found.reason


def test_two_marks_are_too_few(tmp_path: Path) -> None:
    """Two fiducials leave no redundancy."""
    artwork = round_artwork(round_board(tmp_path, pads=((6, 6), (14, 10)), fiducials=()))
    with pytest.raises(ValueError, match=r"0 edges .* and 2 round pads can serve as fiducials, expected 3"):
        located(np.zeros(SHAPE, np.uint8), artwork)


def test_a_picture_without_the_board_is_refused(rounds: Artwork) -> None:
    image = np.random.default_rng(3).normal(90, 8, SHAPE).clip(0, 255).astype(np.uint8)
    found = located(image, rounds)
    assert found.reason
    assert np.isnan(found.pose).all()
    json.dumps(found.report(), allow_nan=False)


def test_dark_marks_are_told_from_bright(rounds: Artwork, device: Device) -> None:
    image, true = moved_picture(round_picture(rounds), np.random.default_rng(4))
    found = locate_board(255 - image, rounds, scale=PIXEL, initial_pose=NEAR, device=device)
    assert found.copper == "dark"
    assert np.abs((np.array(found.pose) - true) / found.sigmas).max() < 4.5


@pytest.mark.slow
def test_marks_are_seen_through_a_lens(rounds: Artwork) -> None:
    lens = Lens(k1=2e-7, centre=(205.0, 145.0))
    straight, true = moved_picture(round_picture(rounds), np.random.default_rng(6))
    columns, rows = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    at = lens.undistort(np.stack([columns, rows], axis=-1)).astype(np.float32)
    image = cv2.remap(
        straight.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    found = located(image, rounds, model=lens)
    # The image is resampled from noisy pixels; cubic interpolation preserves the noise to some percent.
    assert np.abs((np.array(found.pose) - true) / found.sigmas).max() < 4.5 + 1.0
    assert found.fiducials.used.sum() == len(LANDS) + len(FIDUCIALS)
    # 2e-7 px^-2 moves the outer marks by a pixel.
    bare = located(image, rounds)
    assert (
        bare.reason
        or np.abs(bare.fiducials.residual[bare.fiducials.used]).max() > 3 * np.abs(found.fiducials.residual).max()
    )


def test_a_mirrored_side_is_seen_from_below(rounds: Artwork) -> None:
    image, true = moved_picture(round_picture(rounds), np.random.default_rng(8))
    below = np.ascontiguousarray(image[:, ::-1])
    found = located(below, replace(rounds, side="bottom"))
    assert np.abs((np.array(found.pose) - true) / found.sigmas).max() < 4.5


def test_marks_are_chosen_for_their_cost(mixed: Artwork, tmp_path: Path) -> None:
    """A fiducial costs 16 rulers; uncovered fiducials are selected, and the predicted pose is better than by rulers."""
    region = ((2.5e-3, 2.5e-3), (17e-3, 13.9e-3))
    features = choose_features(mixed, region, IMAGING, budget=80)
    fiducials = len(features.fiducials.radius)
    assert fiducials >= len(FIDUCIALS)
    assert 80 - 16 < len(features.length) + 16 * fiducials <= 80
    rulers = choose_features(replace(mixed, pads=()), region, IMAGING, budget=80)
    assert np.linalg.det(features.covariance) < np.linalg.det(rulers.covariance)
    write_features(features, tmp_path / "features.toml")
    again = read_features(tmp_path / "features.toml")
    for name in features.fiducials._fields:
        np.testing.assert_array_equal(getattr(again.fiducials, name), getattr(features.fiducials, name))
    assert np.all(features.fiducials.point - features.fiducials.radius[:, None] > features.region[0])


def test_the_command_tells_of_marks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = round_board(tmp_path)
    artwork = round_artwork(folder)
    picture = round_picture(artwork, missing=(2,))
    image, true = moved_picture(picture, np.random.default_rng(9))
    cv2.imwrite(str(tmp_path / "board.png"), image)
    layers = [word for name, layer in LAYERS.items() for word in ("--layers", f"{name}={layer}")]
    initial_pose = ",".join(str(each) for each in BOARD_MIDDLE) + ",0"
    where = ["--scale", "40um", f"--initial-pose={initial_pose}", "--out", str(tmp_path / "out")]
    where += ["--gcode", str(tmp_path / "board.ngc"), "--camera-at=120mm,80mm,90deg"]
    command = ["gpuvision", "locate", str(tmp_path / "board.png"), "--board", str(folder), *layers, *where]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code
    assert "15 of 16 fiducials agree, 15 were found" in capsys.readouterr().out
    report = json.loads((tmp_path / "out" / "pose.json").read_text())
    assert (report["counts"]["fiducials_in_image"], report["counts"]["fiducials_used"]) == (16, 15)
    assert sum(each["found"] for each in report["fiducials"]) == 15
    for name, value in zip(("x", "y", "theta"), true, strict=True):
        assert abs(report["pose"][name] - value) < 4.5 * report["sigmas"][name]
    assert (tmp_path / "out" / "located.png").exists()
    code = (tmp_path / "board.ngc").read_text()
    x, y, turn = (float(each) for each in re.search(r"G10 L2 P1 X(\S+) Y(\S+) R(\S+)", code).groups())  # [mm], [deg]
    # The point at the image centre is at the place of the camera on the machine.
    centre = complex(x, y) + 1e3 * complex(*true[:2]) * cmath.exp(1j * math.radians(turn))
    assert centre == pytest.approx(120 + 80j, abs=2e-3)
    assert turn == pytest.approx(90 - math.degrees(true[2]), abs=0.01)
