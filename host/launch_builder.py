"""Builder of launch descriptions: the checks, types, macros and output specifications that all operations share."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.typing import DTypeLike

from gpuvision.host.device import Device
from gpuvision.host.launch import (
    Launch,
    Launchable,
    Precision,
    Shape,
    Spec,
    Variant,
    nbytes_of,
    real_defines,
    real_of,
    two_floats,
    uses_vectors,
)
from gpuvision.host.program import Define
from gpuvision.host.tuned_settings import settings_for
from gpuvision.host.work_size import (
    WorkSize,
    ceil_div,
    fitted_groups,
    group_per_element,
    padded_groups,
    strided_groups,
    vector_work,
)

Grouping = Literal["padded", "fitted", "strided", "per_element"]
_GROUPINGS = {
    "padded": padded_groups,
    "fitted": fitted_groups,
    "strided": strided_groups,
    "per_element": group_per_element,
}

# Fewest bytes of a stream whose launches waiting workers share: one core moves them in 10 us, a launch takes 2 us.
_TEAM_BYTES = 256 << 10
# Least rows and columns of an image whose last axis of 3 or 4 is taken for colours. Chosen: smaller images are rare,
# and so are larger batches of frames of 3 or 4 columns.
_FEWEST_PIXELS = 16

_OPENCL_TYPES = {
    "int8": "char",
    "uint8": "uchar",
    "int16": "short",
    "uint16": "ushort",
    "int32": "int",
    "uint32": "uint",
    "int64": "long",
    "uint64": "ulong",
    "float32": "float",
    "float64": "double",
}


class LaunchBuilder:
    """Builder of the `Launch` of an operation for a first input of one shape and dtype.

    Parameters
    ----------
    operation : Operation
        The operation that the launch is for.
    device : Device
    shape : tuple of int
    dtype : numpy.dtype
        Shape and dtype of the first input.
    precision : {"single", "double", None}
        Real type that the user asks for; see `real_of`.
    narrows : bool
        Whether "single" takes float64 input; see `real_of`.
    variant : {"auto", "vector", "work_item"}
        Kernel variant that the user asks for.
    name : str, optional
        Name of the operation in messages; ``None``: the name of its class.
    """

    def __init__(
        self,
        operation: Launchable,
        device: Device,
        shape: Shape,
        dtype: np.dtype[Any],
        *,
        precision: Precision = None,
        narrows: bool = False,
        variant: Variant = "auto",
        name: str | None = None,
    ) -> None:
        self.name = type(operation).__name__ if name is None else name
        self.device, self.shape, self.dtype = device, shape, dtype
        self._precision, self._narrows, self._variant = precision, narrows, variant
        self._settings = settings_for(operation, device, shape, dtype)

    @functools.cached_property
    def real(self) -> np.dtype[Any]:
        """Floating-point type of the arithmetic and the outputs.

        Raises
        ------
        TypeError, ValueError
            The operation does not take float64 input in single precision, or the device has no double precision.
        """
        if self.dtype == np.float64 and not self.device.has_double:
            raise ValueError(
                f"{self.name}: device {self.device.label} has no double precision and reads no float64 input; "
                "give float32 input (array.astype(np.float32))"
            )
        return real_of(self._precision, self.dtype, narrows=self._narrows)

    @property
    def widest(self) -> np.dtype[Any]:
        """Widest floating-point type of the device."""
        return np.dtype(np.float64 if self.device.has_double else np.float32)

    @functools.cached_property
    def doubles_positions(self) -> bool:
        """Whether kernels keep positions in double precision; otherwise they keep two floats (``two_float.h``).

        In double-precision work, and in single-precision work where doubles are fast. The vector variant runs on CPUs,
        whose doubles are fast: it reads float64 input in doubles only.
        """
        reads_doubles = self.dtype == np.float64 and self.uses_vectors
        return self.real == np.float64 or reads_doubles or self.device.has_fast_double

    @property
    def position_defines(self) -> dict[str, Define]:
        """Macros that select the type of positions, for ``common/places.h``."""
        return flags(DOUBLE_POSITIONS=self.doubles_positions, TWO_FLOAT_POSITIONS=not self.doubles_positions)

    def positions(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.floating[Any]]:
        """Return a table of positions in the type of the kernel: float64, or pairs of float32 along a new last axis."""
        return values if self.doubles_positions else two_floats(values)

    @functools.cached_property
    def uses_vectors(self) -> bool:
        """Whether the vector variant runs on this device."""
        variant = self._settings.variant if self._variant == "auto" else None
        return uses_vectors(variant or self._variant, self.device)

    def check_dtype(self, *names: str, of: str) -> None:
        """Check that the first input has one of these dtypes and that the device reads it.

        Raises
        ------
        TypeError
            The dtype is not among `names`.
        ValueError
            The kernel reads float64 and the device has no double precision.
        """
        if self.dtype.name not in names:
            raise TypeError(f"{self.name} takes {_or(names)} {of}, got {self.dtype}")
        if self._narrows and self.dtype == np.float64 and not self.device.has_double:
            raise ValueError(f"device {self.device.label} has no double precision; give {of} as float32")

    def check_shape(self, is_valid: bool, expected: str) -> None:
        """Raise a ValueError that names the expected input where the shape is not valid."""
        if not is_valid:
            raise ValueError(f"{self.name} takes {expected}, got shape {self.shape}")

    def check_no_colour(self, of: str) -> None:
        """Raise a ValueError where the last three axes are rows, columns and colours instead of a batch of frames."""
        if len(self.shape) >= 3 and self.shape[-1] in (3, 4) and min(self.shape[-3:-1]) >= _FEWEST_PIXELS:
            raise ValueError(
                f"{self.name} takes {of} of one channel, got shape {self.shape}: its last axis looks like colours"
            )

    def work(self, count: int, *, each: int, group: int, least: int = 0, grouping: Grouping = "padded") -> WorkSize:
        """Return the work size for `count` elements in the kernel variant that runs on this device.

        Parameters
        ----------
        count : int
        each : int
            Elements of one work-item of the vector variant.
        group : int
            Work-group size of the other variant.
        least : int
            Fewest elements for the vector variant. Default 0.
        grouping : {"padded", "fitted", "strided", "per_element"}
            Work-groups of the other variant: `padded_groups`, `fitted_groups`, `strided_groups` or
            `group_per_element`.

        Notes
        -----
        Tuned settings replace `each` and `group`.
        """
        if self.uses_vectors and count >= least:
            return vector_work(count, self.tuned_strip(each))
        return _GROUPINGS[grouping](count, self.tuned_group(group))

    def tuned_strip(self, default: int) -> int:
        """Return the elements of one work-item of the vector variant: tuned for this device, or the default."""
        return self._settings.strip or default

    def tuned_group(self, default: int) -> int:
        """Return the work-group size of the work-item variant: tuned for this device, or the default."""
        return self._settings.group or default

    def share(self, count: int, *, per_core: int, multiple: int = 1) -> int:
        """Return the elements of one share, a multiple of a number, when each core gets `per_core` shares."""
        return ceil_div(count, per_core * multiple * self.device.compute_units) * multiple

    def outputs(self, shapes: Mapping[str, Shape | None], **types: DTypeLike) -> dict[str, Spec | None]:
        """Return the specifications of the outputs, in the kernel's order.

        Parameters
        ----------
        shapes : mapping of str to tuple of int or None
            Shape of each field of the result; ``None``: not computed.
        **types : dtype
            Dtypes of fields. A field that is not named here has the real type; ``status`` has uint8.
        """
        kinds: dict[str, DTypeLike] = {"status": np.uint8, **types}
        return {
            name: None if shape is None else (shape, np.dtype(kinds.get(name, self.real)))
            for name, shape in shapes.items()
        }

    def launch(
        self,
        source: str,
        kernel: str,
        *,
        work: WorkSize,
        outputs: Mapping[str, Spec | None],
        more_inputs: Sequence[Spec] = (),
        defines: Mapping[str, Define] | None = None,
        arguments: Sequence[Any] = (),
        passes_once: bool = False,
        problem_per_group: bool = False,
        streams: bool = False,
        by_team: bool = False,
    ) -> Launch:
        """Return the launch; add the macros of the real type and of the kernel variant.

        Parameters
        ----------
        source, kernel, outputs, arguments, passes_once, problem_per_group
            As in `Launch`.
        work : WorkSize
        more_inputs : sequence of (shape, dtype)
            Inputs after the first one.
        defines : mapping
            Macros in addition to the macros of the real type and of the kernel variant.
        streams : bool
            As in `Launch`. The vector variant of such a kernel writes past the caches of a CPU (macro ``PAST_CACHES``)
            when the launch moves more bytes than the last cache holds. Default False.
        by_team : bool
            As in `Launch`, for the vector variant. A kernel that streams shares no launch of fewer than 256 KiB, and
            none that writes past the caches. Default False.

        Raises
        ------
        ValueError
            The device has no double precision.
        """
        inputs = [(self.shape, self.dtype), *more_inputs]
        moved = nbytes_of((*inputs, *outputs.values()))
        past_caches = streams and work.vectors and self.device.is_cpu and moved > self.device.cache_bytes
        variant = flags(VECTOR_VARIANT=work.vectors, PAST_CACHES=past_caches)
        return Launch(
            source=source,
            kernel=kernel,
            inputs=inputs,
            outputs=outputs,
            global_size=work.global_size,
            local_size=work.local_size,
            defines={**real_defines(self.device, self.real), **variant, **(defines or {})},
            arguments=arguments,
            passes_once=passes_once,
            streams=streams,
            problem_per_group=problem_per_group,
            inline=self._settings.inline,
            by_team=by_team and work.vectors and not past_caches and not (streams and moved < _TEAM_BYTES),
        )


def flags(**present: bool) -> dict[str, Define]:
    """Return macros without a value for the names that are true."""
    return {name: None for name, is_present in present.items() if is_present}


def opencl_type(dtype: DTypeLike) -> str:
    """Return the OpenCL C name of a NumPy dtype: ``float32`` is ``float``, ``uint8`` is ``uchar``.

    Raises
    ------
    TypeError
        OpenCL C has no such scalar type.
    """
    name = np.dtype(dtype).name
    if name not in _OPENCL_TYPES:
        raise TypeError(f"OpenCL C has no type for dtype {name}; expected one of {_or(_OPENCL_TYPES)}")
    return _OPENCL_TYPES[name]


def type_defines(name: str, dtype: DTypeLike, *lanes: int) -> dict[str, Define]:
    """Return macros for the OpenCL type of a dtype: `name`, and the vector types `name` with each width appended."""
    word = opencl_type(dtype)
    return {name: word, **{f"{name}{width}": f"{word}{width}" for width in lanes}}


def table_offsets(prefix: str, sizes: Mapping[str, int]) -> dict[str, Define]:
    """Return macros for the offsets of named parts in a table of numbers, so that a kernel reads them by name.

    Parameters
    ----------
    prefix : str
        Start of each macro's name.
    sizes : mapping of str to int
        Name and number of numbers of each part, in the order of the table.

    Returns
    -------
    dict
        ``PREFIX_NAME``: offset of the part; ``PREFIX_SIZE``: numbers in all.

    Examples
    --------
    >>> table_offsets("NODE", {"centre": 3, "radius": 1})
    {'NODE_CENTRE': 0, 'NODE_RADIUS': 3, 'NODE_SIZE': 4}
    """
    ends = list(itertools.accumulate(sizes.values(), initial=0))
    names = [f"{prefix}_{name.upper()}" for name in (*sizes, "size")]
    return dict(zip(names, ends, strict=True))


def _or(names: Iterable[str]) -> str:
    """Return names as an enumeration: ``a, b or c``."""
    *before, last = names
    return f"{', '.join(before)} or {last}" if before else last
