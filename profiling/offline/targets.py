"""GPUs that kernels are compiled for without the GPU: compilers, and the resources that a compiled kernel needs.

Clang (Debian ``clang-16``) compiles OpenCL C with the built-in functions of libclc. For NVIDIA it writes PTX, which
``ptxas`` (PyPI ``nvidia-cuda-nvcc-cu12``) compiles to machine code; for AMD it writes the machine code itself.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gpuvision.host.cache import cache_folder
from gpuvision.host.errors import GpuVisionError

CLANG = "clang-16"
_CLC_FOLDER = Path("/usr/lib/clc")
_CLANG_HINT = "install Debian's packages: apt-get install clang-16 libclc-16 (beside Mesa's OpenCL: libclc-15)"
_PTXAS_HINT = "install it: pip install 'gpuvision[offline]'"
_SECONDS = 120  # limit for one compiler call (chosen): the longest takes about 10 s


@dataclass(frozen=True)
class Target:
    """GPU that kernels are compiled for.

    Attributes
    ----------
    name : str
        Architecture: ``sm_90``, ``gfx90a``.
    vendor : {"nvidia", "amd"}
    example : str
        A product with this architecture.
    """

    name: str
    vendor: Literal["nvidia", "amd"]
    example: str

    @property
    def bitcode(self) -> Path:
        """Built-in functions of OpenCL C for this target."""
        return _CLC_FOLDER / ("nvptx64--nvidiacl.bc" if self.vendor == "nvidia" else "amdgcn--amdhsa.bc")

    @property
    def options(self) -> list[str]:
        """Options of Clang that select the target."""
        if self.vendor == "amd":
            return ["-target", "amdgcn-amd-amdhsa", f"-mcpu={self.name}", "-nogpulib"]
        features = ["-target-cpu", self.name, "-target-feature", "+ptx63" if self.name == "sm_70" else "+ptx78"]
        return ["-target", "nvptx64-nvidia-nvcl", *(word for each in features for word in ("-Xclang", each))]


TARGETS = {
    each.name: each
    for each in (
        Target("sm_70", "nvidia", "V100"),
        Target("sm_90", "nvidia", "H100"),
        Target("gfx90a", "amd", "MI200"),
        Target("gfx1100", "amd", "RX 7900"),
    )
}


@dataclass(frozen=True)
class Usage:
    """Resources of a compiled kernel.

    Attributes
    ----------
    kernel : str
        Name of the kernel function.
    registers : int
        Registers of a work-item (AMD: vector registers).
    stack : int
        Private memory of a work-item beside the registers, spills included [bytes].
    spills : int
        Stores and loads of spilled registers in the code [bytes] (AMD: spilled vector registers, 4 bytes each).
    local : int
        Local memory of a work-group [bytes].
    """

    kernel: str
    registers: int
    stack: int
    spills: int
    local: int


class CompilerError(GpuVisionError):
    """A kernel does not compile for a target within the time limit, or calls a function that has no body."""


def check_compilers(targets: Sequence[Target]) -> None:
    """Check that the compilers for targets are installed.

    Raises
    ------
    GpuVisionError
        A compiler is missing; the message says what to install.
    """
    if shutil.which(CLANG) is None:
        raise GpuVisionError(f"the compiler {CLANG} is missing; {_CLANG_HINT}")
    for target in targets:
        if not target.bitcode.is_file():
            raise GpuVisionError(f"the built-in functions {target.bitcode} are missing; {_CLANG_HINT}")
        if target.vendor == "nvidia" and find_ptxas() is None:
            raise GpuVisionError(f"NVIDIA's assembler ptxas is missing; {_PTXAS_HINT}")


def find_ptxas() -> str | None:
    """Return the path of NVIDIA's assembler: of the package of PyPI, else of a CUDA toolkit on PATH; None without."""
    spec = importlib.util.find_spec("nvidia")
    for folder in () if spec is None else spec.submodule_search_locations or ():
        for path in sorted(Path(folder).glob("*/bin/ptxas")):
            return str(path)
    return shutil.which("ptxas")


@functools.cache
def versions(target: Target) -> tuple[str, ...]:
    """Return the versions of the compilers for a target, and a digest of the built-in functions."""
    tools = [CLANG]
    if target.vendor == "nvidia":
        tools.append(find_ptxas() or "ptxas")
    lines = [_run([tool, "--version"]).stdout.strip().splitlines() for tool in tools]
    # Clang prints its version in the first line, ptxas in the last but one.
    numbers = [each[0] if number == 0 else each[-2] for number, each in enumerate(lines)]
    return (*numbers, f"libclc {hashlib.sha256(target.bitcode.read_bytes()).hexdigest()[:12]}")


