"""Page of a benchmark run: complete, escaped, without network, and drawn by a browser."""

from __future__ import annotations

import dataclasses
import html.parser
import json
import math
import re
import shutil
import subprocess
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host.errors import ReadError
from gpuvision.profiling import harness
from gpuvision.profiling.page import digits, duration, page, summaries, write_page
from gpuvision.profiling.run import Failure, Probe, Row, Run
from gpuvision.profiling.stored_run import read_run

RESULTS = Path(__file__).resolve().parents[2] / "profiling" / "results"
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
HOSTILE = "<script src='https://example.org/x.js'>alert($1$)</script> & \"q\" {{ 7 * 7 }}"
MACHINE = {
    "date": "2026-11-23",
    "processor": "abacus",
    "packages": {"gpuvision": "0.2.0", "numpy": "2.4"},
    "devices": {
        "pocl": {"name": "some CPU", "driver": "3.1", "units": 2, "gflops": 186, "bandwidths": {"1048576": 2e10}}
    },
}


def row(operation: str = "psd", case: str = "float32/1e6", ratio: float = 2.5, **more: Any) -> Row:
    values: dict[str, Any] = {"device": "pocl", "seconds": 4e-4, "peer": "numba", "peer_version": "0.6"}
    values |= {"peer_seconds": 1e-3, "error": 3e-9, "fraction": 0.83}
    return Row(operation, case, ratio=ratio, **(values | more))


def full_run() -> Run:
    rows = [row(ratio_low=2.25, ratio_high=2.75, confidence=0.95, rounds=12, form="words", metadata={"p50_us": 12.25})]
    rows[0] = dataclasses.replace(rows[0], device_seconds=3e-4, flops=8e6, bytes=16_000_000)
    rows += [row("line", "whole/16", ratio=0.4, device="intel", fraction=None, error=0.0)]
    rows += [row("light", f"growth/segments-x{k}", ratio=1.5, metadata={"tolerance": 1e-6}) for k in (1, 2, 4)]
    probes = [Probe("psd", "pocl", 101e9, 99e9, True), Probe("line", "pocl", 98e9, 55e9, False)]
    return Run(
        rows, False, MACHINE, [Failure("ruler", "intel", "ValueError: no edge", "Traceback of it")], probes, 93.0
    )


