// Wide vectors: WIDE neighbouring samples (64 bytes, one cache line) at once, the unit in which a CPU reads memory
// best.
//
// Vectors of 32 and 64 elements are an extension of clang, which all CPU runtimes use; OpenCL C ends at 16. Only builds
// under VECTOR_VARIANT include this file. A wide vector consists of QUARTERS groups of 16 lanes.
// Build options: PREFETCH (the frames do not fit the caches), see highest_of_steps().
#ifndef LINE_WIDE_H
#define LINE_WIDE_H

#include "line/line_profiles.h"

#define WIDE (512 / CODE_BITS)
#define QUARTERS (WIDE / 16)

// wides: samples. wide_steps: a small number per sample. wide_pairs: the samples of a wide vector taken two by two as
// numbers of double width. step_lanes16: 16 lanes of wide_steps.
#if CODE_BITS == 8
typedef uchar wides __attribute__((ext_vector_type(64)));
typedef uchar wide_steps __attribute__((ext_vector_type(64)));
typedef ushort wide_pairs __attribute__((ext_vector_type(32)));
typedef uchar16 step_lanes16;
#elif CODE_BITS == 16
typedef ushort wides __attribute__((ext_vector_type(32)));
typedef ushort wide_steps __attribute__((ext_vector_type(32)));
typedef uint16 wide_pairs;
typedef ushort16 step_lanes16;
#else
typedef float16 wides;
typedef int16 wide_steps;
typedef int16 step_lanes16;
#endif
typedef wides wides_at __attribute__((aligned(sizeof(CODE))));

static inline wides wide_load(global const CODE *at) { return *(global const wides_at *)at; }

// Whether a lane of a is greater than the same lane of b.
static inline int any_greater(wides a, wides b) {
    const long8 whole = __builtin_astype(a > b, long8);
    const long4 half_of_it = whole.lo | whole.hi;
    const long2 quarter = half_of_it.lo | half_of_it.hi;
    return (quarter.x | quarter.y) != 0;
}

// Largest sample so far of every lane.
typedef struct {
    wides level;
#if CODE_BITS == 32
    wides poison;  // 0, or NaN after a sample that is not finite: x * 0 is NaN for infinity and NaN
#endif
} Highest;

static inline Highest darkest(void) {
    Highest highest;
    highest.level = DARKEST;
#if CODE_BITS == 32
    highest.poison = 0;
#endif
    return highest;
}

static inline void raise_highest(Highest *highest, wides x) {
    highest->level = x > highest->level ? x : highest->level;
#if CODE_BITS == 32
    highest->poison += x * 0;
#endif
}

// Fetch a cache line into the first-level cache.
static inline void prefetch_line(global const CODE *at) { __builtin_prefetch((const void *)(ulong)at, 0, 3); }

// The same where the frames come from memory. For frames in a cache, a prefetch of every line takes more time than it
// saves.
static inline void prefetch_from_memory(global const CODE *at) {
#ifdef PREFETCH
    prefetch_line(at);
#endif
}

// Largest of `steps` samples of every lane, at most STEPS: the first at `at`, the next ones `stride` elements further.
//
// A full block is unrolled, and each step prefetches the sample STEPS further on. The processor predicts the addresses
// of each load instruction separately: here an instruction reads neighbouring memory from call to call, in a loop it
// would jump from row to row. The prefetch gains 10 to 20 % where bytes come from memory and not from a cache; wider
// samples lose by it.
static inline Highest highest_of_steps(global const CODE *at, int stride, int steps) {
    Highest highest = darkest();
    if (steps == STEPS) {
        _Pragma("unroll") for (int k = 0; k < STEPS; k++) {
            prefetch_from_memory(at + (long)(k + STEPS) * stride);
            raise_highest(&highest, wide_load(at + (long)k * stride));
        }
    } else {
        for (int k = 0; k < steps; k++) raise_highest(&highest, wide_load(at + (long)k * stride));
    }
    return highest;
}

static inline int highest(int16 v) { return -lowest_lane(-v); }

static inline real sum_of(real16 v) {
    const real8 a = v.lo + v.hi;
    const real4 b = a.lo + a.hi;
    return (b.x + b.y) + (b.z + b.w);
}

#endif
