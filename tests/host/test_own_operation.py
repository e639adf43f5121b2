"""The example "Write your own operation": a kernel and an operation from outside the package."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pyopencl as cl
import pytest

import gpuvision as gv
from gpuvision.host import BuildError, Device, Launch, Operation, debug, to_numpy

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "own_operation.py"


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    """Run the example and return its global names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plt, "show", lambda: None)
        patch.setenv("MPLBACKEND", "Agg")
        plt.switch_backend("Agg")
        names = runpy.run_path(str(EXAMPLE))
        plt.close("all")
    return names


@pytest.fixture
def correct(example: dict[str, Any], rng: np.random.Generator) -> Any:
    offset, gain = rng.uniform(0.0, 10.0, (5, 7)), rng.uniform(0.5, 2.0, (5, 7))
    return example["FlatField"](offset=offset, gain=gain, saturation=200.0)


def expected(operation: Any, frames: Any) -> Any:
    return operation.gain * (frames.astype(np.float64) - operation.offset)


def test_the_example_says_what_it_shows(example: dict[str, Any]) -> None:
    corrected, frames, centre = example["corrected"], example["frames"], example["centre"]
    np.testing.assert_allclose(corrected.image, example["expected"], atol=1e-4)
    np.testing.assert_array_equal(corrected.status != 0, frames >= 255)
    errors = [np.sqrt(np.nanmean((example[name] - centre) ** 2)) for name in ("raw", "positions")]
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
@pytest.mark.parametrize("batch", [(), (1,), (3, 40), (0,)])
def test_against_numpy(
    example: dict[str, Any],
    correct: Any,
    device: Device,
    rng: np.random.Generator,
    dtype: Any,
    variant: Any,
    batch: Any,
) -> None:
    if dtype == np.float64 and not device.has_double:
        pytest.skip("this device has no doubles")
    operation = example["FlatField"](offset=correct.offset, gain=correct.gain, saturation=200.0, variant=variant)
    frames = rng.uniform(0.0, 255.0, (*batch, 5, 7)).astype(dtype)
    found = operation(frames, device=device)
    rounding = 1e-12 if dtype == np.float64 else 1e-4
    np.testing.assert_allclose(found.image, expected(operation, frames), rtol=0.0, atol=rounding)
    np.testing.assert_array_equal(found.status, np.where(frames >= 200.0, gv.Status.SATURATED, gv.Status.OK))


def test_values_that_are_not_finite_are_flagged(correct: Any, device: Device) -> None:
    frames = np.ones((5, 7), np.float32)
    frames[0, :3] = np.nan, np.inf, -np.inf
    found = correct(frames, device=device)
    np.testing.assert_array_equal(found.status[0], [8, 8, 8, 0, 0, 0, 0])
    np.testing.assert_array_equal(np.isnan(found.image), found.status == 8)


def test_device_arrays_and_bound_instances(correct: Any, device: Device, rng: np.random.Generator) -> None:
    frames = rng.integers(0, 200, (4, 5, 7)).astype(np.uint8)
    on_device = device.empty(frames.shape, frames.dtype)
    on_device.set(frames)
    found = correct(on_device)
    assert isinstance(found.image, cl.array.Array)
    np.testing.assert_allclose(to_numpy(found.image), expected(correct, frames), atol=1e-4)
    bound = correct.bind(device, frames.shape, frames.dtype)
    bound.inputs[0].set(frames[::-1].copy())
    np.testing.assert_allclose(to_numpy(bound.run().image), expected(correct, frames[::-1]), atol=1e-4)


def test_in_a_stream_before_an_operation_of_gpuvision(correct: Any, device: Device, rng: np.random.Generator) -> None:
    frames = rng.integers(0, 200, (10, 5, 7)).astype(np.uint8)
    readout = gv.LineReadout(threshold=3)
    with gv.Pipeline(frames, [correct, readout], batch=4, device=device) as stream:
        streamed = np.concatenate([batch.result.position.copy() for batch in stream])
    separate = readout(correct(frames, device=device).image, device=device).position
    np.testing.assert_array_equal(streamed, separate)


def test_other_inputs_are_refused(example: dict[str, Any], correct: Any, device: Device) -> None:
    with pytest.raises(TypeError, match=r"FlatField takes uint8, uint16, float32 or float64 frames, got int32"):
        correct(np.zeros((5, 7), np.int32), device=device)
    with pytest.raises(ValueError, match=r"FlatField takes frames \(\.\.\., 5, 7\), got shape \(7, 5\)"):
        correct(np.zeros((7, 5), np.uint8), device=device)
    with pytest.raises(ValueError, match="must be one image each"):
        example["FlatField"](offset=np.zeros((2, 2)), gain=np.zeros((2, 3)))


def test_an_operation_needs_a_kernel_folder(device: Device, example: dict[str, Any]) -> None:
    class Homeless(Operation[Any]):
        Result = example["Corrected"]

        def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
            outputs = {"image": (shape, dtype), "status": None}
            return Launch("none.cl", "none", [(shape, dtype)], outputs, global_size=(math.prod(shape),))

    with pytest.raises(ValueError, match="Homeless has no kernel_folder; set it"):
        Homeless().bind(device, (3,), np.float32)


def test_a_kernel_of_ones_own_that_does_not_compile(
    example: dict[str, Any], correct: Any, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error and the debug folder name the user's file."""
    monkeypatch.setenv(debug.VARIABLE, str(tmp_path / "debug"))
    (tmp_path / "scale_offset").mkdir()
    (tmp_path / "scale_offset" / "scale_offset.cl").write_text('#include "common/real.h"\nkernel void wrong(\n')
    monkeypatch.setattr(type(correct), "kernel_folder", tmp_path)
    with pytest.raises(BuildError, match=r"/scale_offset/scale_offset\.cl does not build with .*-DINPUT=uchar"):
        correct.bind(device, (5, 7), np.uint8)
    paths = list((tmp_path / "debug").glob("*.cl"))
    assert len(paths) == 1 + device.prefers_vectors  # the variant for vectors, then the variant for work-items
    assert all("typedef float real;" in path.read_text() for path in paths)


def test_a_vector_variant_that_does_not_compile_is_replaced_by_work_items(
    example: dict[str, Any], correct: Any, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compilers of other processors may reject vectors of 16; a variant that the caller asks for is never replaced."""
    source = (EXAMPLE.parent / "kernels" / "scale_offset" / "scale_offset.cl").read_text()
    (tmp_path / "scale_offset").mkdir()
    guard = "#ifdef VECTOR_VARIANT\n#error vectors of 16\n#endif\n"
    (tmp_path / "scale_offset" / "scale_offset.cl").write_text(guard + source)
    monkeypatch.setattr(type(correct), "kernel_folder", tmp_path)
    frames = np.arange(35, dtype=np.uint8).reshape(5, 7)
    if device.prefers_vectors:
        with pytest.warns(RuntimeWarning, match=rf"work-items replace vectors on {device.label}: .*scale_offset\.cl"):
            bound = correct.bind(device, frames.shape, frames.dtype)
    else:
        bound = correct.bind(device, frames.shape, frames.dtype)
    np.testing.assert_allclose(bound.on_host((frames,)).image, expected(correct, frames), atol=1e-4)
    assert device.prefers_vectors == Device.named(device.label).prefers_vectors
    vectors = example["FlatField"](offset=correct.offset, gain=correct.gain, variant="vector")
    expected_error = (BuildError, "vectors of 16") if device.takes_vectors else (ValueError, "does not run the vector")
    with pytest.raises(expected_error[0], match=expected_error[1]):
        vectors.bind(device, frames.shape, frames.dtype)
