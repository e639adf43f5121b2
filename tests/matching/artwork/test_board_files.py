"""Checks of the files of a board at their limits, and the layers that names suggest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gpuvision.host.errors import ReadError
from gpuvision.matching.artwork import board_files
from gpuvision.matching.artwork.board_files import (
    _of_board,
    _some_names,
    board_layer_files,
    check_drill,
    check_gerber,
    open_layers,
    propose_layers,
)


@pytest.fixture
def limit(monkeypatch: pytest.MonkeyPatch) -> Any:
    return lambda number: monkeypatch.setenv("GPUVISION_MAX_BOARD_OBJECTS", str(number))


FLASH = "X0Y0D03*"


@pytest.mark.parametrize(
    ("text", "objects"),
    [
        (FLASH * 3, 3),
        (f"%LPD*%{FLASH}G04 text*{FLASH}", 3),  # a comment counts as a command
        (f"{FLASH}%SRX2Y3I1J1*%{FLASH}{FLASH}%SR*%{FLASH}", 1 + 2 * 6 + 1),
        (f"%SRX2Y3I1J1*%{FLASH}{FLASH}", 12),  # without an end
        (f"%SRX02Y003I1J1*%{FLASH}%SRX4Y1I1J1*%{FLASH}{FLASH}%SR*%", 6 + 8),
        ("%SRX7Y2I1J1*%%SR*%", 14),  # the copies alone
    ],
)
def test_objects_are_counted_with_their_copies(limit: Any, text: str, objects: int) -> None:
    limit(objects)
    check_gerber(text, "a.gbr")
    limit(objects - 1)
    with pytest.raises(ReadError, match=rf"^a\.gbr: .*\b{objects} (objects|copies), expected at"):
        check_gerber(text, "a.gbr")


@pytest.mark.parametrize(
    ("taken", "refused", "message"),
    [
        (f"X{'1' * 100}*", f"X{'1' * 101}*", "a number of more than 100 digits"),
        (f"X{' ' * 1000}*", f"X{' ' * 1001}*", "more than 1000 spaces"),
        (f"{' ' * 2000}X*{' ' * 2000}", f"X*{' ' * 1001}Y*", "more than 1000 spaces"),
        ("%ADD10P,1X1000*%", "%ADD10P,1X1001*%", "a polygon aperture of 1001 corners, expected 3 to 12"),
        ("%ADD10P,1X6X2000*%", "%ADD10P,1X6*%%ADD11P,1X2000X6*%", "a polygon aperture of 2000 corners"),
        ("%AMA*0 a remark: {}*1,1,$1,0,0*%", "%AMA*1,1,{},0,0*%", r"an aperture macro with '1,1,\{\},0,0'"),
        (f"%AMA*{'1' * 100}{',1' * 49950}*%", f"%AMA*{'1' * 100}{',1' * 49951}*%", "an aperture macro with '1111"),
        ("%AMA*21,1,$1x2+(3.5-$2)/4E1,0,0,0*%", "%AMA*21,1,$1**2,@*%", "an aperture macro with '2,@'"),
        ("X0Y0*" + "x" * 1000, "X0Y0*" + "x" * 1001, "1001 characters or more that are no command"),
        ("x" * 1000 + "%LPD*%", "x" * 600 + "%LPD*%" + "y" * 600, "characters or more that are no command"),
    ],
)
def test_text_that_is_no_gerber_is_refused(taken: str, refused: str, message: str) -> None:
    check_gerber(taken, "a.gbr")
    with pytest.raises(ReadError, match=rf"^a\.gbr: .*{message}"):
        check_gerber(refused, "a.gbr")


def test_lines_and_holes_of_a_drill_file(limit: Any) -> None:
    """A comment may be long; a repeat counts as often as it is repeated."""
    check_drill("M48\n" + "x" * 1000 + "\n" + "  ; " + "y" * 2000, "a.drl")
    with pytest.raises(ReadError, match=r"^a\.drl: a line of 1001 characters, expected commands of a drill file"):
        check_drill("M48\n" + "x" * 1001, "a.drl")
    with pytest.raises(ReadError, match="more than 100 digits"):
        check_drill("X" + "1" * 101, "a.drl")
    text = "M48\nX1Y1\n  R005X1\nX2R9\n"
    limit(4 + 5)
    check_drill(text, "a.drl")
    limit(8)
    with pytest.raises(ReadError, match=r"^a\.drl: 9 holes, expected at most 8"):
        check_drill(text, "a.drl")
    check_drill("", "a.drl")


def test_twelve_names_are_given() -> None:
    names = [f"file{k}.gbr" for k in range(14)]
    assert _some_names(names[:12]) == ", ".join(names[:12])
    assert _some_names(names) == ", ".join(names[:12]) + " and 2 more"


def test_files_of_a_board_share_the_beginning_of_their_names() -> None:
    boards = [Path("main_top.gtl"), Path("mast_top.gtl"), Path("other.gtl")]
    masks = [Path("other.gts"), Path("mast_top.gts"), Path("main_top.gts"), Path("main_copy.gts")]
    assert _of_board(masks, boards) == [Path("main_top.gts")]
    assert _of_board([Path("mast.gts")], boards) == []
    # The same beginning as of another board: it may belong to the first.
    assert _of_board([Path("ma.gts")], boards) == [Path("ma.gts")]


def test_content_tells_the_files_of_layers(tmp_path: Path) -> None:
    """Other files and folders are left out; names of one letter, on which gerbonara 1.5 fails, suggest nothing."""
    gerber = "%FSLAX46Y46*%\n%MOMM*%\nM02*\n"
    (tmp_path / "b.gbr").write_text(gerber)
    (tmp_path / "notes.txt").write_text("nothing\n")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a.drl").write_text("M48\nMETRIC\nT1C0.300\n%\nG90\nT1\nX2.0Y5.0\nM30\n")
    assert [each.name for each in board_layer_files(tmp_path)] == ["b.gbr", "a.drl"]
    assert propose_layers([]) == ("no file with the content of a Gerber or drill file; name its files with layers")
    single = propose_layers([tmp_path / "b.gbr"])
    assert single.startswith("the name of the file does not determine the layers; name its files with layers: --layers")
    two = propose_layers([tmp_path / "b.gbr", tmp_path / "c.gbr"])
    assert two.startswith("the names of 2 files do not determine the layers")
    assert two.endswith("(layers unknown: b.gbr, c.gbr)")
    with pytest.raises(ReadError, match=r"the names of 2 files do not .*a\.drl=drill.* \(layers unknown: b\.gbr\)"):
        open_layers(tmp_path, tmp_path, None)


def test_a_folder_has_at_most_its_number_of_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).write_text("12345")
    monkeypatch.setenv("GPUVISION_MAX_BOARD_FILES", "3")
    monkeypatch.setenv("GPUVISION_MAX_BOARD_BYTES", "5")
    board_files._check_files(tmp_path, tmp_path)
    monkeypatch.setenv("GPUVISION_MAX_BOARD_FILES", "2")
    with pytest.raises(ReadError, match="3 files or more, expected the files of one board, expected at most 2"):
        board_files._check_files(tmp_path, tmp_path)
    monkeypatch.setenv("GPUVISION_MAX_BOARD_FILES", "3")
    monkeypatch.setenv("GPUVISION_MAX_BOARD_BYTES", "4")
    with pytest.raises(ReadError, match=r": . has 5 bytes, expected at most 4"):
        board_files._check_files(tmp_path, tmp_path)
