"""
Write your own operation
========================

An operation that you write runs like the operations of gpuvision: on NumPy and device arrays, bound to a shape, in a
stream. It consists of an OpenCL kernel in a folder of yours and a frozen dataclass that describes the launch. This
example adds a flat-field correction, ``image = gain * (frame - offset)`` for each pixel, and puts it before a line
readout.

The kernel takes inputs, outputs and arguments in this order:

.. literalinclude:: /../examples/kernels/scale_offset/scale_offset.cl
   :language: c
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt

import gpuvision as gv
from gpuvision.host import (
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Operation,
    Precision,
    StatusArray,
    Variant,
    to_numpy,
    type_defines,
)
from gpuvision.operation import KERNEL_FOLDER

# %%
# The result is a named tuple of arrays, with a status for each value.


class Corrected(NamedTuple):
    image: FloatArray
    status: StatusArray


# %%
# The operation names its result type, the folder of its kernels, and further folders for ``#include``: gpuvision's
# headers define the real type and the status flags. ``launch`` checks shape and dtype of the input and describes the
# kernel launch. Sizes are arguments of the kernel, so a new shape needs no compilation; macros (``defines``) change the
# code, here the type of the input. Arrays among the arguments are uploaded once, when the operation is bound.
#
# ``eq=False`` compares operations by identity, because this one holds arrays.


@dataclass(frozen=True, kw_only=True, eq=False)
class FlatField(Operation[Corrected]):
    Result: ClassVar[type[Any]] = Corrected
    kernel_folder: ClassVar[Path] = Path(__file__).resolve().parent / "kernels"
    include_folders: ClassVar[tuple[Path, ...]] = (KERNEL_FOLDER,)

    offset: npt.NDArray[np.float64]
    gain: npt.NDArray[np.float64]
    saturation: float = math.inf
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if self.offset.ndim != 2 or self.offset.shape != self.gain.shape:
            raise ValueError(f"FlatField: offset {self.offset.shape} and gain {self.gain.shape} must be one image each")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("uint8", "uint16", "float32", "float64", of="frames")
        rows, columns = self.gain.shape
        build.check_shape(shape[-2:] == (rows, columns), f"frames (..., {rows}, {columns})")
        count = math.prod(shape)
        # On a CPU a work-item corrects 4096 samples, on a GPU one sample.
        work = build.work(count, each=4096, group=64)
        return build.launch(
            "scale_offset/scale_offset.cl",
            "scale_offset",
            work=work,
            outputs=build.outputs({"image": shape, "status": shape}),
            defines=type_defines("INPUT", dtype),
            arguments=[
                self.offset.astype(build.real),
                self.gain.astype(build.real),
                np.uint64(self.gain.size),
                np.uint64(count),
                np.uint64(work.each),
                build.real.type(self.saturation),
            ],
            passes_once=True,
        )


# %%
# Frames of a laser line, recorded by a camera with vignetting and column noise, and its flat-field images.
rows, columns = 128, 640
rng = np.random.default_rng(3)
x = np.linspace(-1.0, 1.0, columns)
sensitivity = (1.0 - 0.6 * x**2) * rng.normal(1.0, 0.04, (rows, columns))
offset = 12.0 + rng.normal(0.0, 3.0, columns) + np.zeros((rows, columns))
centre = 64.0 + 20.0 * np.sin(3.0 * x)
distance = np.arange(rows)[:, None] - centre
light = 150.0 * np.exp(-0.5 * (distance / 4.0) ** 2)
frames = np.clip(np.rint(sensitivity * light + offset + rng.normal(0.0, 1.0, (16, rows, columns))), 0, 255)
frames = frames.astype(np.uint8)

# %%
# NumPy arrays in, NumPy arrays out. The result agrees with NumPy's to the rounding of single precision.
correct = FlatField(offset=offset, gain=1.0 / sensitivity, saturation=255.0)
corrected = correct(frames)
expected = (frames - offset) / sensitivity
print(f"largest difference from NumPy: {np.abs(corrected.image - expected).max():.1e} digits")

# %%
# Device arrays in, device arrays out: the result stays on the device, and the call does not wait.
device = Device.best()
on_device = device.empty(frames.shape, frames.dtype)
on_device.set(frames)
image = correct(on_device).image
print(type(image).__name__, np.array_equal(to_numpy(image), corrected.image))

# %%
# The fast path: bind once, then launch without allocation, compilation or copy.
bound = correct.bind(device, frames.shape, frames.dtype)
bound.inputs[0].set(frames)
print(np.array_equal(to_numpy(bound.run().image), corrected.image))

# %%
# In a stream, before a line readout: the corrected frames stay in device memory.
readout = gv.LineReadout(method="windowed", window=5, threshold=20)
with gv.Pipeline(frames, [correct, readout], batch=4) as stream:
    positions = np.concatenate([batch.result.position.copy() for batch in stream])
raw = readout(frames).position
for name, found in (("raw", raw), ("corrected", positions)):
    print(f"{name:9} rms error {np.sqrt(np.nanmean((found - centre) ** 2)):.3f} px")

# %%
# Invalid inputs are refused with a message that states the expected input.
try:
    correct(frames.astype(np.int64))
except TypeError as error:
    print(error)

# %%
# The position errors along the line, before and after the correction.
figure, (top, bottom) = plt.subplots(2, 1, figsize=(8, 6), layout="constrained")
top.imshow(np.hstack([frames[0], corrected.image[0]]), cmap="gray", vmin=0, vmax=160)
top.set(title="frame and corrected frame", xlabel="column [px]", ylabel="row [px]")
for name, found in (("raw", raw), ("corrected", positions)):
    bottom.plot(np.nanmean(found - centre, axis=0), linewidth=0.8, label=name)
bottom.set(xlabel="column [px]", ylabel="mean error [px]", title="position of the laser line")
bottom.legend()
plt.show()
