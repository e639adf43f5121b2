"""
Bind an operation, and stream frames
====================================

Binding prepares an operation for frames of one shape: the kernel is compiled, the arrays are allocated, and a call
only enqueues the kernel. A pipeline moves frames from a source through operations over a ring of slots, and reports
throughput and latency.
"""

import time

import matplotlib.pyplot as plt
import numpy as np

import gpuvision as gv
from gpuvision.host import ArraySource, PacedSource, plan_stream

# %%
# Frames of 256 x 1024 pixels with a laser line.
rows, columns = 256, 1024
centre = 120.0 + 40.0 * np.sin(np.arange(columns) / 150.0)
distance = np.arange(rows)[:, None] - centre
rng = np.random.default_rng(5)
line = 200.0 * np.exp(-0.5 * (distance / 1.5) ** 2)
frames = np.clip(line + rng.normal(6.0, 2.0, (64, rows, columns)), 0, 255).astype(np.uint8)
readout = gv.LineReadout(method="windowed", threshold=25)

# %%
# A call on NumPy arrays is convenient: it copies in and out. The bound operation works on arrays of the device.
device = gv.Device.best()
bound = readout.bind(device, frames[0].shape, frames.dtype)
bound.inputs[0].set(frames[0])
reading = bound.run()
print(f"rms error {np.sqrt(np.mean((reading.position.get() - centre) ** 2)):.3f} px")

for name, call in (("readout(frame)", lambda: readout(frames[0])), ("bound.run()", bound.run)):
    times = []
    for _ in range(200):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    print(f"{name:15} {1e6 * np.median(times):6.0f} µs")

# %%
# Stream at 2000 frames per second: the plan measures which batch keeps up with the sensor, and sizes the ring for a
# stall of half a second.
source = PacedSource(ArraySource(np.concatenate([frames] * 16)), rate=2000.0)
chosen = plan_stream(source, readout, device=device)
print(chosen)
latency = []
with gv.Pipeline(source, readout, policy="drop_oldest", **chosen.settings) as stream:
    for batch in stream:
        latency.extend(1e-6 * (batch.delivered - batch.arrived))
report = stream.report()
print(report)

# %%
# The latency of every frame, from its arrival to its positions in host memory.
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
left.imshow(frames[0], cmap="gray", aspect="auto")
left.plot(reading.position.get(), "r-", linewidth=0.7)
left.set(title="A frame and the positions of its line", xlabel="column [px]", ylabel="row [px]")
right.plot(latency, ".", markersize=2)
right.set(title="Latency", xlabel="frame", ylabel="latency [ms]", yscale="log")
plt.show()
