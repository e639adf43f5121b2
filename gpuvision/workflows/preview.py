"""Preview of a scan: frames spread over a recording, with the laser line that the readout finds in them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.host.outputs import Outputs
from gpuvision.host.sources import Source
from gpuvision.plots.line_frames import LineFrame, draw_line_frames
from gpuvision.ranging.background import sample_frames
from gpuvision.ranging.line import LineReadout
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.opened_recording import open_for_scan

PREVIEW_FILE = "preview.png"
"""Name of the file that `Preview.write` writes."""


@dataclass(frozen=True, kw_only=True)
class Preview:
    """Frames of a recording with the line found in them.

    Attributes
    ----------
    name : str
        Name of the recording.
    sensor : Sensor
        Sensor, with the estimated threshold if its file asks for one.
    frames : tuple of LineFrame
        Frames less their background, with positions and flags.
    damaged_frames : tuple of int
        Numbers of the damaged frames of the whole recording.
    """

    name: str
    sensor: Sensor
    frames: tuple[LineFrame, ...]
    damaged_frames: tuple[int, ...] = ()

    @property
    def found_fraction(self) -> float:
        """Fraction of the samples with a line, 0 to 1."""
        return float(np.mean([frame.found_fraction for frame in self.frames]))

    def summary(self) -> str:
        """Return one line: number of frames, threshold, background, fraction of the samples with a line.

        Of a damaged recording the line gives the number of damaged frames.
        """
        count = len(self.damaged_frames)
        damaged = f"; {count} damaged frame{'s' * (count > 1)}" if count else ""
        return (
            f"preview of {len(self.frames)} frames at {self._settings()}: "
            f"a line in {100 * self.found_fraction:.1f} % of the samples{damaged}"
        )

    def write(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write ``preview.png`` into a folder, which is created if it is missing.

        Parameters
        ----------
        folder : str or Path
            Output folder.
        overwrite : bool
            Whether a file may be replaced that no earlier preview wrote. Default False.

        Raises
        ------
        FileExistsError
            The file exists, and is not an unchanged output of an earlier preview.
        OSError
            The folder cannot be written.
        """
        readout = _line_readout(self.sensor)
        with Outputs("preview", overwrite=overwrite).folder(folder) as inside:
            title = f"{self.sensor.name or 'Preview'}: {self._settings()}"
            draw_line_frames(inside / PREVIEW_FILE, self.frames, along=readout.along, title=title)

    def _settings(self) -> str:
        background = self.sensor.recording.background
        shown = background.name if isinstance(background, Path) else background
        subtracted = "" if background == "none" else f", background {shown}"
        return f"threshold {_line_readout(self.sensor).threshold:g} grey levels{subtracted}"


def preview_scan(
    recording: str | Path | Source | npt.NDArray[Any], sensor: Sensor, *, count: int = 9, device: Device | None = None
) -> Preview:
    """Find the line in some frames of a recording, as a scan does, without the scan.

    Parameters
    ----------
    recording : str, Path, Source or numpy.ndarray
        As for `gpuvision.workflows.scanning.scan`.
    sensor : Sensor
        Sensor with a camera.
    count : int
        Number of frames, default 9; all frames of a shorter recording.
    device : Device, optional
        Device of the computation; default `Device.best`.

    Returns
    -------
    Preview

    Raises
    ------
    RecordingError
        The recording cannot be read.
    ValueError
        The sensor has no camera with a line, or the frames do not fit the sensor.

    Notes
    -----
    The recording is read to its end, and once more if the background or the threshold is estimated from it.
    """
    readout = _line_readout(sensor)
    opened = open_for_scan(recording, sensor)
    try:
        sample = sample_frames(opened.source, max(count, 1))
        damaged = opened.source.damaged_frames()
    finally:
        opened.source.close()
    chosen = np.unique(np.rint(np.linspace(0, len(sample.numbers) - 1, min(count, len(sample.numbers)))).astype(int))
    frames, numbers = sample.frames[chosen, 0], sample.numbers[chosen]
    readout = _line_readout(opened.sensor)
    triangulated = () if readout.triangulation is None else ("g", "h")
    seen = dataclasses.replace(readout, outputs=("position", *triangulated, "status"))
    reading = seen(frames, device=Device.best() if device is None else device)
    found = zip(numbers.tolist(), frames, to_numpy(reading.position), to_numpy(reading.status), strict=True)
    return Preview(
        name=opened.name,
        sensor=opened.sensor,
        frames=tuple(LineFrame(number=n, image=i, position=p, status=s) for n, i, p, s in found),
        damaged_frames=tuple(sorted(damaged)),
    )


def _line_readout(sensor: Sensor) -> LineReadout:
    if not isinstance(sensor.readout, LineReadout):
        raise ValueError(f"a preview shows the line in camera frames; the sensor is of kind {sensor.kind!r}")
    return sensor.readout