class Parsed(html.parser.HTMLParser):
    """Start tags with attributes, visible text, and whether every element is closed in order."""

    VOID = frozenset({"meta", "br", "link", "img"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not (self.open and self.open[-1] == "style"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def check_offline(text: str) -> Parsed:
    """Check that a page is well formed and refers to nothing outside of it."""
    parsed = Parsed(text)
    assert parsed.open == []
    assert not {tag for tag, _ in parsed.tags} & {"script", "link", "img", "iframe", "object", "image", "base", "form"}
    for tag, attributes in parsed.tags:
        for name, value in attributes.items():
            if name in ("href", "xlink:href", "src", "action", "srcset"):
                assert re.fullmatch(r"#[-\w]+", value or ""), (tag, name, value)
            assert not name.startswith("on"), (tag, name)
            assert all(each.startswith("#") for each in re.findall(r"url\(([^)]*)", value or ""))
    assert "@import" not in text
    policy = next(each for tag, each in parsed.tags if each.get("http-equiv") == "Content-Security-Policy")
    assert policy["content"] == "default-src 'none'; style-src 'unsafe-inline'"
    names = [each["id"] for _, each in parsed.tags if "id" in each]
    assert len(names) == len(set(names))
    used = [each[name] for _, each in parsed.tags for name in ("href", "xlink:href") if name in each]
    assert {str(each)[1:] for each in used} <= set(names)
    return parsed


@pytest.mark.slow
def test_the_page_shows_the_whole_run() -> None:
    parsed = check_offline(page(full_run()))
    text = parsed.text
    for expected in (
        "2026-11-23, gpuvision 0.2.0, measured in 1.55 min",
        "Not valid: the machine changed its speed",
        "1 not measured",
        "processor abacus",
        "gpuvision 0.2.0, numpy 2.4",
        "pocl some CPU 3.1 2 186",
        "float32/1e6 pocl 400 µs 300 µs numba (words) 0.6 1 ms 2.5 2.19 to 2.83 3e-09 83 % p50_us 12.2",
        "whole/16 intel 400 µs numba 0.6 1 ms 0.4 0 ",
        "line pocl 98 55 no",
        "ruler on intel: ValueError: no edge",
        "Traceback of it",
        "Time of the peer over our time",
        "Fraction of the ceiling",
        "Error over time",
        "Time over the amount of work",
        "Roofline",
        "Trace of the speed probe",
    ):
        assert expected in text, expected
    assert sum(tag == "svg" for tag, _ in parsed.tags) == 6


def test_a_run_without_some_data_has_no_figures_of_them() -> None:
    bare = Run([row(error=0.0, fraction=None)], True, {})
    parsed = check_offline(page(bare))
    assert sum(tag == "svg" for tag, _ in parsed.tags) == 1
    for absent in ("Roofline", "Fraction of the ceiling", "Error over time", "Speed probe", "Failures", "Not valid"):
        assert absent not in parsed.text
    assert sum(tag == "svg" for tag, _ in check_offline(page(Run([], True, {}))).tags) == 0


def test_every_text_is_escaped() -> None:
    rows = [row(HOSTILE, HOSTILE, device=HOSTILE, peer=HOSTILE, peer_version=HOSTILE, form=HOSTILE)]
    rows = [*rows, row(metadata={HOSTILE: HOSTILE})]
    machine = {"date": HOSTILE, "processor": HOSTILE, "packages": {HOSTILE: HOSTILE}, "devices": {HOSTILE: {}}}
    failures = [Failure(HOSTILE, HOSTILE, HOSTILE, HOSTILE)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of matplotlib: a long name leaves no room for the axes
        text = page(Run(rows, True, machine, failures, [Probe(HOSTILE, HOSTILE, 1e9, 1e9, True)]))
    parsed = check_offline(text)
    assert parsed.text.count("alert($1$)") > 15
    assert "{{ 7 * 7 }}" in parsed.text
    assert "<script" not in text


def test_figures_show_the_points_and_the_line_of_equal_times() -> None:
    """Read the ratios back from the marks of the SVG, whose axis is logarithmic."""
    values = [0.5, 1.0, 2.0, 8.0]
    text = page(Run([row(case=str(value), ratio=value, fraction=None, error=0.0) for value in values], True, MACHINE))
    svg = text[text.index("<svg") : text.index("</svg>")]
    marks = [float(x) for x in re.findall(r'<use [^>]*x="([\d.]+)"[^>]*style="fill: #2a85c7', svg)]
    assert len(marks) >= len(values)  # the legend has a mark, too
    assert any(
        np.allclose(np.diff(marks[start : start + 4]) / (marks[start + 1] - marks[start]), [1, 1, 2], atol=0.02)
        for start in range(len(marks) - 3)
    )


def test_intervals_below_95_percent_are_not_shown_and_bars_have_the_colour_and_place_of_their_device() -> None:
    both = {"ratio_low": 2.25, "ratio_high": 2.75, "fraction": None, "error": 0.0}
    sure, unsure = both | {"confidence": 0.95}, both | {"confidence": 0.5}
    pages = [
        page(Run([row(**first), row(device="intel", **second)], True, MACHINE))
        for first, second in ((sure, sure), (unsure, sure), (unsure, unsure))
    ]
    assert [check_offline(text).text.count("2.19 to 2.83") for text in pages] == [2, 1, 0]
    bars = [_bars(text) for text in pages]
    assert [set(each) for each in bars] == [{"#2a85c7", "#d55e00"}, {"#d55e00"}, set()]
    assert bars[0]["#2a85c7"][1] != bars[0]["#d55e00"][1]
    for colour, (left, _, right, height) in bars[0].items():
        x, y = _marks(pages[0], colour)[0]
        assert left < x < right
        assert y == pytest.approx(height, abs=1e-3)


def _bars(text: str) -> dict[str, tuple[float, float, float, float]]:
    """Return the ends (x, y, x, y) of the horizontal bars of the first figure by their colour."""
    svg = text[text.index("<svg") : text.index("</svg>")]
    found = re.findall(r'<path d="M ([\d.]+) ([\d.]+) \s*L ([\d.]+) ([\d.]+) \s*"[^>]*stroke: (#2a85c7|#d55e00)', svg)
    return {colour: tuple(map(float, ends)) for *ends, colour in found}  # type: ignore[misc]


def _marks(text: str, colour: str) -> list[tuple[float, float]]:
    """Return the places (x, y) of the marks of the first figure in a colour."""
    svg = text[text.index("<svg") : text.index("</svg>")]
    places = re.findall(rf'<use [^>]*x="([\d.]+)" y="([\d.]+)" style="fill: {colour}', svg)
    return [(float(x), float(y)) for x, y in places]


def test_the_summary_of_a_peer() -> None:
    rows = [row(ratio=2.0), row(ratio=0.5), row(ratio=8.0), row(ratio=math.nan), row(ratio=3.0, peer="numpy")]
    first, second = summaries(rows)
    assert first[:4] == ("numba", "pocl", 3, 2)
    assert first[4:] == pytest.approx((2.0, 0.5, 8.0))
    assert second[:4] == ("numpy", "pocl", 1, 1)


def test_numbers_are_short() -> None:
    seconds = (3e-10, 2.5e-7, 1.5e-3, 0.25, 61.0, 7200.0)
    assert [duration(each) for each in seconds] == ["0.3 ns", "250 ns", "1.5 ms", "250 ms", "1.02 min", "2 h"]
    assert [digits(each) for each in (1.0304e3, 999.4, 2.25e-10, 1e9, 7, "x", None)] == [
        "1030", "999", "2.25e-10", "1e+09", "7", "x", "None",
    ]  # fmt: skip


@pytest.mark.slow
def test_stored_results_are_read_and_shown() -> None:
    file = RESULTS / "two-core-epyc.json"
    stored = read_run(file)
    tree = json.loads(file.read_text())
    assert [each.case for each in stored.rows] == [each["case"] for each in tree["rows"]]
    written = json.loads(stored.to_json())["rows"]
    assert all(written[number].items() >= each.items() for number, each in enumerate(tree["rows"]))
    check_offline(page(stored))


def test_a_run_is_read_as_it_was_written(tmp_path: Path) -> None:
    full_run().write(tmp_path / "run.json")
    assert read_run(tmp_path / "run.json") == full_run()


GOOD = json.loads(full_run().to_json())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "run.json: not a readable JSON file: "),
        ("[]", "run.json: not a run of gpuvision profile; expected the keys machine, valid and rows"),
        (json.dumps(GOOD | {"rows": {}}), "run.json: rows is dict, expected a list"),
        (json.dumps(GOOD | {"rows": [1]}), "run.json: row 1 is int, expected an object"),
        (json.dumps(GOOD | {"probes": [{"operation": "a"}]}), "run.json: probe 1: device is missing"),
        (json.dumps(GOOD | {"rows": [GOOD["rows"][0] | {"ratio": "2"}]}), "row 1: ratio is '2', expected float"),
        (json.dumps(GOOD | {"rows": [GOOD["rows"][0] | {"ratio": True}]}), "row 1: ratio is True, expected float"),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(ReadError, match=re.escape(message)):
        read_run(tmp_path / "run.json")


# The command ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_makes_the_page_of_a_stored_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness, "profile", lambda *_, **__: pytest.fail("measured"))
    full_run().write(tmp_path / "run.json")
    ran = CliRunner().invoke(
        application(), ["profile", "--from", str(tmp_path / "run.json"), "--html", str(tmp_path / "out")]
    )
    assert ran.exit_code == 0
    assert f"look at {tmp_path / 'out' / 'profile.html'}" in ran.stderr
    assert (tmp_path / "out" / "profile.html").read_text() == page(full_run())


def test_the_command_measures_and_writes_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run([row()], True, MACHINE)
    monkeypatch.setattr(harness, "profile", lambda *_, **__: run)
    ran = CliRunner().invoke(application(), ["profile", "psd", "--html", str(tmp_path / "out")])
    assert ran.exit_code == 0
    assert (tmp_path / "out" / "profile.html").read_text() == page(run)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--html", "out", "--quick"), "--quick has no effect with --from"),
        (("--html", "out", "--seconds", "1"), "--seconds has no effect with --from"),
        (("--html", "out", "--json", "x.json"), "--json has no effect with --from"),
        (("--html", "out", "psd"), "OPERATION has no effect with --from"),
        (("--offline", "sm_90"), "--from has no effect with --offline"),
        ((), "--from has no effect without --html or --plots"),
    ],
)
def test_options_that_measure_are_refused_with_a_stored_run(
    words: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    full_run().write(Path("run.json"))
    ran = CliRunner().invoke(application(), ["profile", "--from", "run.json", *words])
    assert isinstance(ran.exception, ValueError)
    assert str(ran.exception).startswith(message)
    assert not Path("out").exists()


def test_the_page_replaces_neither_its_input_nor_files_of_others(tmp_path: Path) -> None:
    full_run().write(tmp_path / "run.json")
    (tmp_path / "profile.html").write_text("a user's")
    words = ["profile", "--from", str(tmp_path / "run.json"), "--html", str(tmp_path)]
    ran = CliRunner().invoke(application(), words)
    assert isinstance(ran.exception, FileExistsError)
    assert (tmp_path / "profile.html").read_text() == "a user's"
    (tmp_path / "run.json").replace(tmp_path / "profile.html")
    words[2] = str(tmp_path / "profile.html")
    ran = CliRunner().invoke(application(), [*words, "--overwrite"])
    assert "it is the input" in str(ran.exception)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium here (Debian package chromium)")
def test_a_browser_draws_the_page(tmp_path: Path) -> None:
    """The page fills the window with text and coloured marks, on a light and on a dark background."""
    path = write_page(tmp_path / "out", full_run())
    grounds = []
    for scheme in ("1", "0"):  # light, dark
        picture = tmp_path / f"{scheme}.png"
        assert BROWSER is not None
        words = [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        words += [f"--user-data-dir={tmp_path / 'browser'}", f"--blink-settings=preferredColorScheme={scheme}"]
        words += ["--window-size=900,1800", f"--screenshot={picture}", path.as_uri()]
        subprocess.run(words, check=True, capture_output=True, timeout=300)
        image = cv2.imread(str(picture))
        assert image is not None
        ground = image[-1, 2].astype(int)
        grounds.append(ground)
        assert np.mean(np.abs(image.astype(int) - ground).max(axis=2) > 40) > 0.01  # text and figures
        blue, green, red = (image[..., channel].astype(int) for channel in range(3))
        assert np.count_nonzero((blue > red + 80) & (blue > green + 30)) > 20  # marks of the first device
    assert grounds[0].min() > 240
    assert grounds[1].max() < 60
