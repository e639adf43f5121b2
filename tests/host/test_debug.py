"""Debug switch: programs that compile alone, arrays of failed comparisons."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.host import BuildError, Device, debug
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER

KERNEL = """#include "scale/common.h"
kernel void scale(global const REAL *in, global REAL *out)
{
    out[get_global_id(0)] = twice(in[get_global_id(0)]) * FACTOR;
}
"""


SUMS = """
import numpy as np

def test_sums():
    values = np.arange(3)
    expected = values + 1
    np.testing.assert_array_equal(values, expected)

def test_fine():
    np.testing.assert_array_equal(np.arange(3), [0, 1, 2])
"""


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return the debug folder, which the debug switch creates."""
    monkeypatch.setenv(debug.VARIABLE, str(tmp_path / "made" / "debug"))
    return tmp_path / "made" / "debug"


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    """Kernels with headers in the same folder, in another folder, and with circular includes."""
    files = {
        "kernels/scale/scale.cl": KERNEL,
        "kernels/scale/common.h": '#ifndef COMMON\n#define COMMON\n#include "beside.h"\n#include "far.h"\n#endif\n',
        "kernels/scale/beside.h": '#ifndef BESIDE\n#define BESIDE\n#include "common.h"\n#define REAL float\n#endif\n',
        "more/far.h": "static inline float twice(float x) { return 2.0f * x; }\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "kernels"


def test_nothing_is_written_without_the_variable(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kernels: Path, device: Device
) -> None:
    monkeypatch.delenv(debug.VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.rglob("*"))
    build(device, kernels, "scale/scale.cl", {"FACTOR": 3}, include_folders=[tmp_path / "more"])
    assert debug.debug_folder() is None
    assert debug.dump_arrays("name", values=np.ones(3)) is None
    assert set(tmp_path.rglob("*")) == before


def test_a_program_that_is_dumped_compiles_alone(device: Device, folder: Path, kernels: Path, tmp_path: Path) -> None:
    defines = {"FACTOR": "3.0f", "FLAG": None}
    build(device, kernels, "scale/scale.cl", defines, include_folders=[tmp_path / "more"])
    (path,) = folder.glob("scale-*.cl")
    text = path.read_text()
    assert device.handle.name.strip() in text
    assert "// build options: -cl-mad-enable -DFACTOR=3.0f -DFLAG\n" in text
    assert "#define FACTOR 3.0f\n" in text
    assert "#define FLAG 1\n" in text
    assert "/* build log:" in text
    assert "#include" not in text
    program = cl.Program(device.context, text).build(cache_dir=False)
    values = np.arange(5, dtype=np.float32)
    given = cl.array.to_device(device.queue, values)
    made = cl.array.empty_like(given)
    cl.Kernel(program, "scale")(device.queue, (5,), None, given.data, made.data)
    np.testing.assert_array_equal(made.get(), 6.0 * values)


def test_each_build_is_a_file(device: Device, folder: Path, kernels: Path, tmp_path: Path) -> None:
    for factor in (5, 7, 7):
        build(device, kernels, "scale/scale.cl", {"FACTOR": factor}, include_folders=[tmp_path / "more"])
    assert len(list(folder.glob("scale-*.cl"))) == 2


def test_a_build_that_fails_is_dumped_with_its_log(device: Device, folder: Path, kernels: Path, tmp_path: Path) -> None:
    with pytest.raises(BuildError, match=r"kernels/scale/scale\.cl does not build with .*-DFACTOR=undeclared"):
        build(device, kernels, "scale/scale.cl", {"FACTOR": "undeclared"}, include_folders=[tmp_path / "more"])
    (path,) = folder.glob("scale-*.cl")
    _, log = path.read_text().split("/* build log:")
    assert "undeclared" in log


def test_a_missing_header_is_left_to_the_compiler(device: Device, folder: Path, kernels: Path) -> None:
    with pytest.raises(BuildError, match=r"far\.h"):
        build(device, kernels, "scale/scale.cl", {"FACTOR": 11})
    assert '#include "far.h"' in debug.flatten_includes(kernels, "scale/scale.cl")


def test_lines_keep_their_numbers(device: Device, folder: Path, kernels: Path, tmp_path: Path) -> None:
    (kernels / "wrong.cl").write_text('#include "scale/common.h"\n\nkernel void wrong(void) { nonsense; }\n')
    with pytest.raises(BuildError):
        build(device, kernels, "wrong.cl", {}, include_folders=[tmp_path / "more"])
    (path,) = folder.glob("wrong-*.cl")
    with pytest.raises(cl.RuntimeError, match=r"wrong\.cl[:\"(]+3|wrong\.cl, line 3"):
        cl.Program(device.context, path.read_text()).build(cache_dir=False)


def test_a_guarded_header_is_written_once(tmp_path: Path) -> None:
    guarded = "#ifndef {0}\n#define {0}\n{1}\n#endif\n"
    files = {
        "a.h": guarded.format("A", "int a;"),
        "b.h": guarded.format("B", '#include "a.h"\n#include "list.h"\nint b;'),
        "list.h": "ENTRY(1)\n",
        "once.cl": '#include "a.h"\n#include "b.h"\n#include "list.h"\n#include "a.h"\n',
        # Without the macro the compiler sees the first header only at the second place.
        "conditional.cl": '#ifdef FLAG\n#include "b.h"\n#endif\n#include "a.h"\n#include "b.h"\n',
        "two.h": "#ifndef A\n#define A\n#endif\n#ifdef FLAG\nint two;\n#endif\n",
        "twice.cl": '#include "two.h"\n#define FLAG\n#include "two.h"\n',
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    once = debug.flatten_includes(tmp_path, "once.cl")
    assert (once.count("int a;"), once.count("int b;"), once.count("ENTRY(1)")) == (1, 1, 2)
    assert once.endswith('#line 4 "once.cl"\n#line 5 "once.cl"\n')
    _, behind = debug.flatten_includes(tmp_path, "conditional.cl").split('#line 3 "conditional.cl"')
    assert (behind.count("int a;"), behind.count("int b;")) == (1, 1)
    assert debug.flatten_includes(tmp_path, "twice.cl").count("int two;") == 2


def test_every_kernel_of_gpuvision_is_flattened() -> None:
    sources = sorted(KERNEL_FOLDER.rglob("*.cl"))
    assert sources
    for path in sources:
        text = debug.flatten_includes(KERNEL_FOLDER, path.relative_to(KERNEL_FOLDER).as_posix())
        assert "#include" not in text


class Reading(NamedTuple):
    position: object
    sigma: object = None


def test_arrays_are_stored_by_their_names(device: Device, folder: Path) -> None:
    on_device = device.empty((2, 3), np.float32)
    on_device.set(np.ones((2, 3), np.float32))
    path = debug.dump_arrays(
        "a/b [c]",
        inputs=[np.arange(3), 2.5],
        result=Reading(on_device),
        options={"k1": np.float32(7.0), "label": "text"},
        kinds=np.array([object()]),
    )
    assert path == folder / "a_b_c.npz"
    with np.load(path) as stored:
        found = {name: stored[name] for name in stored.files}
    assert list(found) == ["inputs.0", "inputs.1", "result.position", "options.k1"]
    np.testing.assert_array_equal(found["inputs.0"], np.arange(3))
    np.testing.assert_array_equal(found["result.position"], np.ones((2, 3), np.float32))
    assert (float(found["inputs.1"]), float(found["options.k1"])) == (2.5, 7.0)


def test_an_array_may_be_called_name(folder: Path) -> None:
    path = debug.dump_arrays("stem", name=np.arange(3))
    assert path == folder / "stem.npz"
    with np.load(path) as stored:
        np.testing.assert_array_equal(stored["name"], np.arange(3))
    with pytest.raises(ValueError, match="wrong"), debug.dump_on_failure("stem", name=np.arange(4)):
        raise ValueError("wrong")
    assert (folder / "stem-2.npz").exists()


def test_files_are_never_overwritten(folder: Path) -> None:
    paths = [debug.dump_arrays("name", value=number, file=number) for number in range(3)]
    assert paths == [folder / "name.npz", folder / "name-2.npz", folder / "name-3.npz"]
    with np.load(folder / "name-2.npz") as stored:
        assert int(stored["value"]) == 1


def test_a_failed_comparison_leaves_its_arrays(folder: Path) -> None:
    result, expected = np.array([1.0, 2.0]), np.array([1.0, 3.0])
    with debug.dump_on_failure("fine", result=result):
        np.testing.assert_array_equal(result, result)
    assert not folder.exists()
    with pytest.raises(AssertionError) as caught, debug.dump_on_failure("sums", result=result, expected=expected):
        np.testing.assert_array_equal(result, expected)
    assert caught.value.__notes__ == [f"arrays of the failed comparison: {folder / 'sums.npz'}"]
    with np.load(folder / "sums.npz") as stored:
        np.testing.assert_array_equal(stored["expected"], expected)


@pytest.mark.slow
def test_a_failed_test_leaves_its_arrays(folder: Path, tmp_path: Path) -> None:
    """The hook of the tests' conftest dumps the arrays of the test function when a comparison fails."""
    (tmp_path / "conftest.py").write_text((Path(__file__).parents[1] / "conftest.py").read_text())
    (tmp_path / "test_sums.py").write_text(SUMS)
    helpers = f"pythonpath={Path(__file__).parents[1]}"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", helpers, str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert "1 failed, 1 passed" in run.stdout
    (path,) = folder.glob("*.npz")
    assert str(path) in run.stdout
    with np.load(path) as stored:
        np.testing.assert_array_equal(stored["expected"], [1, 2, 3])
        assert sorted(stored.files) == ["expected", "values"]


def test_a_missing_header_hides_no_other_one(tmp_path: Path) -> None:
    """Lines keep their numbers behind each header; a header is looked for beside the including header first."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "more").mkdir()
    files = {
        "a.cl": '#include "none.h"\n  #  include "sub/b.h" // b\nint a;\n#include "c.h"\n\n',
        "sub/b.h": 'int b;\n#include "d.h"\n',
        "sub/d.h": "int beside;\n",
        "d.h": "int above;\n",
        "more/c.h": '#include "d.h"\nint c;\n\n\n',
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert debug.flatten_includes(tmp_path, "a.cl", [tmp_path / "more"]) == (
        '#line 1 "a.cl"\n#include "none.h"\n'
        '#line 1 "sub/b.h"\nint b;\n#line 1 "d.h"\nint beside;\n#line 3 "sub/b.h"\n'
        '#line 3 "a.cl"\nint a;\n'
        '#line 1 "c.h"\n#line 1 "d.h"\nint above;\n#line 2 "c.h"\nint c;\n'
        '#line 5 "a.cl"\n'
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("#ifndef A\n#define A\nint a;\n#endif\n", True),
        ("// a comment\n#ifndef A\n#define A\n#ifdef B\nint b;\n#endif\nint a;\n#endif // A", False),
        ("// a comment\n#ifndef A\n#define A\n#ifdef B\nint b;\n#endif\nint a;\n#endif", True),
        ("#ifndef A\n#define A\n#endif\nint b;\n", False),
        ("#ifndef A\n#define A\n#endif\n#ifdef B\n#endif\n", False),
        ("#ifndef A\n#define B\n#endif\n", False),
        ("#ifdef A\n#define A\n#endif\n", False),
        ("int a;\n", False),
    ],
)
def test_guards_that_enclose_a_file(text: str, expected: bool) -> None:
    assert debug._is_guarded(text) == expected


def test_open_conditions_behind_each_directive() -> None:
    text = "#if A\n#define B\n  # ifdef C\n#else\n#endif\n#endif\n#ifndef D\n"
    assert debug._depths(text) == [0, 1, 1, 2, 2, 1, 0, 1]
    assert debug._depths("int a;") == [0]
