"""
Read a batch of PSD currents, with their uncertainty
====================================================

A position sensitive device (PSD) divides the photocurrent of a light spot between two electrodes. The readout
converts a batch of current pairs into positions, flags the pairs that cannot be trusted, and predicts the standard
deviation of every position from a noise model. Here the prediction is compared with the scatter of 2000 repeated
readings.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpuvision as gv

# %%
# A strip of 6 mm, read out through a 16-bit converter of 50 pA per code. The noise of the amplifiers is independent
# in the two channels; the light level spans three decades.
length, ampere, noise = 6e-3, 50e-12, 0.4e-9
readout = gv.PsdReadout(
    strip_length=length,
    ampere=ampere,
    minimum_total=20e-9,
    noise=gv.PsdNoise(independent=noise),
)

# %%
# Simulate the readings: 41 positions along the strip, 4 light levels, 2000 repetitions.
true = np.linspace(-0.48, 0.48, 41) * length
total = np.array([10e-9, 50e-9, 300e-9, 3e-6])
rng = np.random.default_rng(7)
share = np.stack([0.5 - true / length, 0.5 + true / length], axis=-1)
currents = total[:, None, None] * share + rng.normal(0.0, noise, (2000, len(total), len(true), 2))
codes = np.clip(np.rint(currents / ampere), 0, 65535).astype(np.uint16)

# %%
# One call reads all 328 000 pairs: uint16 codes in, positions in metres out.
reading = readout(codes)
print(f"{reading.position.size} pairs; dark: {np.mean((reading.status & gv.Status.LOW_SIGNAL) != 0):.0%}")

# %%
# Measured scatter (dots) and predicted standard deviation (lines). The faintest level is below ``minimum_total``: it
# is flagged LOW_SIGNAL, and its positions are NaN.
scatter = np.std(reading.position, axis=0)
predicted = np.mean(reading.sigma, axis=0)
figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
for level, colour in zip(range(1, len(total)), ("C0", "C1", "C2"), strict=True):
    axes.semilogy(1e3 * true, 1e6 * scatter[level], ".", color=colour)
    axes.semilogy(1e3 * true, 1e6 * predicted[level], "-", color=colour, label=f"{1e9 * total[level]:.0f} nA")
ratio = scatter[1:] / predicted[1:]
print(f"measured over predicted: {ratio.min():.3f} to {ratio.max():.3f}")
axes.set(
    xlabel="position on the strip [mm]", ylabel="standard deviation [µm]", title="PSD: predicted and measured noise"
)
axes.legend(title="total current")
plt.show()
