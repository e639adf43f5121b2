// 64 bytes of neighbouring samples at once: one cache line, the shape in which a CPU runtime reads memory best.
//
// Vectors of 32 and 64 elements are the compiler's (clang's, as in every CPU runtime), beyond OpenCL C's 16. Only
// builds under VECTOR_VARIANT include this file.
#ifndef LINE_WIDE_H
#define LINE_WIDE_H

#include "line/line_profiles.h"

#define WIDE (512 / CODE_BITS)
#define QUARTERS (WIDE / 16)  // groups of 16 lanes in it

#if CODE_BITS == 8
typedef uchar wides __attribute__((ext_vector_type(64)));
typedef uchar wide_steps __attribute__((ext_vector_type(64)));
typedef ushort halves __attribute__((ext_vector_type(32)));
typedef uchar16 step_lanes16;
#elif CODE_BITS == 16
typedef ushort wides __attribute__((ext_vector_type(32)));
typedef ushort wide_steps __attribute__((ext_vector_type(32)));
typedef uint16 halves;
typedef ushort16 step_lanes16;
#else
typedef float16 wides;
typedef int16 wide_steps;
typedef int16 step_lanes16;
#endif
typedef wides wides_at __attribute__((aligned(sizeof(CODE))));

inline wides wide_load(global const CODE *at) { return *(global const wides_at *)at; }

// Into the second cache what is needed some blocks later: the hardware does not guess a walk in blocks.
#define BLOCKS_AHEAD 4
#ifdef PREFETCH
#define prefetch_line(at) __builtin_prefetch((const void *)(ulong)(at), 0, 2)
#else
#define prefetch_line(at)
#endif

// Where a later block is fetched from: line by line in the order of memory, whatever order the block is worked in.
typedef struct {
    global const CODE *at, *end;
    int gap, extent;
} Ahead;

inline void fetch_lines(Ahead *ahead) {
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

inline int lowest(int16 v) {
    const int8 a = min(v.lo, v.hi);
    const int4 b = min(a.lo, a.hi);
    const int2 c = min(b.lo, b.hi);
    return min(c.x, c.y);
}
inline int highest(int16 v) { return -lowest(-v); }

#endif
