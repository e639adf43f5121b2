// Peak performance of a device: kernels that only move bytes, and a kernel that only computes.
#include "common/team.h"

typedef float16 vector_at __attribute__((aligned(4)));

// A kernel that reads and writes more than the last cache holds bypasses the caches (PAST_CACHES); its copy is tried with
// and without. Memory objects are aligned to 128 bytes.
#ifdef PAST_CACHES
static inline void write_vector(float16 value, global float *to) {
    __builtin_nontemporal_store(value, (global float16 *)to);
}
#else
static inline void write_vector(float16 value, global float *to) { *(global vector_at *)to = value; }
#endif

static inline float16 read_vector(global const float *from) {
#ifdef PREFETCH
    __builtin_prefetch((const void *)((ulong)from + 2048), 0, 3);
#endif
    return *(global const vector_at *)from;
}

// Reads `reads` and writes `writes` vectors of 64 bytes. Every work-item has a contiguous share of equal size, and takes
// turns of TURN reads and the same part of its writes, as kernels that stream do. A copy that reads its whole share
// before it writes takes 1.1 to 1.2 times as long.
// Build options: PAST_CACHES; PREFETCH (reads are prefetched 2 KiB ahead, which some compilers and sizes gain by).
#define TURN 16
kernel void move(global const float *from, global float *to, long reads, long writes TEAM_ARGUMENTS) {
    const long items = ITEM_COLUMNS;
    FOR_EACH_ITEM(item) {
        const long share = item.x, first = reads * share / items, end = reads * (share + 1) / items;
        const long first_write = writes * share / items, end_write = writes * (share + 1) / items;
        long write = first_write;
        float16 sum = 0;
        for (long begin = first; begin < end; begin += TURN) {
            const long stop = min(begin + TURN, end);
            for (long i = begin; i < stop; i++) sum += read_vector(from + 16 * i);
            const long until = first_write + (end_write - first_write) * (stop - first) / (end - first);
            for (; write < until; write++) write_vector(sum, to + 16 * write);
        }
        for (; write < end_write; write++) write_vector(sum, to + 16 * write);  // of a work-item that reads nothing
        // A work-item without writes must still use its sum, or the compiler would remove the reads.
        if (first_write == end_write && sum.s0 == 1.0e30f) to[0] = sum.s1;
    }
}

// The same for devices where neighbouring work-items should touch neighbouring words.
kernel void move_items(global const float *from, global float *to, long reads, long writes) {
    const long item = get_global_id(0), items = get_global_size(0);
    float sum = 0;
    for (long i = item; i < 16 * reads; i += items) sum += from[i];
    for (long i = item; i < 16 * writes; i += items) to[i] = sum;
    if (item >= 16 * writes && sum == 1.0e30f) to[0] = sum;
}

// `steps` times 8 independent chains of 16 multiply-adds in each work-item.
kernel void compute(global float *to, float start, float factor, int steps) {
    float16 a = start, b = start + 1, c = start + 2, d = start + 3, e = start + 4, f = start + 5, g = start + 6, h = start + 7;
    const float16 by = factor;
    for (int i = 0; i < steps; i++) {
        a = fma(a, by, by), b = fma(b, by, by), c = fma(c, by, by), d = fma(d, by, by);
        e = fma(e, by, by), f = fma(f, by, by), g = fma(g, by, by), h = fma(h, by, by);
    }
    *(global vector_at *)(to + 16 * get_global_id(0)) = a + b + c + d + e + f + g + h;
}
