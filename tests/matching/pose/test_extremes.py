"""Difficult boards: their poses are correct or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from board_fixes import GROSS, PIXEL, BoardFix
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import read_artwork
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.features.candidates import find_ruler_candidates
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.features.selection import select_rulers
from gpuvision.matching.pose.board_pose import BoardPoseEstimator
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.status import Status


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> BoardFix:
    return BoardFix.drawn(tmp_path_factory.mktemp("drawn"))


@pytest.mark.slow
def test_a_camera_that_looks_past_the_board(board: BoardFix, device: Device, rng: np.random.Generator) -> None:
    """Beyond the search range, no edges or other edges are found, and the pose is refused."""
    x, y = board.view.corner
    for off in ((40e-3, 0.0), (0.0, -2e-3)):
        picture = board.painted(replace(board.view, corner=(x + off[0], y + off[1])))
        fixes = board.fixes([picture], 5, device, rng)
        assert not fixes.good.any()
        assert np.isnan(fixes.errors).all()


def test_a_picture_that_shows_a_part(board: BoardFix, device: Device, rng: np.random.Generator) -> None:
    """Rulers beyond the right image border have no edges; the other rulers determine the pose."""
    narrow = replace(board.view, shape=(480, 500))
    fixes = board.fixes([board.painted(narrow)], 20, device, rng)
    assert fixes.good.all()
    assert fixes.squares.max() < GROSS
    assert (fixes.predicted > board.chosen.sigmas).all()


def test_no_contrast_no_pose(board: BoardFix, device: Device, rng: np.random.Generator) -> None:
    flat = board.painted(replace(board.view, levels=(90.0,) * 6))
    assert (board.fixes([flat], 5, device, rng).status == Status.NO_DATA).all()


def test_only_parallel_traces_are_left(board: BoardFix, device: Device, rng: np.random.Generator) -> None:
    """Edges of all directions were selected, but only horizontal edges are visible: x is undetermined."""
    level = [
        number
        for number, each in enumerate(board.artwork.copper)
        if np.ptp(each.outline[:, 0]) > 4 * np.ptp(each.outline[:, 1])
    ]
    others = set(range(len(board.artwork.copper))) - set(level)
    fixes = board.fixes([board.painted(board.view, missing=others)], 5, device, rng)
    assert len(level) > 4
    assert (fixes.status == Status.AMBIGUOUS).all()


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 0.7])
def test_mostly_clutter(board: BoardFix, share: float, device: Device, rng: np.random.Generator) -> None:
    """50 % or more of the rulers are on wrong edges: no pose is wrong if four other rows must support each row."""
    careful = replace(board, max_leverage=0.5)
    pictures = [board.painted(board.view, more=board.splashes(rng, share)) for _ in range(3)]
    fixes = careful.fixes(pictures, 30, device, rng)
    assert not (fixes.squares > GROSS).any()


def test_glare(board: BoardFix, device: Device, rng: np.random.Generator) -> None:
    """Specular highlights saturate a third of the image."""
    x, y = board.middle
    glare = Shape(np.array([[x - 8e-3, y - 6e-3], [x - 3e-3, y - 6e-3], [x - 2.4e-3, y + 6e-3], [x - 8e-3, y + 6e-3]]))
    blinded = replace(board, artwork=replace(board.artwork, silk=(*board.artwork.silk, glare)))
    view = replace(board.view, levels=(*board.view.levels[:4], 400.0, board.view.levels[5]))
    fixes = board.fixes([blinded.painted(view)], 20, device, rng)
    assert fixes.good.any()
    assert fixes.squares.max() < GROSS


def test_a_comb_of_one_pitch_is_not_chosen(tmp_path: Path) -> None:
    """If every edge has a similar edge within the search range, no edge determines the pose."""
    head = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n%ADD10C,0.2*%\nD10*\n"
    lines = []
    for place in range(2_000_000, 14_000_000, 400_000):
        lines += [f"X2000000Y{place}D02*\nX7000000Y{place}D01*\n", f"X{place + 8_000_000}Y2000000D02*\n"]
        lines += [f"X{place + 8_000_000}Y7000000D01*\n"]
    (tmp_path / "copper.gbr").write_text(head + "".join(lines) + "M02*\n")
    artwork = read_artwork(tmp_path, layers={r"copper\.gbr": "top copper"})
    board = BoardFix(artwork=artwork, middle=(8e-3, 6e-3))
    imaging = replace(board.imaging, pixel=10e-6, shift=400e-6)
    found = find_ruler_candidates(artwork, ((3e-3, 3e-3), (6e-3, 7e-3)), (8e-3, 6e-3), imaging)  # inside the comb
    inner = ~found.pair
    assert inner.any()
    assert (found.ambiguity[inner] == 1.0).all()
    with pytest.raises(ValueError, match="do not determine"):
        select_rulers(type(found)(*(each[inner] for each in found[:-1]), found.placement), imaging, 40)


def test_two_rulers_are_too_few() -> None:
    ruler = RulerEdges(threshold=15.0, length=48, smoothing_px=2.0)
    for solver, lines in ((SolvePose(), 2), (SolvePose(etch_bias_sigma=10e-6), 3)):
        with pytest.raises(ValueError, match="too few"):
            BoardPoseEstimator(ruler=ruler, lines=lines, rulers_per_line=1, solver=solver)


def test_a_board_that_lies_further_off_than_it_was_looked_for(
    board: BoardFix, device: Device, rng: np.random.Generator
) -> None:
    """Displaced by 0.3 mm, three times the range: rulers find other edges, and poses beyond the range are refused."""
    x, y = board.view.corner
    picture = board.painted(replace(board.view, corner=(x + 12 * PIXEL, y)))
    fixes = board.fixes([picture], 10, device, rng)
    assert not fixes.good.any()
