"""
Steer a head through a delay
============================

A camera sees the head 3 frames late. A loop without a model must be slow, or it oscillates. An observer that knows the
commands steers as fast as a loop without delay.
"""

import matplotlib.pyplot as plt
import numpy as np

import gpuvision as gv
from gpuvision.servoing.observer import LatestPose

PERIOD, DELAY = 1e-3, 3e-3
TARGET = np.array([1e-3, 0.0, 0.0])


# %%
# The machine follows the commanded velocity with a lag of 1 ms; the camera has a noise of 1 um.
def steer(observer, gain):
    plant = gv.SimulatedPlant((gv.Axis(lag=1e-3),) * 3)
    camera = gv.SimulatedPoseSensor(plant.pose, period=PERIOD, delay=DELAY)
    observer.reset(-DELAY, np.zeros(3), 1e-12 * np.eye(3))
    controller = gv.PidController(gv.PidGains(proportional=gain / PERIOD))
    loop = gv.ServoLoop(plant, camera, observer, controller, gv.SimulatedClock(), period=PERIOD, limits=None)
    record = loop.run(TARGET, 0.06)
    return 1e3 * record.time, 1e6 * (TARGET - plant.pose(record.time))[:, 0]


# %%
# The lag adds about one frame to the delay: with 4 frames the loop is unstable from a gain of 0.35 on, and does not
# oscillate up to 0.08.
model = gv.MotionModel(lag=(1e-3,) * 3, acceleration_noise=(1e-3,) * 3, position_noise=(1e-11,) * 3)
runs = {
    "no model, gain 0.08": (LatestPose(), gv.non_oscillating_gain(4)),
    "no model, gain 0.3": (LatestPose(), 0.3),
    "observer, gain 0.3": (gv.PoseObserver(model, gate=1e9), 0.3),
}
figure, axes = plt.subplots(figsize=(9, 5), layout="constrained")
for label, (observer, gain) in runs.items():
    axes.plot(*steer(observer, gain), ".-", label=label)
axes.axhline(0.0, color="black", linewidth=0.5)
axes.set(xlabel="time [ms]", ylabel="error in x [µm]", title="A step of 1 mm, seen 3 frames late")
axes.legend()
plt.show()
