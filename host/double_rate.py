"""Rate of double precision of a device, measured once for each driver and kept in the cache folder."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host.kept_numbers import driver_key, kept_number

# Doubles are slow where a multiply-add takes longer than this many multiply-adds of floats. Derived: a sum or a product
# of two floats (kernels/common/two_float.h) takes 8 to 20 operations. GPUs have doubles at 1/2 to 1/16 or at 1/32 to
# 1/64 of the float rate: the limit lies between.
SLOW_RATIO = 22.0
# Work-items, and multiply-adds of each in each of 8 chains (chosen): 0.3e9 multiply-adds take 10 us to 3 ms in single
# precision, longer than the launch of the kernel, and less than 0.1 s in slow doubles.
_ITEMS, _ROUNDS = 1 << 17, 256
_LAUNCHES = 3  # timed launches of each precision, of which the fastest counts; one more of each comes first

# Independent chains hide the latency of a multiply-add. The factors keep the numbers finite.
_SOURCE = """
#ifdef REAL_IS_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
typedef double8 real8;
#else
typedef float real;
typedef float8 real8;
#endif
kernel void chains(global real *out, const real factor, const real term, const int rounds) {
    real8 value = (real8)(0, 1, 2, 3, 4, 5, 6, 7) + (real)get_global_id(0);
    for (int k = 0; k < rounds; k++) value = mad(value, factor, term);
    out[get_global_id(0)] = value.s0 + value.s1 + value.s2 + value.s3 + value.s4 + value.s5 + value.s6 + value.s7;
}
"""


def double_ratio(handle: Any) -> float:
    """Return the time of a multiply-add in double precision over its time in single precision.

    Parameters
    ----------
    handle : pyopencl.Device

    Returns
    -------
    float
        Infinite on a device without doubles, and where the measurement fails. On a CPU 2, from the number of lanes in a
        vector register: a measurement would be of the load of the machine.

    Notes
    -----
    OpenCL has no query for the rate: ``CL_DEVICE_NATIVE_VECTOR_WIDTH_DOUBLE`` is 1 on GPUs of any rate. The measured
    ratio is kept for the device and the version of its driver; a failure is not kept. The first call takes some tenths
    of a second.
    """
    if not handle.double_fp_config:
        return math.inf
    if handle.type & cl.device_type.CPU:
        return 2.0
    try:
        return kept_number("double_rates.json", (*driver_key(handle), _SOURCE), lambda: _measured_ratio(handle))
    except cl.Error:  # for example no memory; kernels without doubles run on such a device
        return math.inf


def _measured_ratio(handle: Any) -> float:
    """Return the time of the fastest launch in double precision over the time of the fastest in single precision.

    The launches alternate, so that a change of the clock frequency meets both precisions.
    """
    launches = [_timed_launch(handle, real) for real in (np.float64, np.float32)]
    times = [[launch() for launch in launches] for _ in range(1 + _LAUNCHES)]
    double, single = np.min(times[1:], axis=0)
    return float(double / single)


def _timed_launch(handle: Any, real: type[np.floating[Any]]) -> Callable[[], float]:
    """Return a function that launches the kernel and returns the time of the launch [s]."""
    context = cl.Context([handle])
    queue = cl.CommandQueue(context, handle, properties=cl.command_queue_properties.PROFILING_ENABLE)
    options = ["-DREAL_IS_DOUBLE"] if real is np.float64 else []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cl.CompilerWarning)  # some runtimes report success as compiler output
        kernel = cl.Kernel(cl.Program(context, _SOURCE).build(options), "chains")
    out = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, _ITEMS * np.dtype(real).itemsize)

    def launch() -> float:
        event = kernel(queue, (_ITEMS,), None, out, real(0.5), real(1.0), np.int32(_ROUNDS))
        event.wait()
        return 1e-9 * max(event.profile.end - event.profile.start, 1)

    return launch
