"""`gpuvision profile --offline`: builds for GPUs, reports of the compilers, limits of registers and local memory."""

from __future__ import annotations

import functools
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host import Device
from gpuvision.host.debug import flatten_includes
from gpuvision.host.errors import GpuVisionError
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.profiling.offline import check, registry, targets
from gpuvision.profiling.offline.builds import GpuModel, KernelBuild
from gpuvision.profiling.offline.check import LIMITS, check_builds, fault_of, one_build_each
from gpuvision.profiling.offline.targets import TARGETS, CompilerError, Usage, usage_of_amd, usage_of_ptxas

ROOT = Path(__file__).resolve().parents[2]
_DIRECTIVE = re.compile(r"^[ \t]*#[ \t]*(if|ifdef|ifndef|elif)\b([^\n]*)", re.MULTILINE)
# Macros that only builds for CPUs have: vectors, stores around the caches, prefetching, PoCL, convex parts of scenes.
_OF_CPUS = {
    "CONVEX_PARTS",
    "ITEM_PER_PROFILE",
    "VECTOR_VARIANT",
    "PAST_CACHES",
    "PREFETCH",
    "TEAM",
    "POCL_DEVICE_ADDRESS_BITS",
    "WORD_PAIRS",
    "WINDOW_ARGUMENT",
}
PTXAS_LOG = """\
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'one' for 'sm_90'
ptxas info    : Function properties for one
    64 bytes stack frame, 4 bytes spill stores, 8 bytes spill loads
ptxas info    : Function properties for called
    16 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 22 registers, used 1 barriers, 80 bytes cumulative stack size, 512 bytes smem
ptxas info    : Compile time = 1.5 ms
ptxas info    : Compiling entry function 'two' for 'sm_90'
ptxas info    : Function properties for two
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 9 registers, used 0 barriers
"""
AMD_ASSEMBLY = """\
one:
	s_endpgm
	.amdgpu_metadata
---
amdhsa.kernels:
  - .agpr_count:     0
    .args:
      - .name:           values
        .offset:         0
    .group_segment_fixed_size: 640
    .name:           one
    .private_segment_fixed_size: 728
    .vgpr_count:     96
    .vgpr_spill_count: 3
amdhsa.target:   amdgcn-amd-amdhsa--gfx90a
"""


@functools.cache
def known_builds() -> tuple[KernelBuild, ...]:
    return tuple(registry.all_builds())


@pytest.mark.slow
def test_every_kernel_file_has_a_build() -> None:
    files = {path.relative_to(KERNEL_FOLDER).as_posix() for path in KERNEL_FOLDER.glob("*/*.cl")}
    assert files - {each.source for each in known_builds()} == set()


@functools.cache
def files_of(source: str) -> frozenset[str]:
    """Return a kernel file and the headers that it includes."""
    text = flatten_includes(KERNEL_FOLDER, source, ())
    return frozenset({source, *re.findall(r'^#line 1 "([^"]+)"', text, re.MULTILINE)})


def _kernel_files() -> list[Path]:
    return [path for suffix in ("cl", "h") for path in KERNEL_FOLDER.glob(f"*/*.{suffix}")]


def test_builds_switch_every_macro_on_and_off() -> None:
    defined: set[str] = set()
    texts = {path: path.read_text() for path in _kernel_files()}
    for text in texts.values():
        defined |= set(re.findall(r"#[ \t]*define[ \t]+(\w+)", text))
    assert files_of("line/line.cl") >= {"line/line.cl", "line/line_ml.h", "common/camera.h"}
    wrong = []
    for path, text in texts.items():
        name = path.relative_to(KERNEL_FOLDER).as_posix()
        including = [set(each.defines) for each in known_builds() if name in files_of(each.source)]
        for kind, condition in _DIRECTIVE.findall(re.sub(r"//[^\n]*", "", text)):
            for macro in set(re.findall(r"\b[A-Z]\w+", condition)) - defined - _OF_CPUS:
                if not any(macro in each for each in including):
                    wrong.append(f"{name}: no build defines {macro}")
                if ("def" in kind or f"defined({macro})" in condition) and all(macro in each for each in including):
                    wrong.append(f"{name}: all builds define {macro}")
    assert wrong == []


def test_helper_functions_have_a_body_in_every_file() -> None:
    """C99: a function that is only ``inline`` has no body outside of the calls that the compiler inlines."""
    plain = [
        f"{path.parent.name}/{path.name}: {line}"
        for path in _kernel_files()
        for line in path.read_text().splitlines()
        if re.match(r"\s*(?!static\b|//)(?:\w+\s+)*inline\b", line)
    ]
    assert plain == []


def test_builds_are_work_item_variants_without_duplicates() -> None:
    keys = [(each.source, str(sorted(each.defines.items(), key=str))) for each in known_builds()]
    assert len(keys) == len(set(keys)) > 200
    assert not any("VECTOR_VARIANT" in each.defines for each in known_builds())
    names = [(each.source, each.name) for each in known_builds()]
    assert len(names) == len(set(names))
    assert {each.source for each in one_build_each(known_builds())} == {each.source for each in known_builds()}
    assert one_build_each(known_builds())[0] is known_builds()[0]


