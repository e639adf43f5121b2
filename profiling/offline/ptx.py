"""Parser of PTX, NVIDIA's virtual machine code, as far as the compiler writes it for the kernels."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple


class Parameter(NamedTuple):
    """Parameter of a kernel: name and PTX type (``u64``: a pointer or a 64-bit number)."""

    name: str
    type: str


class Instruction(NamedTuple):
    """One instruction: guard predicate ("" without one), its negation, opcode with suffixes, operands."""

    guard: str
    negated: bool
    opcode: tuple[str, ...]
    operands: tuple[str, ...]


@dataclass(frozen=True)
class PtxKernel:
    """Kernel function.

    Attributes
    ----------
    name : str
    parameters : tuple of Parameter
    code : tuple of Instruction
    labels : dict of str to int
        Index of the instruction after each label.
    shared, stack : dict of str to int
        Bytes of each array in local memory (PTX: ``.shared``), and of each array in private memory (``.local``).
    """

    name: str
    parameters: tuple[Parameter, ...]
    code: tuple[Instruction, ...]
    labels: dict[str, int]
    shared: dict[str, int]
    stack: dict[str, int]


_ENTRY = re.compile(r"\.entry (\w+)\((.*?)\)\s*(?:\.\w+[^{]*)?\{(.*?)^\}", re.DOTALL | re.MULTILINE)
_PARAMETER = re.compile(r"\.param \.(\w+)[^,]*?(\w+)\s*(?:,|$)", re.MULTILINE)
_ARRAY = re.compile(r"\.(shared|local)\s+\.align \d+ \.b8\s+([\w$.]+)\[(\d+)\]")
_GUARD = re.compile(r"@(!?)(%p\d+)\s+")
_OPERAND = re.compile(r"\{[^}]*\}|\[[^\]]*\]|[^,\s][^,]*")


def parse_kernel(text: str, name: str) -> PtxKernel:
    """Parse one kernel function of a PTX module.

    Raises
    ------
    ValueError
        The module has no such kernel.
    """
    entry = next((found for found in _ENTRY.finditer(text) if found[1] == name), None)
    if entry is None:
        raise ValueError(f"the module has no kernel {name}")
    arrays: dict[str, dict[str, int]] = {"shared": {}, "local": {}}
    for space, array, size in _ARRAY.findall(text[: entry.start()] + entry[3]):
        arrays[space][array] = int(size)
    parameters = tuple(Parameter(found[1], found[0]) for found in _PARAMETER.findall(entry[2]))
    code: list[Instruction] = []
    labels: dict[str, int] = {}
    for line in re.sub(r"//[^\n]*", "", entry[3]).splitlines():
        stripped = line.strip()
        if stripped.endswith(":"):
            labels[stripped[:-1]] = len(code)
        elif stripped and not stripped.startswith("."):
            code.append(_instruction(stripped.rstrip(";")))
    return PtxKernel(name, parameters, tuple(code), labels, arrays["shared"], arrays["local"])


def _instruction(text: str) -> Instruction:
    guard = _GUARD.match(text)
    opcode, _, rest = text[guard.end() if guard else 0 :].strip().partition(" ")
    opcode, _, tabbed = opcode.partition("\t")
    operands = tuple(each.strip() for each in _OPERAND.findall(f"{tabbed} {rest}"))
    return Instruction(guard[2] if guard else "", bool(guard and guard[1]), tuple(opcode.split(".")), operands)
