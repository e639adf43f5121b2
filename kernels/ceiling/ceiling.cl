// Peak performance of a device: kernels that only move bytes, and a kernel that only computes.

typedef float16 vector_at __attribute__((aligned(4)));

// Reads `reads` and writes `writes` vectors of 64 bytes; every work-item processes a contiguous share of equal size.
kernel void move(global const float *from, global float *to, long reads, long writes) {
    const long item = get_global_id(0), items = get_global_size(0);
    float16 sum = 0;
    for (long i = reads * item / items; i < reads * (item + 1) / items; i++)
        sum += *(global const vector_at *)(from + 16 * i);
    const long first = writes * item / items, end = writes * (item + 1) / items;
    for (long i = first; i < end; i++) *(global vector_at *)(to + 16 * i) = sum;
    // A work-item without writes must still use its sum, or the compiler would remove the reads.
    if (first == end && sum.s0 == 1.0e30f) to[0] = sum.s1;
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