def test_table_in_the_repository_has_every_build() -> None:
    """If this fails, write `profiling/results/offline-gpus.json` again: see CONTRIBUTING.md, "Add an operation"."""
    rows = json.loads((ROOT / "profiling" / "results" / "offline-gpus.json").read_text())["rows"]
    expected = {(each.source, each.name) for each in known_builds()}
    for target in TARGETS:
        assert {(row["source"], row["case"]) for row in rows if row["target"] == target} == expected
    assert [row for row in rows if "fault" in row] == []


def test_kernels_of_the_table_keep_the_limits() -> None:
    rows = json.loads((ROOT / "profiling" / "results" / "offline-gpus.json").read_text())["rows"]
    builds = {(each.source, each.name): each for each in known_builds()}
    found = []
    for row in rows:
        usage = Usage(*(row[key] for key in ("kernel", "registers", "stack", "spills", "local")))
        fault = fault_of(usage, builds[row["source"], row["case"]], TARGETS[row["target"]])
        found += [f"{row['target']}: {row['source']} ({row['case']}) {fault}"] if fault else []
    assert found == []


def test_model_of_a_gpu_has_the_properties_that_launches_read() -> None:
    device, model = Device.best(), GpuModel()
    needs_a_handle = {"handle", "context", "queue", "inline_device"}
    properties = {name for name in vars(device) if not name.startswith("_")} - needs_a_handle
    assert properties - set(vars(model)) == set()


def test_report_of_ptxas() -> None:
    one, two = usage_of_ptxas(PTXAS_LOG)
    assert one == Usage("one", registers=22, stack=80, spills=12, local=512)
    assert two == Usage("two", registers=9, stack=0, spills=0, local=0)


def test_metadata_of_amd() -> None:
    assert usage_of_amd(AMD_ASSEMBLY) == [Usage("one", registers=96, stack=728, spills=12, local=640)]


def test_call_of_a_function_without_a_body_is_found_in_the_assembly_of_amd() -> None:
    call = "\ts_add_u32 s4, s4, place_apart@rel32@lo+4\n"
    with pytest.raises(CompilerError, match="unresolved function place_apart"):
        usage_of_amd(AMD_ASSEMBLY.replace("\ts_endpgm\n", call))
    assert usage_of_amd(AMD_ASSEMBLY.replace("\ts_endpgm\n", f"{call}place_apart:\n"))


def test_limits() -> None:
    usage = Usage("one", registers=255, stack=0, spills=0, local=32768)
    single, double = KernelBuild("a", "a/a.cl", {}), KernelBuild("a", "a/a.cl", {"REAL_IS_DOUBLE": None})
    nvidia, amd = TARGETS["sm_90"], TARGETS["gfx90a"]
    assert fault_of(usage, single, nvidia) == ""
    assert fault_of(replace(usage, spills=4), single, nvidia) == "spills 4 bytes, limit 0"
    assert fault_of(replace(usage, spills=LIMITS.spills_amd), single, amd) == ""
    assert fault_of(replace(usage, spills=260), single, amd) == "spills 260 bytes, limit 256"
    assert fault_of(replace(usage, spills=768), double, nvidia) == ""
    assert fault_of(replace(usage, spills=769), double, nvidia) == "spills 769 bytes, limit 768"
    assert fault_of(replace(usage, stack=5120), single, amd) == ""
    assert fault_of(replace(usage, stack=5124), single, nvidia) == "takes 5124 bytes of stack, limit 5120"
    assert fault_of(replace(usage, local=32772), double, amd) == "takes 32772 bytes of local memory, limit 32768"


needs_compilers = pytest.mark.skipif(
    targets.shutil.which(targets.CLANG) is None
    or targets.find_ptxas() is None
    or not TARGETS["sm_90"].bitcode.exists(),
    reason="the offline compilers are not installed",
)


@needs_compilers
@pytest.mark.parametrize("target", ["sm_90", "gfx90a"])
def test_plain_inline_function_is_unresolved(target: str) -> None:
    text = """
        __attribute__((noinline)) %s inline float apart(float x) { return sqrt(x) + 1.0f; }
        kernel void one(global float *values) { values[get_global_id(0)] = apart(values[0]); }
        """
    (usage,) = targets.compile_text(text % "static", [], TARGETS[target])
    assert usage.kernel == "one"
    assert usage.registers > 1
    with pytest.raises(CompilerError, match=r"(?i)unresolved .*apart"):
        targets.compile_text(text % "", [], TARGETS[target])


