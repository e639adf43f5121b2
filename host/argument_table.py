"""Kernel arguments in a table in memory: a runtime sets one argument per launch instead of twenty.

A launch in the calling thread takes 0.8 us on PoCL and 1.3 us on Intel's runtime, and each array among its arguments
0.04 and 0.1 us more, each number on PoCL 0.03 us: as much again for a kernel with 30 arguments. On a CPU that uses the
memory of the host, the kernel reads addresses and numbers from memory itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl

from gpuvision.host.arrays import DeviceArray, HostArray, host_view, launch_memory, memory_of

# Attributes of a kernel are macros before and after the word `kernel`.
_KERNEL = r"^(?P<attributes>[ \w]*)\bkernel\b(?P<more>[ \w]*)\bvoid\s+{name}\s*\("
_FUNCTION = r"\bvoid\s+{name}\s*\("
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_NOT_SPACE = re.compile(r"\S")
_DIRECTIVE = re.compile(r"^[ \t]*#.*$", re.MULTILINE)
_MACRO = re.compile(r"[A-Z][A-Z_0-9]*")
_TEAM = "TEAM_ARGUMENTS"  # of kernels/common/team.h: these arguments stay apart
SIZE_MACRO = "ARGUMENT_TABLE_BYTES"  # of the build: size of the table
# The kernel gets its parameters as a function; the parameters are also the members of a structure.
_WRAPPER = """\
static inline __attribute__((always_inline)) void {name}_work({parameters} {team});
typedef struct {{{members};}} {name}_table;
_Static_assert(sizeof({name}_table) == {size}, "the arguments of the launch and the parameters of the kernel differ");
{attributes} kernel {more} void {name}(global const uchar *bytes {team}) {{
    global const {name}_table *table = (global const {name}_table *)bytes;
    {name}_work({values}
{team_values}    );
}}
static inline __attribute__((always_inline)) void {name}_work({parameters} {team}"""
_TEAM_VALUES = "#ifdef TEAM\n        , team, poll_limit\n#endif\n"


def takes_table(text: str, kernel: str) -> bool:
    """Return whether `with_argument_table` can change a kernel.

    Each variant must declare its parameters without macros and parentheses, and none in local memory.
    """
    found = list(_declarations(text, kernel))
    variants = len(re.findall(_FUNCTION.format(name=re.escape(kernel)), text))
    return 0 < len(found) == variants and all(
        _is_plain(each) for declaration in found for each in declaration.parameters
    )


def _is_plain(parameter: str) -> bool:
    """Return whether a parameter is a number or a pointer that can be a member of a structure."""
    declaration = _DIRECTIVE.sub("", parameter)
    words = declaration.replace("*", " ").split()
    if "(" in parameter or len(words) < 2 or not re.fullmatch(r"[\w\s*]+", declaration):
        return False
    is_macro = any(map(_MACRO.fullmatch, (words[0], words[-1])))
    return not is_macro and not any(word in ("local", "__local") or word.startswith("image") for word in words[:-1])


def with_argument_table(text: str, kernel: str) -> str:
    """Return the text of a kernel file in which a kernel reads its arguments from a table.

    Parameters
    ----------
    text : str
        OpenCL C. Conditions of the preprocessor may stand between the parameters of the kernel.
    kernel : str
        Name of the kernel function. Each variant of it is changed.
    """
    parts, done = [], 0
    for declaration in _declarations(text, kernel):
        parts += [text[done : declaration.begin], declaration.wrapper(kernel)]
        done = declaration.end
    return "".join([*parts, text[done:]])


class _Declaration(NamedTuple):
    """Declaration of a kernel: its place in the text up to the closing parenthesis, and its parts."""

    begin: int
    end: int
    attributes: tuple[str, str]  # before and after the word `kernel`
    parameters: list[str]  # each with the directives of the preprocessor before it
    has_team: bool

    def wrapper(self, name: str) -> str:
        """Return a kernel that calls a function with the parameters, and the head of this function."""
        return _WRAPPER.format(
            name=name,
            size=SIZE_MACRO,
            attributes=self.attributes[0],
            more=self.attributes[1],
            parameters=",".join(self.parameters),
            members=";".join(self.parameters),
            values=",".join(map(_member, self.parameters)),
            team=_TEAM if self.has_team else "",
            team_values=_TEAM_VALUES if self.has_team else "",
        )


def _declarations(text: str, kernel: str) -> Iterator[_Declaration]:
    text = _COMMENT.sub(lambda comment: _NOT_SPACE.sub(" ", comment[0]), text)
    for start in re.finditer(_KERNEL.format(name=re.escape(kernel)), text, re.MULTILINE):
        end = text.index(")", start.end())
        parameters = text[start.end() : end]
        attributes = (start["attributes"], start["more"])
        yield _Declaration(
            start.start(), end, attributes, parameters.replace(_TEAM, "").split(","), _TEAM in parameters
        )


def _member(parameter: str) -> str:
    """Return the expression for a parameter, after the directives that stand before it."""
    before = "".join(f"\n{line}\n" for line in _DIRECTIVE.findall(parameter))
    return f"{before}table->{_DIRECTIVE.sub('', parameter).split()[-1].lstrip('*')}"


class NoAddressError(Exception):
    """The host does not know the address of an array: it is in an OpenCL buffer."""


class ArgumentTable:
    """Arguments of a kernel that `with_argument_table` changed.

    Parameters
    ----------
    device : Device
        CPU that shares the memory of the host.
    layout : numpy.dtype
        As `table_layout` returns it.
    arrays : int
        Number of the arrays, which are the first arguments. At first they are null pointers.
    others : sequence of numpy scalar, pyopencl.array.Array or None
        Arguments after the arrays: numbers, tables, and null pointers.

    Attributes
    ----------
    addresses : memoryview
        Addresses of the arrays, see `address_of`. Assigning to an element of a view takes less time than to one of a
        NumPy array.
    memory
        Memory object of the table: the argument of the kernel.
    """

    def __init__(self, device: Any, layout: np.dtype[Any], arrays: int, others: Sequence[Any]) -> None:
        array: DeviceArray = device.empty((layout.itemsize,), np.uint8)
        host_view(array).view(layout)[0] = (*[0] * arrays, *map(_word, others))
        self.addresses: memoryview = host_view(array)[: 8 * arrays].data.cast("Q")
        self.memory = launch_memory(device, array)
        self._array, self._others = array, others  # referenced as long as the kernel may read them


def table_layout(arrays: int, others: Iterable[Any]) -> np.dtype[Any]:
    """Return the type of a table: addresses of some arrays, then numbers and addresses.

    C aligns the members of a structure as NumPy does.
    """
    words: list[np.dtype[Any]] = [np.dtype(np.uint64)] * arrays
    words += [each.dtype if isinstance(each, np.generic) else np.dtype(np.uint64) for each in others]
    return np.dtype([(f"argument{number}", word) for number, word in enumerate(words)], align=True)


def _word(argument: Any) -> Any:
    """Return a number, or the address of an array: 0 for None and for an array without elements."""
    if isinstance(argument, np.generic):
        return argument
    return 0 if argument is None or not argument.size else address_of(argument)


def address_of(array: DeviceArray | HostArray) -> int:
    """Return the address of a whole array in the memory of the host.

    Raises
    ------
    NoAddressError
        The array is in an OpenCL buffer, or has no memory.
    ValueError
        As in `memory_of`.
    """
    if isinstance(array, np.ndarray):
        return int(array.ctypes.data)
    try:
        return int(memory_of(array).svm_ptr)
    except AttributeError:
        raise NoAddressError from None


def have_addresses(arrays: Iterable[DeviceArray]) -> bool:
    """Return whether the host knows the addresses of all arrays."""
    return all(isinstance(getattr(array, "base_data", None), cl.SVMPointer) for array in arrays)
