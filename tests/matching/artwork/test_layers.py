"""Layers of a board: messages about missing and unrecognised layers, with the options to name them."""

from __future__ import annotations

import fnmatch
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from gerbonara import ExcellonFile, GerberFile

from gpuvision.cli import main as cli
from gpuvision.cli.arguments import layers_of
from gpuvision.host.errors import ReadError
from gpuvision.matching.artwork.artwork import read_artwork
from gpuvision.matching.artwork.board_files import check_gerber, open_board, parsed
from gpuvision.matching.artwork.gerber_parser import parse_gerber

HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\n"
GERBER = f"{HEAD}%ADD10C,1.0*%\nD10*\nX5000000Y5000000D03*\nX9000000Y5000000D03*\nM02*\n"
DRILL = "M48\nMETRIC\nT1C0.300\n%\nG90\nG05\nT1\nX2.0Y5.0\nT0\nM30\n"
# Names of Protel and of its successors, which most programs write.
PROTEL = {
    "gtl": "top copper", "gts": "top mask", "gto": "top silk", "gtp": "top paste", "gbl": "bottom copper",
    "gbs": "bottom mask", "gbo": "bottom silk", "gbp": "bottom paste", "gko": "mechanical outline",
}  # fmt: skip


def written(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text(DRILL if name.endswith((".drl", ".xln")) else GERBER)
    return folder


def board(folder: Path, name: str = "board", without: str = "") -> Path:
    return written(folder, *(f"{name}.{each}" for each in (*PROTEL, "drl") if each != without))


def test_complete_board_has_no_warning(tmp_path: Path) -> None:
    board(tmp_path)
    (tmp_path / "README.txt").write_text("made by hand\n")
    for side in ("top", "bottom"):
        assert read_artwork(tmp_path, side=side).warnings == ()


def test_a_mask_that_is_not_recognised_is_said(tmp_path: Path) -> None:
    """The file of the mask is there, with a name that nobody knows: edges under it would count as bare."""
    board(tmp_path, without="gts")
    written(tmp_path, "stop.lack")
    missing, others = read_artwork(tmp_path).warnings
    assert missing.startswith("no solder mask on the top side: all of its copper counts as bare")
    assert "'FILE=top mask'" in missing
    assert others.startswith("files that are not recognised as a layer: stop.lack;")
    below = read_artwork(tmp_path, side="bottom")
    assert below.warnings == (others,)


def test_layers_named_by_the_user_leave_other_files_out(tmp_path: Path) -> None:
    board(tmp_path)
    (warning,) = read_artwork(tmp_path, layers={r"board\.gtl": "top copper"}).warnings
    assert warning.startswith("no solder mask on the top side")
    named = {r"board\.gtl": "top copper", r"board\.gts": "top mask"}
    assert read_artwork(tmp_path, layers=named).warnings == ()


def test_files_with_names_of_one_letter(tmp_path: Path) -> None:
    written(tmp_path, "b.gtl", "b.gts")
    named = {r"b\.gtl": "top copper", r"b\.gts": "top mask"}
    assert len(read_artwork(tmp_path, layers=named).copper) == 2


def proposed(error: pytest.ExceptionInfo[ReadError]) -> dict[str, str]:
    """Return the layers that the options in a message name, as the command takes them."""
    words = shlex.split(str(error.value).partition(": --layers ")[2].partition(" (layers unknown")[0])
    table = layers_of([each for each in words if each != "--layers"])
    assert table is not None
    return table


def test_few_files_give_the_options_to_copy(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """gerbonara refuses fewer than six layers with a dump of its table."""
    written(tmp_path, "board.gtl", "board.gts", "board [2].gto", "notes.dat")
    with pytest.raises(ReadError, match="the names of 4 files do not determine the layers") as error:
        read_artwork(tmp_path)
    assert "\n" not in str(error.value)
    assert str(error.value).endswith("(layers unknown: notes.dat)")
    assert "PosixPath" not in str(error.value)
    artwork = read_artwork(tmp_path, layers=proposed(error))
    assert (len(artwork.copper), len(artwork.mask), len(artwork.silk)) == (2, 2, 2)
    assert capfd.readouterr() == ("", "")


def test_a_single_file_gives_the_option_to_copy(tmp_path: Path) -> None:
    written(tmp_path, "drawing.gbr")
    with pytest.raises(ReadError, match="the name of the file does not determine the layers") as error:
        read_artwork(tmp_path)
    assert proposed(error) == {fnmatch.translate("drawing.gbr"): "top copper"}


def test_a_file_above_the_limit_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of the limit's size is read; of the folder only files count, not the folders in it."""
    board(tmp_path)
    (tmp_path / "empty").mkdir()
    largest = max(path.stat().st_size for path in tmp_path.iterdir() if path.is_file())
    monkeypatch.setenv("GPUVISION_MAX_BOARD_BYTES", str(largest))
    assert read_artwork(tmp_path).warnings == ()
    (tmp_path / "notes.txt").write_text("n" * (largest + 1))
    with pytest.raises(ReadError, match=rf"notes\.txt has {largest + 1} bytes"):
        read_artwork(tmp_path)


def test_copies_are_limited_where_stray_text_hides_their_command(tmp_path: Path) -> None:
    """A % in a coordinate makes the check before the parser take the command for other text."""
    flash = "X5000000Y5000000D03*\n"
    text = f"{HEAD}%ADD10C,1.0*%\nD10*\nX4%0000Y3000000D03*\n{flash}%SRX10000000Y2I1.0J1.0*%\n{flash}%SR*%\nM02*\n"
    check_gerber(text, "board.gtl")
    board(tmp_path)
    (tmp_path / "board.gtl").write_text(text)
    with pytest.raises(ReadError, match="a step-and-repeat of 20000000 copies, expected at most 100000") as error:
        read_artwork(tmp_path)
    assert "\n" not in str(error.value)


def test_the_parser_limits_the_objects_of_all_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flash = "X5000000Y5000000D03*\n"
    text = f"{HEAD}%ADD10C,1.0*%\nD10*\n{flash}%SRX4Y5I1.0J1.0*%\n{flash}{flash}%SR*%\nM02*\n"
    monkeypatch.setenv("GPUVISION_MAX_BOARD_OBJECTS", "41")
    assert len(parse_gerber(text, tmp_path / "board.gtl").objects) == 41
    monkeypatch.setenv("GPUVISION_MAX_BOARD_OBJECTS", "40")
    with pytest.raises(SyntaxError, match="41 objects, expected at most 40"):
        parse_gerber(text, tmp_path / "board.gtl")


def test_two_boards_in_one_folder_give_the_options_of_one(tmp_path: Path) -> None:
    board(tmp_path, "front_panel")
    board(tmp_path, "main")
    with pytest.raises(ReadError, match=r"two boards in one folder .*: front_panel\.gtl, main\.gtl\)") as error:
        read_artwork(tmp_path)
    assert "layers unknown" not in str(error.value)
    layers = proposed(error)
    with open_board(tmp_path, layers) as stack:
        names = {each.original_path.name for each in stack.graphic_layers.values()}
    assert names == {f"front_panel.{each}" for each in PROTEL}
    assert read_artwork(tmp_path, layers=layers).warnings == ()


def test_two_boards_in_two_folders_name_the_folders(tmp_path: Path) -> None:
    board(tmp_path / "left")
    board(tmp_path / "right")
    with pytest.raises(ReadError, match=r"two boards in one folder .*; give one of its folders: left, right"):
        read_artwork(tmp_path)


def test_a_folder_without_gerber_files_is_said(tmp_path: Path) -> None:
    (tmp_path / "README.txt").write_text("moved to the server\n")
    with pytest.raises(ReadError, match="no file with the content of a Gerber or drill file"):
        read_artwork(tmp_path)


def allegro(folder: Path) -> Path:
    uses = ("soldermask_top", "soldermask_bottom", "silkscreen_top", "silkscreen_bottom", "outline")
    for name in ("top", "bottom", *uses):
        (folder / f"{name}.art").write_text("G04 File Origin:  Cadence Allegro 17.2-S038*\n" + GERBER)
    (folder / "nc_param.txt").write_text("FORMAT 2.4\nMACHINE-OFFSET 0 0\nUNITS MM\nCOORDINATES ABSOLUTE\n")
    return written(folder, "board.drl")


def test_gerbonara_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """It prints the table of files of Allegro's boards; it also forgets its rules of headers with the first board."""
    for _ in range(2):
        with open_board(allegro(tmp_path), None) as stack:
            names = {" ".join(layer): file.original_path.name for layer, file in stack.graphic_layers.items()}
        assert names["top mask"] == "soldermask_top.art"
        assert len(names) == 7
    assert capfd.readouterr() == ("", "")


def test_a_drill_file_that_gerbonara_scaled_is_not_read_again(tmp_path: Path) -> None:
    """Gerbonara scales the holes of Allegro's boards in memory. Its Gerber files are read again, with our checks."""
    drill, gerber = tmp_path / "board.drl", tmp_path / "board.gbr"
    drill.write_text(DRILL)
    gerber.write_text(GERBER)
    scaled = ExcellonFile.open(drill)
    scaled.objects[0].scale(10.0)
    assert [(hole.x, hole.y) for hole in parsed(scaled).objects] == [(20.0, 50.0)]
    moved = GerberFile.open(gerber)
    moved.objects[0].x = 7.0
    assert [flash.x for flash in parsed(moved).objects] == [5.0, 9.0]


@pytest.mark.realdata
def test_real_boards(data: Path) -> None:
    found = {name: read_artwork(data / "gerber" / name).warnings for name in ("upverter", "eagle")}
    assert found == {"upverter": (), "eagle": ()}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["gpuvision", *map(str, arguments)])
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
        output = capfd.readouterr()
        return code, output.out, output.err

    return call


@pytest.mark.realdata
def test_the_command_prints_the_warnings(data: Path, tmp_path: Path, run: Callable[..., tuple[int, str, str]]) -> None:
    folder = tmp_path / "gerbers"
    shutil.copytree(data / "gerber" / "upverter", folder)
    (folder / "design_export.gts").chmod(0o600)
    (folder / "design_export.gts").rename(folder / "stop.lack")
    arguments = ("--region=-65mm,-15mm,-40mm,10mm", "--scale", "25um", "--out", tmp_path / "out")
    code, _, err = run("select", folder, *arguments)
    assert (code, err.count("warning: ")) == (0, 2), err
    assert "stop.lack" in err