@needs_compilers
def test_builds_are_compiled_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    psd = [each for each in known_builds() if each.source == "psd/psd.cl"][:2]
    broken = KernelBuild("broken", "psd/psd.cl", {"INPUT": "nonsense"})
    first = check_builds([*psd, broken], [TARGETS["sm_90"]])
    assert [row.fault for row in first.rows[:2]] == ["", ""]
    assert "error" in first.rows[2].fault
    assert [row.kernel for row in first.rows] == ["psd_readout", "psd_readout", ""]
    assert first.faults == [first.rows[2]]

    def compile_text(*given: Any) -> list[Usage]:
        raise AssertionError("compiled again")

    monkeypatch.setattr(check, "compile_text", compile_text)
    assert check_builds(psd, [TARGETS["sm_90"]]).rows == first.rows[:2]
    report = json.loads(first.to_json())
    assert report["rows"][0] == {
        "target": "sm_90",
        "source": "psd/psd.cl",
        "case": psd[0].name,
        **{key: getattr(first.rows[0].usage, key) for key in ("kernel", "registers", "stack", "spills", "local")},
    }
    assert set(report["compilers"]) == {"sm_90"}


def test_compiler_that_does_not_finish_is_a_fault_of_its_build(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    slow = tmp_path / "slow-clang"
    slow.write_text("#!/bin/sh\nexec sleep 20\n")
    slow.chmod(0o700)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(check, "check_compilers", list)
    monkeypatch.setattr(check, "versions", lambda target: ("compiler 1",))
    monkeypatch.setattr(targets, "CLANG", str(slow))
    monkeypatch.setattr(targets, "_SECONDS", 0.2)
    builds = [KernelBuild(name, "psd/psd.cl", {}) for name in ("first", "second")]
    report = check_builds(builds, [TARGETS["gfx90a"]])
    assert [(row.case, row.fault) for row in report.faults] == [
        ("first", "slow-clang did not finish within 0.2 s"),
        ("second", "slow-clang did not finish within 0.2 s"),
    ]


@pytest.fixture
def few_builds(monkeypatch: pytest.MonkeyPatch) -> list[Usage]:
    """Replace builds and compilers; the command sees one kernel with this usage."""
    usages = [Usage("psd_readout", registers=20, stack=8, spills=0, local=0)]
    monkeypatch.setattr(registry, "all_builds", lambda: [KernelBuild("pairs", "psd/psd.cl", {})])
    monkeypatch.setattr(check, "_cached_usage", lambda build, target: usages)
    monkeypatch.setattr(check, "check_compilers", list)
    monkeypatch.setattr(check, "versions", lambda target: ("compiler 1",))
    return usages


def run(*words: str) -> Any:
    return CliRunner().invoke(application(), ["profile", *words])


def test_command_prints_a_table_and_json(few_builds: list[Usage]) -> None:
    ran = run("--offline", "sm_90", "--offline", "gfx90a", "--json", "-")
    assert ran.exit_code == 0
    report = json.loads(ran.stdout)
    assert [row["target"] for row in report["rows"]] == ["sm_90", "gfx90a"]
    assert report["rows"][0]["registers"] == 20
    assert re.search(r"psd_readout +1 +20 +8 +0 +0", ran.stderr)


def test_command_fails_on_a_limit(few_builds: list[Usage]) -> None:
    few_builds[0] = replace(few_builds[0], local=40_000)
    ran = run("--offline", "sm_90")
    assert ran.exit_code == 1
    assert "sm_90: psd/psd.cl (pairs) psd_readout: takes 40000 bytes of local memory, limit 32768" in ran.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--offline", "sm_91"), "no target 'sm_91' to compile for; expected some of sm_70, sm_90, gfx90a, gfx1100"),
        (("psi", "--offline", "sm_90"), "no kernel 'psi' to compile; expected some of psd"),
        (("--offline", "sm_90", "--seconds", "3"), "--seconds has no effect with --offline"),
        (("--offline", "sm_90", "--device", "pocl"), "--device has no effect with --offline"),
        (("--one-build",), "--one-build has no effect without --offline"),
    ],
)
def test_command_refuses(few_builds: list[Usage], words: tuple[str, ...], message: str) -> None:
    ran = run(*words)
    assert isinstance(ran.exception, ValueError)
    assert message in str(ran.exception)


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        ("clang", "the compiler clang-16 is missing; install Debian's packages: apt-get install clang-16 libclc-16"),
        ("ptxas", r"NVIDIA's assembler ptxas is missing; install it: pip install 'gpuvision\[offline\]'"),
        ("bitcode", "the built-in functions .*nvptx64--nvidiacl.bc are missing; install Debian's packages"),
    ],
)
def test_missing_compiler_is_one_line(
    missing: str, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bitcode = tmp_path / "nvptx64--nvidiacl.bc"
    if missing != "bitcode":
        bitcode.touch()
    monkeypatch.setattr(targets, "_CLC_FOLDER", tmp_path)
    monkeypatch.setattr(targets.shutil, "which", lambda name: None if missing == "clang" else name)
    monkeypatch.setattr(targets, "find_ptxas", lambda: None if missing == "ptxas" else "ptxas")
    with pytest.raises(GpuVisionError, match=message) as raised:
        targets.check_compilers([TARGETS["sm_90"]])
    assert "\n" not in str(raised.value)
