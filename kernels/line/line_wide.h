// Wide vectors: WIDE neighbouring samples (64 bytes, one cache line) at once, the unit in which a CPU reads memory
// best.
//
// Vectors of 32 and 64 elements are an extension of clang, which all CPU runtimes use; OpenCL C ends at 16. Only builds
// under VECTOR_VARIANT include this file. A wide vector consists of QUARTERS groups of 16 lanes.
// Build options: PREFETCH fetches memory ahead of its use.
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

// Memory is prefetched into the second-level cache a few blocks ahead: the hardware does not predict a walk in blocks.
#define BLOCKS_AHEAD 4
static inline void prefetch_line(global const CODE *at) {
#ifdef PREFETCH
    __builtin_prefetch((const void *)(ulong)at, 0, 2);
#endif
}

// The next addresses of a block to prefetch, row by row in the order of memory, independent of the order of the
// computation.
typedef struct {
    global const CODE *at, *end;  // next address, and end of the current row of the block
    int gap, extent;              // elements from the end of a row to the next row, and elements of a row
} Ahead;

static inline void prefetch_lines(Ahead *ahead) {
    prefetch_line(ahead->at);
    prefetch_line(ahead->at + WIDE);
    prefetch_line(ahead->at + 2 * WIDE);
    prefetch_line(ahead->at + 3 * WIDE);
    ahead->at += 4 * WIDE;
    if (ahead->at >= ahead->end) {
        ahead->at = ahead->end + ahead->gap;
        ahead->end = ahead->at + ahead->extent;
    }
}

static inline int highest(int16 v) { return -lowest_lane(-v); }

static inline real sum_of(real16 v) {
    const real8 a = v.lo + v.hi;
    const real4 b = a.lo + a.hi;
    return (b.x + b.y) + (b.z + b.w);
}

#endif
