"""Outputs of a job replace earlier outputs of the job alone, and never an input."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from gpuvision.host import files
from gpuvision.host import outputs as outputs_module
from gpuvision.host.outputs import MANIFEST, Outputs

Link = Callable[[Path, Path], object]


def write(folder: Path, job: str = "scan", text: str = "ours", overwrite: bool = False) -> None:
    with Outputs(job, overwrite=overwrite).folder(folder) as inside:
        (inside / "report.json").write_text(text)
        (inside / "sub").mkdir()
        (inside / "sub" / "picture.png").write_text(text)


def test_a_second_run_replaces_the_first(tmp_path: Path) -> None:
    write(tmp_path / "out")
    write(tmp_path / "out", text="again")
    assert (tmp_path / "out" / "report.json").read_text() == "again"
    assert (tmp_path / "out" / "sub" / "picture.png").read_text() == "again"
    Outputs("scan").claim_folder(tmp_path / "out", ["report.json", "sub/picture.png", "new"])


@pytest.mark.parametrize("change", ["foreign", "edited", "of another job", "manifest lost", "manifest broken"])
def test_other_files_stay_unless_overwriting_is_allowed(tmp_path: Path, change: str) -> None:
    out = tmp_path / "out"
    if change == "foreign":
        (out / "sub").mkdir(parents=True)
        (out / "sub" / "picture.png").write_text("a user's")
    else:
        write(out, "simulate" if change == "of another job" else "scan")
    if change == "edited":
        (out / "sub" / "picture.png").write_text("a user's")
    elif change == "manifest lost":
        (out / "sub" / MANIFEST).unlink()
    elif change == "manifest broken":
        (out / "sub" / MANIFEST).write_text('{"files": [1]}')
    before = {each: each.read_bytes() for each in out.rglob("*") if each.is_file()}
    wrong = (
        rf"cannot write {out / 'sub' / 'picture.png'}: the file exists, and is not an unchanged output of an earlier "
    )
    if change == "of another job":
        wrong = wrong.replace("sub/picture.png", "(sub/picture.png|report.json)")
    with pytest.raises(FileExistsError, match=wrong):
        write(out, text="new")
    with pytest.raises(FileExistsError, match=wrong):
        Outputs("scan").claim(out / "sub" / "picture.png")
    assert {each: each.read_bytes() for each in out.rglob("*") if each.is_file()} == before
    write(out, text="new", overwrite=True)
    assert (out / "sub" / "picture.png").read_text() == "new"
    write(out, text="newer")
    assert (out / "sub" / "picture.png").read_text() == "newer"


@pytest.mark.parametrize("link", [None, os.symlink, os.link])
@pytest.mark.parametrize("is_folder", [False, True])
def test_an_input_is_never_replaced(tmp_path: Path, link: Link | None, is_folder: bool) -> None:
    source = tmp_path / "in" / "report.json"
    source.parent.mkdir()
    source.write_text("an input")
    out = tmp_path / "in"
    if link is not None:
        out = tmp_path / "out"
        out.mkdir()
        link(source, out / "report.json")
    outputs = Outputs("scan", inputs=[source.parent if is_folder else source], overwrite=True)

    def write_folder() -> None:
        with outputs.folder(out) as inside:
            (inside / "report.json").write_text("ours")

    def write_file() -> None:
        outputs.write_text(out / "report.json", "ours")

    for call in (write_folder, write_file, lambda: outputs.claim(out / "report.json")):
        with pytest.raises(FileExistsError, match=rf"cannot write .*report.json: it is the input {source}"):
            call()
        assert source.read_text() == "an input"
    assert not (out / MANIFEST).exists()


def test_a_folder_of_inputs_that_holds_the_outputs(tmp_path: Path) -> None:
    """A second run into the folder of its inputs recognises the outputs of the first run."""
    (tmp_path / "board.gbr").write_text("an input")
    for _ in range(2):
        outputs = Outputs("select", inputs=[tmp_path])
        outputs.claim(tmp_path / "features.toml")
        with outputs.folder(tmp_path) as inside:
            (inside / "features.toml").write_text("ours")
    with pytest.raises(FileExistsError, match="it is the input"):
        outputs.claim(tmp_path / "board.gbr")


def test_a_link_to_an_own_output_stays(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "link.json").symlink_to(tmp_path / "data" / "file.json")
    for text in ("a", "b"):
        Outputs("devices").write_text(tmp_path / "link.json", text)
        assert (tmp_path / "link.json").is_symlink()
        assert (tmp_path / "data" / "file.json").read_text() == text
        Outputs("devices").claim(tmp_path / "link.json")


def test_an_optional_output_stays_where_the_run_fails_or_reads_it(tmp_path: Path) -> None:
    def write_sigma(outputs: Outputs, *names: str) -> None:
        with outputs.folder(tmp_path / "out", optional=["sigma"]) as inside:
            for name in names:
                (inside / name).write_text("ours")

    sigma = tmp_path / "out" / "sigma"
    write_sigma(Outputs("scan"), "heights", "sigma")
    (tmp_path / "out" / "folder").mkdir()
    with pytest.raises(IsADirectoryError):
        write_sigma(Outputs("scan"), "folder")
    write_sigma(Outputs("scan", inputs=[sigma]), "heights")
    write_sigma(Outputs("merge"), "other")
    assert sigma.exists()
    write_sigma(Outputs("scan"), "heights")
    assert {each.name for each in (tmp_path / "out").iterdir()} == {MANIFEST, "heights", "other", "folder"}
    write_sigma(Outputs("scan"), "heights", "sigma")


def test_two_outputs_of_one_name(tmp_path: Path) -> None:
    outputs = Outputs("scan")
    outputs.claim_folder(tmp_path, ["report.json"])
    (tmp_path / "same").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="two outputs have the same name"):
        outputs.claim(tmp_path / "same" / "report.json")


def test_a_folder_of_many_outputs_is_checked_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check writes a file: a check of each of a thousand outputs would take seconds on a network disk."""
    checked: list[Path] = []
    monkeypatch.setattr(files, "check_writable_folder", lambda folder: checked.append(Path(folder)))
    Outputs("job").claim(*(tmp_path / f"{name}.png" for name in range(5)), tmp_path / "other" / "6.png")
    assert checked == [tmp_path, tmp_path / "other"]


