"""Choosing features of a board: the file, the picture, and the accuracy of poses from the selected features."""

from __future__ import annotations

import itertools
import shlex
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from board_images import View, board_image
from boards import BOARD_MIDDLE, LAYERS, board_folder
from gpuvision.camera.orthographic import BoardView
from gpuvision.cli import main as cli
from gpuvision.formats.features_file import read_features, write_features
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.matching.board.view_features import select_features_in_view
from gpuvision.matching.features.feature_set import FeatureSet, choose_features
from gpuvision.matching.features.imaging import Imaging
from gpuvision.schema import DescriptionError
from gpuvision.workflows.locating_board import locate_board

PIXEL, SHAPE, NOISE = 25e-6, (480, 640), 2.0
# Steps of 110 in the open and of 50 under the mask; the extent of a pixel adds to the blur.
IMAGING = Imaging(pixel=PIXEL, blur_px=1.04, contrast_bare=110 / NOISE, contrast_masked=50 / NOISE)
REGION = ((3e-3, 2.5e-3), (17e-3, 13.5e-3))
ROI = "3mm,2.5mm,17mm,13.5mm"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return board_folder(tmp_path_factory.mktemp("board"))


@pytest.fixture(scope="module")
def artwork(folder: Path) -> Artwork:
    return read_artwork(folder, layers=LAYERS)


@pytest.fixture(scope="module")
def features(artwork: Artwork) -> FeatureSet:
    return choose_features(artwork, REGION, IMAGING, budget=30)


def test_a_file_holds_what_was_chosen(features: FeatureSet, tmp_path: Path) -> None:
    write_features(features, tmp_path / "features.toml")
    again = read_features(tmp_path / "features.toml")
    assert (again.side, again.imaging) == (features.side, features.imaging)
    for name in ("placement", "point", "normal", "spacing", "length", "sigma", "covariance", "region", "condition"):
        np.testing.assert_allclose(getattr(again, name), getattr(features, name), rtol=1e-14, atol=1e-18)
    content = tomllib.loads((tmp_path / "features.toml").read_text())
    np.testing.assert_allclose([content["predicted"][f"sigma_{name}"] for name in ("x", "y", "theta")], features.sigmas)
    columns, rows = content["region"]["columns_and_rows"]
    assert columns <= 14e-3 / PIXEL + 2 * features.length.max() / PIXEL
    assert rows >= np.ptp(features.point[:, 1]) / PIXEL


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('side = "top"', 'side = "left"', "side"),
        ("blur_px = 1.04", "blur_px = 0.0", "must be positive"),
        ("blur_px = 1.04", "blurr_px = 1.04", "imaging.blur_px"),
        ("[[ruler]]", "[[ruler]]\ncolour = 1", "unknown key 'ruler[0].colour'"),
        ("\nspacing = ", "\nspacing = -", "ruler[0].spacing is -"),
        ("\nlength = ", "\nlength = -", "ruler[0].length is -"),
        ("\nsigma = ", "\nsigma = -", "ruler[0].sigma is -"),
    ],
)
def test_a_file_that_says_something_else_is_told(
    features: FeatureSet, tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = tmp_path / "features.toml"
    write_features(features, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DescriptionError) as error:
        read_features(path)
    assert words in str(error.value)


def test_two_rulers_are_too_few(features: FeatureSet, tmp_path: Path) -> None:
    fewer = replace(
        features, **{n: getattr(features, n)[:2] for n in ("point", "normal", "spacing", "length", "sigma")}
    )
    write_features(fewer, tmp_path / "features.toml")
    with pytest.raises(DescriptionError, match="expected 3 to 1000"):
        read_features(tmp_path / "features.toml")


@pytest.mark.slow
def test_budgets_are_kept(artwork: Artwork, device: Device) -> None:
    assert len(choose_features(artwork, REGION, IMAGING, budget=17).length) == 17
    in_pixels = choose_features(artwork, REGION, IMAGING, budget=5000, unit="px")
    assert 3 <= np.ceil(in_pixels.length / PIXEL).sum() * IMAGING.width_px <= 5000
    # A launch takes some microseconds before the first ruler; a budget of one second admits all candidates.
    with pytest.raises(ValueError, match="budget"):
        choose_features(artwork, REGION, IMAGING, budget=1e-3, unit="us", device=device)
    assert len(choose_features(artwork, REGION, IMAGING, budget=2000, unit="us", device=device).length) > 10
    more = choose_features(artwork, REGION, IMAGING, budget=60)
    fewer = choose_features(artwork, REGION, IMAGING, budget=12)
    assert np.linalg.det(more.covariance) < np.linalg.det(fewer.covariance)


def test_what_a_board_lacks_is_told(artwork: Artwork) -> None:
    with pytest.raises(ValueError, match="edges of the region"):
        choose_features(artwork, ((0.5e-3, 0.5e-3), (1.5e-3, 1.5e-3)), IMAGING)
    with pytest.raises(ValueError, match="determine x, y and theta"):
        choose_features(artwork, ((7e-3, 2e-3), (11e-3, 3e-3)), IMAGING)


@pytest.mark.slow
def test_a_camera_is_located_as_promised(artwork: Artwork, features: FeatureSet, device: Device) -> None:
    """Errors of 8 images at the placement point agree with the deviations that were predicted before."""
    scores = []
    rng = np.random.default_rng(7)
    for _ in range(8):
        pose = (*(np.array(BOARD_MIDDLE) + rng.uniform(-70e-6, 70e-6, 2)), rng.uniform(-3e-3, 3e-3))
        corner = np.array(pose[:2]) + (np.array(SHAPE[::-1]) - 1) / 2 * PIXEL * (-1, 1)
        view = View(corner=tuple(corner), pixel=PIXEL, shape=SHAPE, noise=NOISE)
        picture = board_image(artwork, view, (0.0, 0.0, -pose[2]), pose[:2], rng=rng)
        image = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        initial_pose = (*BOARD_MIDDLE, 0.0)
        found = locate_board(
            image, artwork, scale=PIXEL, initial_pose=initial_pose, features=features, blur_px=1.04, device=device
        )
        assert found.reason == ""
        true = BoardView(scale=PIXEL, shape=SHAPE, pose=pose)
        off = found.view.to_plane(true.to_pixels(features.placement)) - features.placement
        scores.append([*(off / features.sigmas[:2]), (found.pose[2] - pose[2]) / features.sigmas[2]])
        assert np.abs((np.array(found.pose) - pose) / found.sigmas).max() < 5.0
    # 24 Gaussian numbers have a root mean square of 1 +- 0.15. Interpolation adds 0.02 px to 0.03 px of noise.
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.6


def test_features_of_a_view_lie_in_it(artwork: Artwork) -> None:
    view = BoardView(scale=PIXEL, shape=SHAPE, pose=(*BOARD_MIDDLE, 0.6))
    chosen = select_features_in_view(artwork, view, IMAGING, budget=40)
    ends = chosen.normal * chosen.length[:, None] / 2
    for sign in (-1.0, 1.0):
        pixels = view.to_pixels(chosen.point + sign * ends)
        assert np.all((pixels >= 0) & (pixels <= np.array(SHAPE[::-1]) - 1))
    # Of thousands of places, only the corners and the middle of the view are tested.
    coarse = replace(IMAGING, pixel=5e-6, shift=20e-6)
    fine = BoardView(scale=5e-6, shape=(2400, 3200), pose=(*BOARD_MIDDLE, 0.0))
    spread = np.ptp(select_features_in_view(artwork, fine, coarse, budget=40).point, axis=0)
    assert np.all(spread > 0.5 * np.ptp(fine.bounds, axis=0))


Select = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], folder: Path) -> Select:
    options = [word for name, layer in LAYERS.items() for word in ("--layers", f"{name}={layer}")]

    def call(*arguments: object, board: Path = folder) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["gpuvision", "select", str(board), *options, *map(str, arguments)])
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
        read = capfd.readouterr()
        return code, read.out, read.err

    return call


