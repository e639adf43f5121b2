"""Rate of double precision of a device, measured once for each driver and kept in the cache folder."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host.kept_numbers import driver_key, kept_number

# Doubles are slow where a multiply-add takes longer than this many multiply-adds of floats. Derived: a sum or a product
# of two floats (kernels/common/two_float.h) takes 8 to 20 operations. GPUs have doubles at 1/2 to 1/16 or at 1/32 to
# 1/64 of the float rate: the limit lies between.
SLOW_RATIO = 22.0
# Work-items and multiply-adds of each (chosen): 0.3e9 multiply-adds take 10 us to 3 ms in single precision, longer than
# the launch of the kernel, and less than 0.1 s in slow doubles.
_ITEMS, _ROUNDS, _CHAINS = 1 << 17, 256, 8
_LAUNCHES = 3  # timed launches, of which the fastest counts; one more comes first

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
        Infinite on a device without doubles. On a CPU 2, from the number of lanes in a vector register: a measurement
        would be of the load of the machine.

    Notes
    -----
    OpenCL has no query for the rate: ``CL_DEVICE_NATIVE_VECTOR_WIDTH_DOUBLE`` is 1 on GPUs of any rate. The measured
    ratio is kept for the device and the version of its driver. The first call takes some tenths of a second.
    """
    if not handle.double_fp_config:
        return math.inf
    if handle.type & cl.device_type.CPU:
        return 2.0
    return kept_number(
        "double_rates.json",
        (*driver_key(handle), _SOURCE),
        lambda: _seconds(handle, np.float64) / _seconds(handle, np.float32),
    )


def _seconds(handle: Any, real: type[np.floating[Any]]) -> float:
    """Return the time of the fastest launch [s]."""
    context = cl.Context([handle])
    queue = cl.CommandQueue(context, handle, properties=cl.command_queue_properties.PROFILING_ENABLE)
    options = ["-DREAL_IS_DOUBLE"] if real is np.float64 else []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cl.CompilerWarning)  # some runtimes report success as compiler output
        kernel = cl.Kernel(cl.Program(context, _SOURCE).build(options), "chains")
    out = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, _ITEMS * np.dtype(real).itemsize)
    kernel.set_args(out, real(0.5), real(1.0), np.int32(_ROUNDS))
    events = [cl.enqueue_nd_range_kernel(queue, kernel, (_ITEMS,), None) for _ in range(1 + _LAUNCHES)]
    queue.finish()
    return min(1e-9 * max(event.profile.end - event.profile.start, 1) for event in events[1:])