def test_standard_output_and_devices_are_no_files(tmp_path: Path) -> None:
    outputs = Outputs("scan")
    outputs.claim(None, "-", Path("/dev/null"), Path("/dev/null"))
    outputs.write_text("/dev/null", "gone")
    assert not Path("/dev", MANIFEST).exists()


@pytest.mark.parametrize("change", ["none", "size", "time", "job", "content"])
def test_an_output_counts_as_unchanged_by_job_size_and_time(tmp_path: Path, change: str) -> None:
    file = tmp_path / "a.txt"
    Outputs("scan").write_text(file, "text")
    info = file.stat()
    if change in ("size", "content"):
        file.write_text("longer text" if change == "size" else "mine")
        os.utime(file, ns=(info.st_atime_ns, info.st_mtime_ns))
    if change == "time":
        os.utime(file, ns=(info.st_atime_ns, info.st_mtime_ns + 1))
    outputs = Outputs("merge" if change == "job" else "scan")
    if change in ("none", "content"):  # of the same size and time: taken for the output
        outputs.write_text(file, "new")
        assert file.read_text() == "new"
    else:
        with pytest.raises(FileExistsError, match="the file exists, and is not an unchanged output of an earlier"):
            outputs.write_text(file, "new")
        Outputs("merge", overwrite=True).write_text(file, "new")
        assert file.read_text() == "new"


def test_a_manifest_that_is_a_link_or_too_large_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, manifest = tmp_path / "a.txt", tmp_path / MANIFEST
    Outputs("scan").write_text(file, "text")
    size = manifest.stat().st_size
    for most, is_used in ((size, True), (size - 1, False)):
        monkeypatch.setattr(outputs_module, "_MAX_MANIFEST", most)
        assert bool(outputs_module._read_manifest(tmp_path)) == is_used
    monkeypatch.undo()
    manifest.rename(tmp_path / "elsewhere")
    manifest.symlink_to(tmp_path / "elsewhere")
    assert outputs_module._read_manifest(tmp_path) == {}
    for content in ("[]", "{}", '{"files": []}', "{", "\xff"):
        manifest.unlink()
        manifest.write_text(content)
        assert outputs_module._read_manifest(tmp_path) == {}


def test_only_the_unchanged_optional_files_of_the_job_are_removed(tmp_path: Path) -> None:
    """A file that was changed, one of another job, a link and an input stay; so does a file that is written again."""
    names = ["old", "changed", "other", "link", "input", "again"]
    with Outputs("scan").folder(tmp_path) as inside:
        for name in names:
            (inside / name).write_text(name)
    (tmp_path / "changed").write_text("by hand")
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to(tmp_path / "again")
    Outputs("merge", overwrite=True).write_text(tmp_path / "other", "of another job")
    with Outputs("scan", inputs=[tmp_path / "input"]).folder(tmp_path, optional=[*names, "missing"]) as inside:
        (inside / "again").write_text("new")
    assert sorted(each.name for each in tmp_path.iterdir() if each.name != MANIFEST) == sorted(names[1:])
    assert (tmp_path / "again").read_text() == "new"
