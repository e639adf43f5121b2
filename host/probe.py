"""Probe of a device: build, launch and check a kernel in a separate process.

A runtime may list a device and then fail every build, compute wrong results, or abort the process. Run as
``python -m gpuvision.host.probe PLATFORM DEVICE``, an abort ends this process only. Prints one line of JSON.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host.runtime import expose_installed_runtime

# The language features that the kernels need: vectors of 16 and their built-in functions (the PoCL of PyPI aborts in
# fabs(float16) on new processors), a loop, local memory with a barrier, saturation.
_SOURCE = """
kernel void probe(global const uchar *bytes, global uint *sums, local uint *shared, int rows)
{
    uint16 sum = 0;
    for (int row = 0; row < rows; row++) {
        const uchar16 value = vload16(row, bytes);
        sum += convert_uint16(sub_sat(value, (uchar16)20));
        sum += convert_uint16(fabs(convert_float16(value) - 100.0f));
    }
    uint8 half_ = sum.lo + sum.hi;
    uint4 quarter = half_.lo + half_.hi;
    shared[get_local_id(0)] = quarter.x + quarter.y + quarter.z + quarter.w + (uint)get_global_id(0);
    barrier(CLK_LOCAL_MEM_FENCE);
    sums[get_global_id(0)] = shared[get_local_size(0) - 1 - get_local_id(0)];
}
"""
# Size of the probe's problem: an odd number of rows, and several work-groups.
_ROWS, _ITEMS, _GROUP = 37, 64, 16


def probe_device(device: Any) -> str:
    """Return the reason why a device is not healthy; an empty string for a healthy device."""
    try:
        context = cl.Context([device])
        queue = cl.CommandQueue(context)
        program: Any = cl.Program(context, _SOURCE)
        kernel: Any = cl.Kernel(program.build(cache_dir=False), "probe")
        values = (np.arange(16 * _ROWS) * 7 % 256).astype(np.uint8)
        sums = np.zeros(_ITEMS, np.uint32)
        source = cl.Buffer(context, cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR, hostbuf=values)
        target = cl.Buffer(context, cl.mem_flags.WRITE_ONLY, sums.nbytes)
        kernel(queue, (_ITEMS,), (_GROUP,), source, target, cl.LocalMemory(4 * _GROUP), np.int32(_ROWS))
        cl.enqueue_copy(queue, sums, target)
    except cl.Error as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        messages = [line for line in lines if "error" in line.lower()] or lines
        return "; ".join(messages[:2])[:300]
    signed = values.astype(int)
    total = int(np.maximum(signed - 20, 0).sum() + np.abs(signed - 100).sum())
    item = np.arange(_ITEMS)
    expected = total + item // _GROUP * _GROUP + (_GROUP - 1 - item % _GROUP)
    return "" if np.array_equal(sums, expected) else "the probe kernel ran and gave wrong numbers"


def main() -> None:
    """Probe the device whose platform and device index are on the command line."""
    expose_installed_runtime()
    platform, device = (int(word) for word in sys.argv[1:3])
    print(json.dumps({"reason": probe_device(cl.get_platforms()[platform].get_devices()[device])}))


if __name__ == "__main__":
    main()