def compile_text(text: str, options: Sequence[str], target: Target) -> list[Usage]:
    """Compile a kernel file for a target and return the resources of its kernels.

    Parameters
    ----------
    text : str
        OpenCL C with its headers.
    options : sequence of str
        Build options with the macros.
    target : Target

    Raises
    ------
    CompilerError
        The file does not compile, calls a function without a body, or keeps a compiler busy beyond the time limit.
    """
    assembly = compile_assembly(text, options, target)
    if target.vendor == "amd":
        return usage_of_amd(assembly)
    with tempfile.TemporaryDirectory(prefix="gpuvision-offline-") as folder:
        source = Path(folder, "kernel.ptx")
        source.write_text(assembly)
        command = [find_ptxas() or "ptxas", "-v", f"-arch={target.name}", "-o", str(Path(folder, "kernel.cubin"))]
        done = _run([*command, str(source)])
        if done.returncode:
            raise CompilerError(_first_errors(done.stderr))
        return usage_of_ptxas(done.stderr)


def compile_assembly(text: str, options: Sequence[str], target: Target) -> str:
    """Compile a kernel file for a target and return the assembly: PTX for NVIDIA.

    Parameters
    ----------
    text, options, target
        As for `compile_text`.

    Raises
    ------
    CompilerError
        The file does not compile, or keeps the compiler busy beyond the time limit.
    """
    with tempfile.TemporaryDirectory(prefix="gpuvision-offline-") as folder:
        source, assembly = Path(folder, "kernel.cl"), Path(folder, "kernel.s")
        source.write_text(text)
        builtins = ["-fdeclare-opencl-builtins", "-finclude-default-header", "-mlink-builtin-bitcode"]
        words = [word for each in (*builtins, str(target.bitcode)) for word in ("-Xclang", each)]
        # The bitcode was compiled for a triple of the same machine with another name.
        quiet = ["-Wno-linker-warnings", "-Wno-unused-command-line-argument"]
        languages = ["-x", "cl", "-cl-std=CL1.2", "-O3", "-S"]
        done = _run([CLANG, *languages, *target.options, *words, *quiet, *options, "-o", str(assembly), str(source)])
        if done.returncode:
            raise CompilerError(_first_errors(done.stderr))
        return assembly.read_text()


def cache_path(text: str, options: Sequence[str], target: Target, suffix: str) -> Path:
    """Return the path of the cache file of a compiled kernel: a digest of text, options and compilers."""
    key = json.dumps([text, options, target.name, target.options, versions(target)])
    return cache_folder() / "offline" / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}{suffix}"


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)
    except subprocess.TimeoutExpired as expired:
        raise CompilerError(f"{Path(command[0]).name} did not finish within {_SECONDS} s") from expired


def _first_errors(log: str) -> str:
    """Return the first errors of a compiler's log in one line."""
    lines = [line.strip() for line in log.splitlines() if re.search(r"error|fatal|unresolved", line, re.IGNORECASE)]
    return "; ".join(lines[:3]) or log.strip().replace("\n", "; ") or "the compiler failed without a message"


_ENTRY = re.compile(r"Compiling entry function '(\w+)'")
_FRAME = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
_USED = re.compile(r"Used (\d+) registers")
_CUMULATIVE = re.compile(r"(\d+) bytes cumulative stack size")
_SHARED = re.compile(r"(\d+) bytes smem")


def usage_of_ptxas(log: str) -> list[Usage]:
    """Return the resources that ``ptxas -v`` reports.

    A function that is not inlined has a separate stack frame; the cumulative stack size includes it.
    """
    found = []
    _, *parts = re.split(r"(?=Compiling entry function)", log)
    for part in parts:
        name, used = _ENTRY.search(part), _USED.search(part)
        assert name is not None
        assert used is not None
        frames = [tuple(map(int, each)) for each in _FRAME.findall(part)]
        cumulative, shared = _CUMULATIVE.search(part), _SHARED.search(part)
        stack = int(cumulative[1]) if cumulative else max((frame for frame, _, _ in frames), default=0)
        spills = sum(stores + loads for _, stores, loads in frames)
        found.append(Usage(name[1], int(used[1]), stack, spills, int(shared[1]) if shared else 0))
    return found


_LABEL = re.compile(r"^(\w+):", re.MULTILINE)
_REFERENCE = re.compile(r"\b(\w+)@(?:got|rel)")
_KERNEL = re.compile(r"^  - .*?(?=^  - |^amdhsa\.\w+:)", re.MULTILINE | re.DOTALL)


def usage_of_amd(assembly: str) -> list[Usage]:
    """Return the resources in the metadata of AMD's assembly.

    Raises
    ------
    CompilerError
        The code calls a function without a body, which only a linker would report.
    """
    missing = sorted(set(_REFERENCE.findall(assembly)) - set(_LABEL.findall(assembly)))
    if missing:
        raise CompilerError(f"unresolved function {', '.join(missing)}")
    _, _, metadata = assembly.partition("amdhsa.kernels:")
    return [_amd_usage(part) for part in _KERNEL.findall(metadata) if ".name:" in part and ".vgpr_count:" in part]


def _amd_usage(part: str) -> Usage:
    def number(key: str) -> int:
        found = re.search(rf"^    \.{key}:\s+(\d+)", part, re.MULTILINE)
        assert found is not None
        return int(found[1])

    name = re.search(r"^    \.name:\s+(\w+)", part, re.MULTILINE)
    assert name is not None
    return Usage(
        kernel=name[1],
        registers=number("vgpr_count"),
        stack=number("private_segment_fixed_size"),
        spills=4 * number("vgpr_spill_count"),
        local=number("group_segment_fixed_size"),
    )
