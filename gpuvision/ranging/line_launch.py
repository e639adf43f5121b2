"""Launch of the line kernel for frames of one shape: work size, build options and parameter table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpuvision.camera.profile_correction import ProfileCorrection
from gpuvision.host import Define, Device, Launch, LaunchBuilder, WorkSize, ceil_div, flags, round_up, type_defines
from gpuvision.ranging.line_parameters import WIDEST_WINDOW, LineParameters, LineReading

LONGEST_PROFILE = 32767  # samples: the vector variant keeps sample indices in 16 bits
_SMALL_WINDOW = 15  # samples on either side: sums of bytes times their index fit 16 bits
_LANES = 16  # of a vector of the vector variant: its kernel's vectors have 16 elements
_WIDE_BYTES = 64  # bytes of a wide vector (one cache line): WIDE in line_wide.h
_GROUP = 64  # work-items of a work-group that selects among candidates
_STRIP = 1024  # largest number of columns of a strip: MAX_STRIP in line_strip.h
_PROFILE_BYTES = 96  # largest sum of the sizes of a profile's outputs
# Bytes of a launch that one work-item moves. Intel's runtime runs a launch of one work-group in the calling thread, as
# PoCL does with all short launches (host/bound.py). Measured on two cores: 10 us, not 16 us, for a frame of 512 KiB.
_ONE_ITEM_BYTES = 640 << 10


@dataclass(frozen=True, kw_only=True)
class LineLaunch:
    """Launch of a line readout.

    Attributes
    ----------
    readout : LineParameters
    build : LaunchBuilder
        Builder for frames (..., rows, columns), whose shape and dtype are checked.
    """

    readout: LineParameters
    build: LaunchBuilder

    def describe(self) -> Launch:
        """Return the launch; check that the levels of the readout fit the dtype of the frames."""
        readout, build = self.readout, self.build
        chosen, of_samples = readout.outputs or (), (*build.shape[:-2], self.samples)
        work, profiles = self._work(), None
        if readout.triangulation is not None:
            profiles = readout.triangulation.profile_correction(build.real, readout.axes, self.length, self.samples)
        return build.launch(
            "line/line.cl",
            "line_readout",
            work=work,
            more_inputs=[(of_samples, build.real)] if readout.peak_selection == "nearest" else [],
            outputs=build.outputs({name: of_samples if name in chosen else None for name in LineReading._fields}),
            defines=self._defines(profiles) | self._work_defines(work),
            arguments=[
                np.int32(self._rows),
                np.int32(self._columns),
                *self._levels(),
                np.int32(readout.window),
                self._table(),
                None
                if readout.triangulation is None
                else readout.triangulation.packed(build.real, readout.axes, profiles),
                None if profiles is None else profiles.blocks(build.real),
            ],
            passes_once=work.vectors and self._passes_once,
            by_team=True,
        )

    @property
    def length(self) -> int:
        """Samples of a profile."""
        return self._rows if self.readout.along == "columns" else self._columns

    @property
    def samples(self) -> int:
        """Profiles of a frame."""
        return self._columns if self.readout.along == "columns" else self._rows

    @property
    def _rows(self) -> int:
        return self.build.shape[-2]

    @property
    def _columns(self) -> int:
        return self.build.shape[-1]

    @property
    def _frames(self) -> int:
        return math.prod(self.build.shape[:-2])

    @property
    def _moved(self) -> int:
        """Bytes that the launch moves, approximately."""
        frame = self._rows * self._columns * self.build.dtype.itemsize
        return self._frames * (frame + _PROFILE_BYTES * self.samples)

    @property
    def _limits_width(self) -> bool:
        return self.readout.minimum_width > 1 or self.readout.maximum_width is not None

    @property
    def _passes_once(self) -> bool:
        return self.readout.method in ("centroid", "windowed")

    @property
    def _has_candidates(self) -> bool:
        return self.readout.method != "centroid" and (self.readout.peak_selection != "strongest" or self._limits_width)

    @property
    def _is_narrow(self) -> bool:
        """Whether frames are narrower than a vector, so that an item of the vector variant has one profile."""
        if not self.build.uses_vectors:
            return False
        if self._has_candidates:
            # Along rows, both variants process one profile after the other and skip dark parts in vectors of samples.
            return self.readout.along != "columns" or self._columns < _LANES
        return self._columns < _WIDE_BYTES // self.build.dtype.itemsize or (
            self.readout.along == "rows" and self._rows < _LANES
        )

    def _work(self) -> WorkSize:
        if self.build.uses_vectors and not self._is_narrow:
            return WorkSize((self._items(), self._frames), (1, 1), vectors=True)
        if self._has_candidates or self._is_narrow:
            return WorkSize((round_up(self.samples, _GROUP), self._frames), (_GROUP, 1))
        group, profiles = self._group()
        return WorkSize((ceil_div(self.samples, profiles) * group, self._frames), (group, 1))

    def _group(self) -> tuple[int, int]:
        """Return the work-items and the profiles of a work-group: GROUP and PROFILES in line_group.h."""
        dtype = self.build.dtype
        if self.readout.method == "ml":
            return 64, 64
        if self.readout.along == "columns":
            return 256, 64 if dtype.itemsize == 1 else 32
        sums_in_double = self.readout.method == "centroid" and dtype.kind == "f" and self.build.real == np.float64
        return 256, 16 if sums_in_double else 32

    def _items(self) -> int:
        """Return the work-items per frame of the vector variant: few, but two per core at least over all frames.

        One work-item reads a small frame.
        """
        if self.readout.along == "rows" or self._has_candidates:
            return ceil_div(self.samples, _LANES)
        if self._frames == 1 and self._passes_once and self._moved <= _ONE_ITEM_BYTES:
            return 1
        units = self.build.device.compute_units
        busy = ceil_div(2 * units, max(self._frames, 1)) if self._frames < 2 * units else 1
        return min(max(ceil_div(self.samples, _STRIP), busy), max(self.samples // 128, 1))

    def _levels(self) -> list[Any]:
        """Return threshold, saturation and smallest peak level in the dtype of the frames."""
        readout, dtype = self.readout, self.build.dtype
        if dtype.kind == "f":
            saturation = np.inf if readout.saturation is None else readout.saturation
            weakest = -np.inf if readout.minimum_peak is None else readout.minimum_peak
            return [dtype.type(level) for level in (readout.threshold, saturation, weakest)]
        top = np.iinfo(dtype).max
        if readout.threshold != int(readout.threshold) or not 0 <= readout.threshold <= top:
            raise ValueError(
                f"LineReadout.threshold is {readout.threshold}, expected a whole number from 0 to {top} for {dtype} "
                "frames"
            )
        saturation = top if readout.saturation is None else math.ceil(readout.saturation)
        weakest = 0 if readout.minimum_peak is None else math.ceil(readout.minimum_peak)
        for name, level in (("saturation", saturation), ("minimum_peak", weakest)):
            if not 0 <= level <= top:
                raise ValueError(f"LineReadout.{name} is {level}, expected 0 to {top} for {dtype} frames")
        return [dtype.type(level) for level in (readout.threshold, saturation, weakest)]

    def _defines(self, profiles: ProfileCorrection | None) -> dict[str, Define]:
        """Return the build options of the samples, the method and the outputs."""
        readout, dtype = self.readout, self.build.dtype
        bits = 8 * dtype.itemsize
        defines = type_defines("CODE", dtype, 4, 8, 16) | {"CODE_BITS": bits}
        defines |= flags(**{f"METHOD_{readout.method.upper()}": True, f"SELECT_{readout.peak_selection.upper()}": True})
        chosen = readout.outputs or ()
        defines |= flags(**{f"WITH_{name.upper()}": True for name in chosen})
        if readout.triangulation is not None:
            # Random and systematic errors are separate outputs here.
            defines |= {"WITH_SHEET": None} | readout.triangulation.defines(self.build.real, profiles)
            defines.pop("SHEET_COVARIANCE", None)
        return defines | flags(
            ALONG_ROWS=readout.along == "rows",
            AMBIGUITY=readout.ambiguity is not None,
            CANDIDATES=self._has_candidates,
            WIDTH_LIMITS=self._limits_width,
            NOISE=any(name.startswith("sigma") for name in chosen),
            COUNT_WIDTH="width" in chosen or (readout.method == "centroid" and self._limits_width),
            LONG_MOMENT=bits < 32 and self.length**2 // 2 * np.iinfo(f"uint{bits}").max >= 2**32,
        )

    def _work_defines(self, work: WorkSize) -> dict[str, Define]:
        """Return the build options of the kernel variant and of the size of the frames."""
        return self._window_defines(vectors=work.vectors) | flags(
            PREFETCH=work.vectors and self._is_from_memory,
            ITEM_PER_PROFILE=self._is_narrow and not self._has_candidates,
        )

    @property
    def _is_from_memory(self) -> bool:
        """Whether a walk down columns of bytes prefetches each cache line, because the caches do not hold the frames.

        Measured: 10 to 20 % less time for 32 MiB of frames, 3 to 6 % more for 8 MiB; wider samples lose by it.
        """
        of_bytes = self.build.dtype.itemsize == 1 and self.readout.along == "columns"
        return of_bytes and self._moved > self.build.device.cache_bytes // 2

    def _window_defines(self, *, vectors: bool) -> dict[str, Define]:
        """Return the macros of the window.

        The window is an argument of the kernel where that costs nothing: in the vector variant of ``"windowed"`` down
        the columns. Elsewhere it is a constant of the build. Measured with an argument: 3 to 4 % more time for the
        fits, 9 % along rows; on GPUs the samples of the window lie in memory and not in registers.
        """
        readout = self.readout
        # The centroid method has no window, and only the FIR method has a filter: fewer builds for other values.
        half = readout.fir_length // 2 if readout.method == "fir" else 0
        if vectors and readout.method == "windowed" and readout.along == "columns":
            largest = _SMALL_WINDOW if readout.window <= _SMALL_WINDOW else WIDEST_WINDOW
            return {"MAX_RADIUS": largest, "WINDOW_ARGUMENT": None, "FIR_HALF": half}
        window = 1 if readout.method == "centroid" else readout.window
        return {"RADIUS": window, "MAX_RADIUS": window, "FIR_HALF": half}

    def _table(self) -> Any:
        """Return the parameter table of the kernel."""
        readout, real = self.readout, self.build.real
        widest = self.length if readout.maximum_width is None else min(readout.maximum_width, self.length)
        noise = readout.read_noise**2 + (1.0 / 12.0 if self.build.dtype.kind == "u" else 0.0)
        table = LineTable(
            min_width=min(readout.minimum_width, self.length + 1),
            max_width=widest,
            ambiguous_ratio=readout.ambiguity or 0.0,
            read_variance=readout.read_noise**2,
            gain=readout.gain,
            noise_variance=noise,
            lit_variance=noise + readout.gain * readout.threshold,
            speckle_variance=readout.speckle**2,
            minimum_total=_minimum_total(self.length, real, self.build.device),
        )
        return np.array(table, real)


class LineTable(NamedTuple):
    """Parameters of ``kernels/line/line.cl``, in the order of its struct ``LineTable``."""

    min_width: float
    max_width: float
    ambiguous_ratio: float
    read_variance: float
    gain: float
    noise_variance: float
    lit_variance: float
    speckle_variance: float
    minimum_total: float


def _minimum_total(length: int, real: np.dtype[Any], device: Device) -> float:
    """Return the smallest total light whose centroid is accurate to rounding.

    A device without denormal numbers takes each light below the smallest normal number as 0, which moves the moment by
    at most ``length**2 / 2`` of these numbers. Rounding of the position is ``length * 2**-24``.
    """
    if device.has_denormals or real == np.float64:
        return 0.0
    return length * 2.0**23 * float(np.finfo(real).tiny)
