// Costs of the poses of a grid: for each heading and position, the sum of a map's levels at the cells of all points.
//
// For one heading a point is a fixed offset (shift) into the map: score(row, column) = sum over points of
// level[row stride + column + shift] / (COST_LEVELS used). Adjacent positions read adjacent cells. The sums are of integers:
// exact in any order.
//
// Inputs:  level (map rows, stride) uint16, 0 to COST_LEVELS; shifts (used,) of one heading.
// Outputs: scores (headings, rows, columns) float32, 0 to 1, with WITH_SCORES; least (headings, rows, blocks) float32,
//          the least score of each block of BLOCK adjacent positions; column (headings, rows, blocks) int32, its
//          column, the first of equal scores. NaN scores where no point is used.
// Options: COST_LEVELS: the cost 1 in the map; WITH_SCORES.
// Variants: vector (sum_rows): 64 positions at once in four vectors of 16, for some rows; work-item (sum_block): a
//          group of BLOCK items per block, an item per position.
#ifndef SHIFT_SUMS_H
#define SHIFT_SUMS_H

#define BLOCK 64
// Number of levels that are summed in 16 bits without overflow: 64 * 1023 = 65472 < 65536.
#define CHUNK 64
#define NO_KEY 0xffffffffu
#define NO_BLOCK (-2) // neither a block nor the one before block 0

// Return the first column of a block. The last block moves back to end with the row, and repeats some positions.
static inline int block_from(int block, int columns) { return min(block * BLOCK, max(columns - BLOCK, 0)); }

// Return the factor from a sum to a score; NaN if no point is used.
static inline float score_scale(int used) { return used ? 1.0f / (float)(COST_LEVELS * used) : NAN; }

// Store the least score of a block and its column from a key, sum * BLOCK + position in the block.
//
// The least key holds the least sum, and among equal sums the first position: one minimum finds both. It fits 32 bits:
// 4096 points * 1023 * 64 < 2^32.
static inline void store_least(uint key, float scale, global float *least, global int *column, size_t to, int from) {
    least[to] = (float)(key / BLOCK) * scale;
    column[to] = from + (int)(key % BLOCK);
}

#ifdef VECTOR_VARIANT
typedef ushort16 ushorts_at __attribute__((aligned(2)));
typedef float16 floats_at __attribute__((aligned(4)));

#define LOWER(a, b) ((a) < (b) ? (a) : (b))

// Return the minimum over the lanes.
static inline uint min_of_lanes(uint16 of) {
    const uint8 eight = LOWER(of.lo, of.hi);
    const uint4 four = LOWER(eight.lo, eight.hi);
    const uint2 two = LOWER(four.lo, four.hi);
    return LOWER(two.x, two.y);
}

// Sums of the levels of all points at the BLOCK positions of a block, 16 positions in a vector.
typedef struct {
    uint16 a, b, c, d;
} block_sums;

// Sum the BLOCK positions from `here` on.
//
// Chunks of CHUNK points are summed in 16 bits, then added to sums of 32 bits: this doubles the lanes per instruction,
// compared with 32 bits throughout.
static inline block_sums sum_positions(global const ushort *here, private const int *shifts, int used) {
    block_sums sums = {0, 0, 0, 0};
    for (int chunk = 0; chunk < used; chunk += CHUNK) {
        ushort16 p = 0, q = 0, r = 0, s = 0;
        const int last = min(chunk + CHUNK, used);
        for (int i = chunk; i < last; i++) {
            global const ushort *at = here + shifts[i];
            p += *(global const ushorts_at *)at;
            q += *(global const ushorts_at *)(at + 16);
            r += *(global const ushorts_at *)(at + 32);
            s += *(global const ushorts_at *)(at + 48);
        }
        sums.a += convert_uint16(p);
        sums.b += convert_uint16(q);
        sums.c += convert_uint16(r);
        sums.d += convert_uint16(s);
    }
    return sums;
}

// Sum the BLOCK positions from `here` on, of which the first half is known: the sums of 32 positions at `known`.
static inline block_sums sum_last_half(global const ushort *here, private const int *shifts, int used, private const uint *known) {
    block_sums sums = {vload16(0, known), vload16(1, known), 0, 0};
    for (int chunk = 0; chunk < used; chunk += CHUNK) {
        ushort16 r = 0, s = 0;
        const int last = min(chunk + CHUNK, used);
        for (int i = chunk; i < last; i++) {
            global const ushort *at = here + shifts[i];
            r += *(global const ushorts_at *)(at + 32);
            s += *(global const ushorts_at *)(at + 48);
        }
        sums.c += convert_uint16(r);
        sums.d += convert_uint16(s);
    }
    return sums;
}

