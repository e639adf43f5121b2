// Work-item variant of the kernels that stream: samples of a work-item, and their loads. INPUT, INPUT2 and INPUT4 are
// the input's type and its vectors (build options).
//
// A work-item processes ITEM_SAMPLES samples that lie a work-group apart: neighbouring work-items process neighbouring
// samples, so that each request of a warp touches adjacent memory. Four neighbouring samples for each work-item would
// spread the stores of a warp over four times the memory. All loads come before the first store: they are under way
// together, although the compiler cannot know that outputs and inputs are apart.
#ifndef ITEM_SAMPLES_H
#define ITEM_SAMPLES_H

#ifndef VECTOR_VARIANT
#include "common/real.h"

#define ITEM_SAMPLES 4  // lanes of a real4 (ITEM_SAMPLES in host/work_size.py)
#ifdef REAL_IS_DOUBLE
typedef double2 real2;
#else
typedef float2 real2;
#endif

// First sample of this work-item, and the distance to its next sample. The group size is the one of the launch: the
// host halves the groups where a device lacks registers.
static inline ulong first_item_sample(void) {
    return (ulong)get_group_id(0) * ITEM_SAMPLES * get_local_size(0) + get_local_id(0);
}
static inline ulong item_step(void) { return get_local_size(0); }

// A caller's array is aligned to an element, but not always to a pair. The test is the same for all work-items.
static inline int is_aligned(global const void *to, size_t size) { return ((size_t)to & (size - 1)) == 0; }

static inline real4 to_real4(INPUT4 values) {
    return (real4)(convert_real(values.x), convert_real(values.y), convert_real(values.z), convert_real(values.w));
}

// Load the samples of this work-item. Beyond the last sample the last one is loaded again.
static inline real4 load_item_samples(global const INPUT *from, ulong count) {
    const ulong first = first_item_sample(), step = item_step(), last = count - 1;
    INPUT4 values;
    values.x = from[min(first, last)];
    values.y = from[min(first + step, last)];
    values.z = from[min(first + 2 * step, last)];
    values.w = from[min(first + 3 * step, last)];
    return to_real4(values);
}

// Load pairs of neighbouring elements, one pair for each sample: as one number of twice the size where the array is
// aligned to a pair. Two loads of single elements would touch the same sectors twice.
static inline void load_item_pairs(global const INPUT *from, ulong count, real4 *left, real4 *right) {
    const ulong first = first_item_sample(), step = item_step(), last = count - 1;
    const ulong a = min(first, last), b = min(first + step, last);
    const ulong c = min(first + 2 * step, last), d = min(first + 3 * step, last);
    INPUT4 low, high;  // pairs a and b, c and d
    if (is_aligned(from, sizeof(INPUT2))) {
        global const INPUT2 *pairs = (global const INPUT2 *)from;
        low = (INPUT4)(pairs[a], pairs[b]);
        high = (INPUT4)(pairs[c], pairs[d]);
    } else {
        low = (INPUT4)(from[2 * a], from[2 * a + 1], from[2 * b], from[2 * b + 1]);
        high = (INPUT4)(from[2 * c], from[2 * c + 1], from[2 * d], from[2 * d + 1]);
    }
    *left = to_real4((INPUT4)(low.even, high.even));
    *right = to_real4((INPUT4)(low.odd, high.odd));
}

#endif
#endif
