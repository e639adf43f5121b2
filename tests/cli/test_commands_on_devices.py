"""Run a small job of each command in a separate process on each device: no job aborts the process."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from typer.main import get_command

from boards import LAYERS, board_folder
from docs_inputs import INPUTS
from gpuvision.camera.lens import Lens
from gpuvision.cli.main import application
from gpuvision.formats.camera_file import write_lens
from gpuvision.host import Device
from scanning import currents

MAIN = "from gpuvision.cli.main import main; main()"
# Lines before the command that shorten a job: the demonstration to four profiles, the profile to one short call, the
# tuning to one size.
SHORTER = {
    "demo": """
import functools, gpuvision.workflows.demo as demo
demo.make_scan_task = functools.partial(demo.make_scan_task, profiles=4)
""",
    "profile": """
import itertools, gpuvision.profiling.psd as psd
all_cases = psd.cases
psd.cases = lambda device: itertools.islice(all_cases(device), 1, 2)
""",
    "tune": """
import gpuvision.cli.tune as tune
tune._CLASSES = range(5, 6)
""",
}
LAYER_WORDS = [word for name, layer in LAYERS.items() for word in ("--layers", f"{name}={layer}")]
Words = list[object]


def _scan(folder: Path) -> Words:
    np.save(folder / "codes.npy", currents(4))
    return ["codes.npy", "--sensor", "psd_line", "--out", "out"]


def _scan_frames(folder: Path) -> Words:
    INPUTS["docs/guides/scan_recording.md"](folder)
    return ["recording.npy", "--sensor", "camera_line", "--out", "out"]


def _merge(folder: Path) -> Words:
    INPUTS["docs/guides/inspect_paste.md"](folder)
    (folder / "second.tiff").write_bytes((folder / "heights.tiff").read_bytes())
    return ["heights.tiff", "second.tiff", "--tolerance", "10um", "--out", "out"]


def _simulate(folder: Path) -> Words:
    INPUTS["docs/guides/simulate_part.md"](folder)
    words = ["part.stl", "--unit", "mm", "--sensor", "psd_line", "--profiles", 1, "--paths", "all", "--out", "out"]
    return [*words, "--albedo", 0.5]


def _calibrate(folder: Path) -> Words:
    INPUTS["docs/guides/calibrate_lens.md"](folder)
    return ["dots.png", "--pattern", "dots", "--out", "lens.toml"]


def _undistort(folder: Path) -> Words:
    INPUTS["docs/guides/calibrate_lens.md"](folder)
    np.save(folder / "points.npy", np.random.default_rng(1).uniform(0.0, 480.0, (9, 2)))
    write_lens(folder / "lens.toml", Lens(k1=2e-7, centre=(320.0, 240.0)), {})
    return ["dots.png", "points.npy", "--lens", "lens.toml", "--out", "out"]


def _select(folder: Path) -> Words:
    board_folder(folder)
    return [".", *LAYER_WORDS, "--region", "2mm,2mm,18mm,14mm", "--scale", "40um", "--budget", 20, "--out", "out"]


def _locate(folder: Path) -> Words:
    INPUTS["docs/guides/locate_board.md"](folder)
    return ["board.png", "--board", "gerbers", *LAYER_WORDS, "--scale", "40um", "--out", "out"]


def _locate_robot(folder: Path) -> Words:
    INPUTS["docs/guides/locate_robot.md"](folder)
    return ["top_view.png", "--field", "robocup_msl", "--scale", "3cm", "--out", "out"]


def _place(folder: Path) -> Words:
    board_folder(folder)
    preset = resources.files("gpuvision").joinpath("presets", "machines", "look_while_place.toml")
    machine = tomllib.loads(preset.read_text(encoding="utf-8"))
    machine["camera"] |= {"window": [128, 128], "pixel": 20e-6}
    (folder / "machine.toml").write_text(tomli_w.dumps(machine))
    words: Words = [".", *LAYER_WORDS, "--machine", "machine.toml", "--count", 1]
    return [*words, "--at", "15.8mm,6.4mm,0deg", "--out", "out"]


def _inspect(folder: Path) -> Words:
    INPUTS["docs/guides/inspect_paste.md"](folder)
    words: Words = ["heights.tiff", "--board", "gerbers", "--layers", "paste.gbr=top paste"]
    return [*words, "--stencil", "120um", "--out", "out"]


def _delay(_folder: Path) -> Words:
    return ["--rate", 1000, "--exposure", "200us", "--sensor", "pb1024", "--roi", "128x128", "--out", "out"]


JOBS: dict[str, Callable[[Path], Words]] = {
    "scan": _scan,
    "scan frames": _scan_frames,
    "merge": _merge,
    "simulate": _simulate,
    "calibrate": _calibrate,
    "undistort": _undistort,
    "select": _select,
    "locate": _locate,
    "locate-robot": _locate_robot,
    "place": _place,
    "inspect": _inspect,
    "delay": _delay,
    "demo": lambda _: ["--out", "out"],
    "devices": lambda _: [],
    "profile": lambda _: ["psd", "--seconds", 0.01],
    "curves": lambda _: ["psd", "--seconds", 0.01],
    "tune": lambda _: ["merge_heights", "--dry-run"],
}
# Jobs whose result is refused, in one line, because a driver computes it wrongly; see `driver_faults`.
REFUSED = {("rusticl", "22.3"): ("locate", "place")}


def test_each_command_has_a_job() -> None:
    commands = get_command(application()).commands  # type: ignore[attr-defined]
    assert {name.split()[0] for name in JOBS} == set(commands)


# On the best device other tests run each command in their process: a crash ends them.
@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize(
    "label",
    [pytest.param(each.label, marks=[pytest.mark.nightly] if each == Device.best() else []) for each in Device.all()],
)
def test_a_command_does_its_job_or_gives_the_reason_in_one_line(job: str, label: str, tmp_path: Path) -> None:
    device = Device.named(label)
    words = [job.split()[0], *map(str, JOBS[job](tmp_path))]
    if words[0] in ("profile", "curves", "tune"):  # without the option it measures all devices
        words += ["--device", label]
    code = SHORTER.get(job, "") + MAIN
    environment = os.environ | {"GPUVISION_DEVICE": label}
    ran = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    known = [
        jobs for (kind, driver), jobs in REFUSED.items() if device.kind == kind and device.driver.startswith(driver)
    ]
    lines = [line for line in ran.stderr.splitlines() if not line.startswith("MESA: ")]
    if ran.returncode == 1 and job == "profile":
        # The measurement succeeded on a machine that changed its speed.
        assert lines[-1].startswith("not valid: "), ran.stderr
        assert "not measured: " not in ran.stderr
        return
    if ran.returncode == 1 and any(job in jobs for jobs in known):
        assert (len(lines), lines[0][:11]) == (1, "gpuvision: "), ran.stderr
        return
    assert ran.returncode == 0, ran.stderr