// Store the scores of a block of min(columns, BLOCK) positions at `to`; return its least key.
static inline uint store_scores(block_sums sums, int columns, float scale, global float *to) {
    const uint16 lane = (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const uint16 ka = sums.a * BLOCK + lane, kb = sums.b * BLOCK + lane + 16, kc = sums.c * BLOCK + lane + 32,
                 kd = sums.d * BLOCK + lane + 48;
    if (columns >= BLOCK) {
#ifdef WITH_SCORES
        *(global floats_at *)to = convert_float16(sums.a) * scale;
        *(global floats_at *)(to + 16) = convert_float16(sums.b) * scale;
        *(global floats_at *)(to + 32) = convert_float16(sums.c) * scale;
        *(global floats_at *)(to + 48) = convert_float16(sums.d) * scale;
#endif
        const uint16 ab = LOWER(ka, kb), cd = LOWER(kc, kd);
        return min_of_lanes(LOWER(ab, cd));
    }
    uint keys[BLOCK], key = NO_KEY;
    vstore16(ka, 0, keys);
    vstore16(kb, 1, keys);
    vstore16(kc, 2, keys);
    vstore16(kd, 3, keys);
    for (int k = 0; k < columns; k++) {
        key = min(key, keys[k]);
#ifdef WITH_SCORES
        to[k] = (float)(keys[k] / BLOCK) * scale;
#endif
    }
    return key;
}

// Sum all positions of the rows `first` to `end` - 1, for the shifts of one heading (index `turn`).
//
// A map narrower than a block is read beyond its columns (the host provides the cells), but only `columns` positions
// count. Where the last block overlaps the block before it by half a block or more, its first half is copied from the
// sums of that block, and only the second half is summed: 81 columns cost 96 sums, not 128.
static inline void sum_rows(global const ushort *restrict level, private const int *shifts, int used, int turn,
                            int first, int end, int rows, int columns, int stride, global float *restrict scores,
                            global float *restrict least, global int *restrict column) {
    const int blocks = (columns + BLOCK - 1) / BLOCK, remainder = columns - (blocks - 1) * BLOCK;
    const int half_known = blocks > 1 && remainder <= BLOCK / 2 ? blocks - 1 : NO_BLOCK;
    const float scale = score_scale(used);
    for (int row = first; row < end; row++) {
        const size_t place = (size_t)turn * rows + row;
        uint previous[BLOCK];
        for (int block = 0; block < blocks; block++) {
            const int from = block_from(block, columns);
            global const ushort *here = level + (size_t)row * stride + from;
            block_sums sums;
            if (block == half_known) sums = sum_last_half(here, shifts, used, previous + remainder);
            else sums = sum_positions(here, shifts, used);
            if (block + 1 == half_known) {
                vstore16(sums.a, 0, previous);
                vstore16(sums.b, 1, previous);
                vstore16(sums.c, 2, previous);
                vstore16(sums.d, 3, previous);
            }
            const uint key = store_scores(sums, columns, scale, scores + place * columns + from);
            store_least(key, scale, least, column, place * blocks + block, from);
        }
    }
}
#else
// Sum one block of positions with a group of BLOCK items. The caller sets `key` to NO_KEY and fills `shifts`, followed
// by a barrier.
static inline void sum_block(global const ushort *restrict level, local const int *shifts, int used, local uint *key,
                             int columns, int stride, global float *restrict scores, global float *restrict least,
                             global int *restrict column) {
    const int item = (int)get_local_id(0), block = (int)get_group_id(0), row = (int)get_group_id(1),
              turn = (int)get_group_id(2), rows = (int)get_num_groups(1), blocks = (int)get_num_groups(0);
    const int from = block_from(block, columns), at = from + item;
    const float scale = score_scale(used);
    const size_t place = (size_t)turn * rows + row;
    if (at < columns) {
        global const ushort *here = level + (size_t)row * stride + at;
        uint sum = 0;
        for (int i = 0; i < used; i++) sum += here[shifts[i]];
        atomic_min(key, sum * BLOCK + (uint)item);
#ifdef WITH_SCORES
        scores[place * columns + at] = (float)sum * scale;
#endif
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) store_least(*key, scale, least, column, place * blocks + block, from);
}
#endif

#endif
