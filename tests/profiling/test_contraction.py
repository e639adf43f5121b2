"""Results that must be exact do not depend on whether a compiler contracts products and sums (``a * b + c``) to fma."""

from __future__ import annotations

import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from gpuvision.host.debug import flatten_includes
from gpuvision.host.launch_builder import type_defines
from gpuvision.host.program import Define, options
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.profiling.offline import targets
from gpuvision.profiling.offline.targets import TARGETS

_SM_90 = TARGETS["sm_90"]
pytestmark = pytest.mark.skipif(
    targets.shutil.which(targets.CLANG) is None or not _SM_90.bitcode.exists(),
    reason="the offline compilers are not installed",
)


def arithmetic(text: str, contract: str, folder: Path, **defines: Define) -> Counter[str]:
    """Return the numbers of fma, mul, add and sub of the one kernel in a text, compiled with a kind of contraction."""
    source, assembly = folder / "kernel.cl", folder / f"{contract}.s"
    source.write_text(text)
    words = ["-finclude-default-header", "-mlink-builtin-bitcode", str(_SM_90.bitcode)]
    command = [targets.CLANG, "-x", "cl", "-cl-std=CL1.2", "-O3", "-S", f"-ffp-contract={contract}", *_SM_90.options]
    command += [*(part for word in words for part in ("-Xclang", word)), *options(defines)]
    done = subprocess.run([*command, "-o", str(assembly), str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return Counter(re.findall(r"^\s+(fma|mul|add|sub)(?:\.\w+)*\.f32\s", assembly.read_text(), re.MULTILINE))


def with_header(header: str, kernel: str, prelude: str = "") -> str:
    return prelude + flatten_includes(KERNEL_FOLDER, header, ()) + kernel


def test_cut_of_a_shared_edge_leaves_nothing_to_contract(tmp_path: Path) -> None:
    kernel = "kernel void one(global real *x) { x[0] = view_mix(x[1], x[2], x[3], x[4], x[5]); }"
    text = with_header("occluded_irradiance/visible.h", kernel)
    for contract in ("off", "on", "fast"):
        found = arithmetic(text, contract, tmp_path, BVH_DEPTH=4)
        assert found == Counter({"fma": 2, "add": 1}), contract


def test_zero_of_the_cut_is_no_constant(tmp_path: Path) -> None:
    kernel = "kernel void one(global real *x) { view v; v.from = x[1]; x[0] = v.from - v.from; }"
    text = with_header("occluded_irradiance/visible.h", kernel)
    assert arithmetic(text, "fast", tmp_path, BVH_DEPTH=4) == Counter({"sub": 1})


def test_sums_of_float_profiles_contract_only_where_it_is_harmless(tmp_path: Path) -> None:
    """``steps * s - m`` may be one rounding less; the product in the two-sum stays rounded."""
    defines = type_defines("CODE", "float32", 4, 8, 16)
    defines |= {"CODE_BITS": 32, "METHOD_CENTROID": None, "RADIUS": 1, "MAX_RADIUS": 1, "FIR_HALF": 0}
    kernel = """
        kernel void one(global Sums *x, int first, int steps) {
            Sums sums = x[0];
            add_block(&sums, x[1].total, x[2].total, first, steps);
            x[0] = sums;
        }"""
    text = with_header("line/line_centroid.h", kernel)
    rounded, contracted = (arithmetic(text, each, tmp_path, **defines) for each in ("off", "fast"))
    assert rounded - contracted == Counter({"mul": 1, "sub": 1})
    assert contracted - rounded == Counter({"fma": 1})
