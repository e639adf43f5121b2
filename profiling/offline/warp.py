"""Interpreter of PTX for one work-group: results, and the memory requests of its warps.

All work-items of a group run in step: the instruction with the smallest index among the next ones of all items runs for
the items that are there. In code that a compiler wrote in the order of its blocks, the items of a warp that part at a
branch meet again where its paths meet.

The interpreter checks that each access lies within one array of global or local memory, its alignment, and that all
work-items of the group reach the same barrier. The compiler joins the private arrays of a kernel to one block: an
access beyond one of them that stays within the block is not found. Because the items run in step, neither a data race
nor a missing barrier shows. The fused multiply-add of doubles rounds twice.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpuvision.profiling.offline.ptx import Instruction, PtxKernel
from gpuvision.profiling.offline.ptx_operations import DTYPES, Values, compute

WARP = 32  # work-items of a warp
SECTOR = 32  # bytes that a request moves at least: a part of a cache line
_ALIGNED = 512  # bytes between arrays, and the alignment of an array
_SHARED, _STACK = 1 << 40, 1 << 41  # addresses of local memory and of private memory
_MOST_STEPS = 5_000_000
_REGISTERS = {"p": bool, "rs": np.uint16, "r": np.uint32, "f": np.float32, "rd": np.uint64, "fd": np.float64}
_REGISTER = re.compile(r"%(p|rs|rd|fd|r|f|h|SP)(L?\d*)$")
_HEX_FLOAT = re.compile(r"0([fFdD])([0-9a-fA-F]+)$")


@dataclass(frozen=True)
class Requests:
    """Memory requests of warps to an array, all of one kind.

    Attributes
    ----------
    count : int
        Requests: one for each warp and executed instruction.
    sectors : int
        Sectors of 32 bytes that the requests touch.
    least : int
        Sectors that hold the requested bytes if they are adjacent.
    nbytes : int
        Requested bytes; bytes that several work-items of a request read count once.
    """

    count: int = 0
    sectors: int = 0
    least: int = 0
    nbytes: int = 0

    @property
    def factor(self) -> float:
        """Coalescing factor: touched sectors over the least sectors; 1 is the best."""
        return self.sectors / self.least if self.least else 1.0

    def __add__(self, other: Requests) -> Requests:
        return Requests(
            self.count + other.count,
            self.sectors + other.sectors,
            self.least + other.least,
            self.nbytes + other.nbytes,
        )


class Blocks:
    """Local or private memory of a group: blocks with gaps between them.

    Parameters
    ----------
    start : int
        Address of the memory.
    sizes : dict of str to int
        Bytes of each block.
    shape : tuple of int
        Axes before the bytes: the number of work-items for private memory.
    """

    def __init__(self, start: int, sizes: dict[str, int], shape: tuple[int, ...] = ()) -> None:
        self.start = start
        self.places: dict[str, int] = {}
        self._bounds: list[tuple[int, int]] = []
        end = start
        for name, nbytes in sizes.items():
            self.places[name] = end
            self._bounds.append((end, end + nbytes))
            end = (-(-(end + nbytes) // _ALIGNED) + 1) * _ALIGNED
        self.data: Values = np.zeros((*shape, end - start), np.uint8)

    def check(self, addresses: Values, size: int) -> None:
        """Check that each access lies within one block.

        Raises
        ------
        IndexError
            A block ends before `size` bytes at one of the addresses.
        """
        inside = np.zeros(addresses.size, bool)
        for begin, end in self._bounds:
            inside |= (addresses >= begin) & (addresses + size <= end)
        if not inside.all():
            wrong = int(addresses[~inside][0]) - self.start
            raise IndexError(f"access of {size} bytes at {wrong}, beyond the arrays {sorted(self.places)}")


class Memory:
    """Global memory: arrays with gaps between them.

    Attributes
    ----------
    arrays : dict of str to (int, numpy.ndarray)
        Address and bytes of each array, by name.
    requests : dict of (str, str) to Requests
        By array and "load" or "store".
    """

    def __init__(self) -> None:
        self.arrays: dict[str, tuple[int, Values]] = {}
        self.requests: dict[tuple[str, str], Requests] = {}
        self._end = _ALIGNED

    def add(self, name: str, array: Values, offset: int = 0) -> int:
        """Add an array, `offset` bytes after an aligned address; return its address. Kernels change it in place."""
        address = self._end + offset
        self.arrays[name] = (address, array.reshape(-1).view(np.uint8))
        self._end = (-(-(address + array.nbytes) // _ALIGNED) + 1) * _ALIGNED
        return address

    def find(self, address: int, size: int) -> tuple[str, int, Values]:
        """Return name, address and bytes of the array that holds `size` bytes at an address.

        Raises
        ------
        IndexError
            No array holds them.
        """
        for name, (start, data) in self.arrays.items():
            if start <= address and address + size <= start + data.size:
                return name, start, data
        raise IndexError(f"access of {size} bytes at address {address}, beyond the arrays {sorted(self.arrays)}")

    def count(self, name: str, kind: str, addresses: Values, items: Values, size: int) -> None:
        """Count the requests of all warps that one instruction makes."""
        found = self.requests.get((name, kind), Requests())
        for warp in np.unique(items // WARP):
            touched = np.unique(addresses[items // WARP == warp][:, None] + np.arange(size))
            least = -(-touched.size // SECTOR)
            found += Requests(1, int(np.unique(touched // SECTOR).size), least, touched.size)
        self.requests[name, kind] = found


class Group:
    """Work-group of a kernel.

    Parameters
    ----------
    kernel : PtxKernel
    memory : Memory
    arguments : sequence of int or float
        Values of the parameters; addresses of arrays.
    group, groups, size : tuple of int
        Index of the group, number of groups, and work-items of a group, along x, y and z.
    """

    def __init__(
        self,
        kernel: PtxKernel,
        memory: Memory,
        arguments: Sequence[float],
        *,
        group: tuple[int, int, int],
        groups: tuple[int, int, int],
        size: tuple[int, int, int],
    ) -> None:
        self._kernel, self._memory = kernel, memory
        self._arguments = {
            each.name: (value, each.type) for each, value in zip(kernel.parameters, arguments, strict=True)
        }
        self._items = np.arange(int(np.prod(size)))
        x, y, z = self._items % size[0], self._items // size[0] % size[1], self._items // (size[0] * size[1])
        axes = "xyz"
        self._special: dict[str, Values] = {f"%tid.{axis}": each for axis, each in zip(axes, (x, y, z), strict=True)}
        for name, numbers in (("ntid", size), ("ctaid", group), ("nctaid", groups)):
            self._special |= {
                f"%{name}.{axis}": np.full(x.size, each) for axis, each in zip(axes, numbers, strict=True)
            }
        self._registers: dict[str, Values] = {}
        self._shared = Blocks(_SHARED, kernel.shared)
        self._stack = Blocks(_STACK, kernel.stack, (x.size,))
        self._places = self._shared.places | self._stack.places

    def run(self) -> None:
        """Run all work-items to their end.

        Raises
        ------
        IndexError, ValueError
            An access beyond the arrays, or at an address that is not aligned to its size: a GPU stops there. Or a
            barrier that not all work-items reach.
        NotImplementedError
            The interpreter does not know an instruction.
        """
        code = self._kernel.code
        at = np.zeros(self._items.size, np.int64)
        waits = np.zeros(at.size, bool)
        for _ in range(_MOST_STEPS):
            ready = (at < len(code)) & ~waits
            if not ready.any():
                if not waits.any():
                    return
                if not waits.all() or np.unique(at).size > 1:
                    raise ValueError(f"{self._kernel.name}: {int(waits.sum())} of {at.size} work-items reach a barrier")
                waits[:] = False
                continue
            index = int(at[ready].min())
            here = np.flatnonzero(ready & (at == index))
            step = code[index]
            holds = self._register(step.guard)[here] != step.negated if step.guard else np.ones(here.size, bool)
            at[here] = index + 1
            chosen = here[holds]
            if chosen.size:
                self._execute(step, chosen, at, waits)
        raise RuntimeError(f"{self._kernel.name} does not end within {_MOST_STEPS} steps")

    def _execute(self, step: Instruction, items: Values, at: Values, waits: Values) -> None:
        name = step.opcode[0]
        if name == "bra":
            at[items] = self._kernel.labels[step.operands[0]]
        elif name in ("ret", "exit"):
            at[items] = len(self._kernel.code)
        elif name in ("bar", "barrier"):
            waits[items] = True
        elif name == "ld":
            self._load(step, items)
        elif name == "st":
            self._store(step, items)
        elif name == "mov" and (step.operands[0].startswith("{") or step.operands[1].startswith("{")):
            self._repack(step, items)
        else:
            self._compute(step, items)

    def _compute(self, step: Instruction, items: Values) -> None:
        words = step.opcode
        given = []
        for number, operand in enumerate(step.operands[1:]):
            kind = words[-1]
            if words[0] in ("shl", "shr") and number == 1:
                kind = "u32"
            elif (words[0] in ("selp", "setp")) and number == 2:
                kind = "pred"
            elif words[0] == "mad" and "wide" in words and number == 2:
                kind = f"{kind[0]}{2 * int(kind[1:])}"
            given.append(self._value(operand, kind, items))
        with np.errstate(all="ignore"):
            self._assign(step.operands[0], items, compute(words, given))

    def _register(self, name: str) -> Values:
        if name not in self._registers:
            found = _REGISTER.match(name)
            if found is None:
                raise NotImplementedError(f"PTX register {name}")
            kind = np.uint64 if found[1] == "SP" else _REGISTERS[found[1]]
            self._registers[name] = np.zeros(self._items.size, kind)
        return self._registers[name]

    def _value(self, operand: str, kind: str, items: Values) -> Values:
        """Return an operand of the chosen work-items as numbers of a type."""
        dtype = DTYPES[kind]
        if operand in self._special:
            return self._special[operand][items].astype(dtype)
        if operand in self._places:
            return np.full(items.size, self._places[operand], dtype)
        if operand.startswith("%"):
            value = self._register(operand)[items]
            if value.dtype == dtype:
                return value
            if dtype.kind == "b" or value.dtype.kind == "b":
                return value.astype(dtype)
            if value.dtype.itemsize > dtype.itemsize:  # the low bits
                value = value.view(f"u{value.dtype.itemsize}").astype(f"u{dtype.itemsize}")
            return value.view(dtype) if value.dtype.itemsize == dtype.itemsize else value.astype(dtype)
        number = _HEX_FLOAT.match(operand)
        if number:
            bits = np.array(int(number[2], 16), np.uint32 if number[1] in "fF" else np.uint64)
            return np.full(items.size, bits).view(np.float32 if number[1] in "fF" else np.float64)
        mask = (1 << (8 * dtype.itemsize)) - 1
        unsigned = np.array(int(operand, 0) & mask, f"u{dtype.itemsize}")
        return np.full(items.size, operand != "0") if dtype.kind == "b" else np.full(items.size, unsigned).view(dtype)

    def _assign(self, name: str, items: Values, value: Values) -> None:
        register = self._register(name)
        if register.dtype.kind == "b" or value.dtype.kind == "b":
            register[items] = value.astype(register.dtype)
        elif register.dtype.itemsize == value.dtype.itemsize:
            register[items] = value.view(register.dtype)
        else:  # a narrow result fills its register with zeros or its sign
            kind = value.dtype.kind.replace("f", "u")
            register[items] = value.astype(f"{kind}{register.dtype.itemsize}").view(register.dtype)

    def _repack(self, step: Instruction, items: Values) -> None:
        """Split a register into parts, or join parts."""
        target, source = step.operands
        bits = int(step.opcode[-1][1:])
        names = re.findall(r"[%\w.]+", target if target.startswith("{") else source)
        part = f"b{bits // len(names)}"
        if target.startswith("{"):
            whole = np.ascontiguousarray(self._value(source, f"b{bits}", items)).view(DTYPES[part])
            for number, name in enumerate(names):
                self._assign(name, items, np.ascontiguousarray(whole.reshape(items.size, -1)[:, number]))
        else:
            parts = np.stack([self._value(each, part, items) for each in names], 1)
            self._assign(target, items, np.ascontiguousarray(parts).view(DTYPES[f"b{bits}"]).reshape(-1))

    def _addresses(self, operand: str, items: Values) -> Values:
        base, _, more = operand.strip("[]").partition("+")
        return self._value(base.strip(), "u64", items).astype(np.int64) + (int(more) if more else 0)

    def _load(self, step: Instruction, items: Values) -> None:
        names = re.findall(r"[%\w]+", step.operands[0])
        dtype = DTYPES[step.opcode[-1]]
        if step.opcode[1] == "param":
            name, offset, _ = step.operands[1].strip("[]").partition("+")
            if offset:
                raise NotImplementedError(f"PTX instruction {'.'.join(step.opcode)} of a part of a parameter")
            value, _ = self._arguments[name]
            self._assign(names[0], items, np.full(items.size, np.array(value).astype(dtype)))
            return
        size = dtype.itemsize * len(names)
        data = self._access(step, items, size, None).view(dtype).reshape(items.size, len(names))
        for number, name in enumerate(names):
            self._assign(name, items, np.ascontiguousarray(data[:, number]))

    def _store(self, step: Instruction, items: Values) -> None:
        names = re.findall(r"[%\w]+", step.operands[1])
        values = np.stack([self._value(each, step.opcode[-1], items) for each in names], 1)
        data = np.ascontiguousarray(values).view(np.uint8).reshape(items.size, -1)
        self._access(step, items, data.shape[1], data)

    def _access(self, step: Instruction, items: Values, size: int, data: Values | None) -> Values:
        """Read `size` bytes for each work-item, or write them; count requests to global memory."""
        addresses = self._addresses(step.operands[0 if data is not None else 1], items)
        if (addresses % size).any():
            raise ValueError(f"{'.'.join(step.opcode)}: address not aligned to {size} bytes")
        every = np.arange(size)
        if int(addresses[0]) >= _STACK:
            self._stack.check(addresses, size)
            place: Any = (items[:, None], addresses[:, None] - _STACK + every)
            memory: Values = self._stack.data
        elif int(addresses[0]) >= _SHARED:
            self._shared.check(addresses, size)
            place, memory = addresses[:, None] - _SHARED + every, self._shared.data
        else:
            name, start, memory = self._memory.find(int(addresses.min()), size)
            if int(addresses.max()) + size > start + memory.size:
                raise IndexError(f"access of {size} bytes at {int(addresses.max()) - start} of {name}")
            place = addresses[:, None] - start + every
            if step.opcode[1] != "const":
                self._memory.count(name, "load" if data is None else "store", addresses, items, size)
        if data is None:
            return np.ascontiguousarray(memory[place])
        memory[place] = data
        return data