@pytest.mark.rendered
def test_the_command_writes_features_and_a_picture(tmp_path: Path, run: Select) -> None:
    arguments = ("--region", ROI, "--scale", "25um", "--budget", "25rulers", "--placement", "9mm,8mm")
    code, out, _ = run(*arguments, "--out", tmp_path / "chosen")
    assert code == 0
    assert out.startswith("25 rulers")
    # The proposed next command reads the same layers.
    words = shlex.split(out.partition("next: ")[2])
    assert [after for before, after in itertools.pairwise(words) if before == "--layers"] == [
        f"{name}={layer}" for name, layer in LAYERS.items()
    ]
    chosen = read_features(tmp_path / "chosen" / "features.toml")
    np.testing.assert_allclose(chosen.placement, (9e-3, 8e-3))
    assert len(chosen.length) == 25
    assert cv2.imread(str(tmp_path / "chosen" / "features.png")).shape[1] > 1000


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_board_of_round_fiducials_needs_three(tmp_path: Path, run: Select, folder: Path, count: int) -> None:
    """The command `locate` refuses poses from two."""
    places = [(3, 3), (17, 13), (3, 13)][:count]
    for name, diameter in (("copper.gbr", 1.0), ("mask.gbr", 2.0)):
        flashes = "".join(f"X{x}000000Y{y}000000D03*\n" for x, y in places)
        (tmp_path / name).write_text(f"%FSLAX46Y46*%\n%MOMM*%\n%ADD10C,{diameter}*%\nD10*\n{flashes}M02*\n")
    (tmp_path / "outline.gbr").write_bytes((folder / "outline.gbr").read_bytes())
    words = ("--region", "1mm,1mm,19mm,15mm", "--scale", "25um", "--out", tmp_path / "out")
    code, out, err = run(*words, board=tmp_path)
    if count == 3:
        assert (code, err) == (0, "")
        assert out.startswith("0 rulers (0 across traces) and 3 fiducials")
        return
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert not (tmp_path / "out").exists()
    if count == 1:
        assert "0 edges of the region have room for a ruler, expected 3 or more, and 1 round pads can serve" in err
    else:
        assert "the region and the budget give 2 rulers and fiducials, gpuvision locate needs 3 or more" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--region", "1,2,3"), "expected 4 numbers"),
        (("--region", "17mm,2mm,3mm,13mm"), "expected X0 < X1 and Y0 < Y1"),
        (("--budget", "40furlongs"), "60rulers, 20000px or 150us"),
        (("--budget", "0"), "above 0"),
        (("--contrast", "40"), "two numbers"),
        (("--scale", "-25um"), "must be positive"),
        (("--region", "0.1mm,0.1mm,1mm,1mm"), "edges of the region"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path: Path, run: Select, arguments: tuple[str, str], words: str) -> None:
    usual = {"--region": ROI, "--scale": "25um", "--out": str(tmp_path / "chosen")}
    usual[arguments[0]] = arguments[1]
    code, out, err = run(*(word for name, value in usual.items() for word in (f"{name}={value}",)))
    assert (code, out) == (1, "")
    assert err.startswith("gpuvision: ")
    assert err.count("\n") == 1
    assert words in err
    assert not (tmp_path / "chosen").exists()
