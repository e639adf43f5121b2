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
// Options: COST_LEVELS: the cost 1 in the map; WITH_SCORES; STRIP (vector variant): vectors of POSITIONS that are summed
//          together.
// Variants: vector (sum_rows): STRIP * POSITIONS positions at once in registers, for some rows; work-item (sum_block): a
//          group of BLOCK items per block, an item per position.
#ifndef SHIFT_SUMS_H
#define SHIFT_SUMS_H

#define BLOCK 64
// Number of levels that are summed in 16 bits without overflow: 64 * 1023 = 65472 < 65536.
#define CHUNK 64
#define NO_KEY 0xffffffffu

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
#define POSITIONS 32 // positions in a vector: 64 bytes
#define TILE 8192    // sums that a work-item keeps, at least the positions of the longest row
typedef ushort levels __attribute__((ext_vector_type(POSITIONS)));
typedef levels levels_at __attribute__((aligned(2)));
typedef float16 floats_at __attribute__((aligned(4)));
typedef uint16 uints_at __attribute__((aligned(4)));
typedef ushort16 ushorts_at __attribute__((aligned(2)));
// Sums of the rows of a tile: of 16 bits for up to CHUNK shifts, otherwise of 32 bits.
typedef union {
    ushort narrow[TILE];
    uint wide[TILE];
} tile_sums __attribute__((aligned(64)));

#define UNROLLED _Pragma("unroll")
#define LOWER(a, b) ((a) < (b) ? (a) : (b))
#define LANES_OF_LEVELS                                                                                                \
    ((levels)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27,   \
              28, 29, 30, 31))

// Return the minimum over the lanes.
static inline uint min_of_lanes(uint16 of) {
    const uint8 eight = LOWER(of.lo, of.hi);
    const uint4 four = LOWER(eight.lo, eight.hi);
    const uint2 two = LOWER(four.lo, four.hi);
    return LOWER(two.x, two.y);
}

// Add the levels of STRIP * POSITIONS positions to sums; `left`: positions of the row from `at` on.
//
// The vectors follow each other, but for the last one, which begins at position last_start().
#if defined(__AVX512BW__) && __has_builtin(__builtin_ia32_vpermi2varhi512)
// A load that crosses a cache line takes two accesses. Here whole lines are loaded, one more than vectors, and a
// permutation of two neighbours gives a vector: a quarter less time. Every line holds a level that the other form reads,
// too, so that no load leaves the pages of the map.
typedef short permuted __attribute__((vector_size(sizeof(levels))));
static inline levels permute(levels low, levels order, levels high) {
    const permuted result = __builtin_ia32_vpermi2varhi512(
        __builtin_astype(low, permuted), __builtin_astype(order, permuted), __builtin_astype(high, permuted));
    return __builtin_astype(result, levels);
}
static inline int last_start(int left) { return (STRIP - 1) * POSITIONS; }
static inline void add_levels(global const ushort *at, int left, private levels *sums) {
    const size_t line_bytes = sizeof(levels), first = (size_t)at;
    const size_t last = (size_t)(at + min(left, STRIP * POSITIONS) - 1);
    const levels order = LANES_OF_LEVELS + (levels)(ushort)(first % line_bytes / sizeof(ushort));
    global const levels *lines = (global const levels *)(first & ~(line_bytes - 1));
    levels line = lines[0];
    UNROLLED
    for (int k = 0; k < STRIP - 1; k++) {
        const levels next = lines[k + 1];
        sums[k] += permute(line, order, next);
        line = next;
    }
    sums[STRIP - 1] += permute(line, order, *(global const levels *)(last & ~(line_bytes - 1)));
}
#else
static inline int last_start(int left) { return max(min(left, STRIP * POSITIONS), BLOCK) - POSITIONS; }
static inline void add_levels(global const ushort *at, int left, private levels *sums) {
    UNROLLED
    for (int k = 0; k < STRIP - 1; k++) sums[k] += *(global const levels_at *)(at + k * POSITIONS);
    sums[STRIP - 1] += *(global const levels_at *)(at + last_start(left));
}
#endif

// Add sums of 16 bits to sums of 32 bits.
static inline void keep_sums(levels sums, private uint *to) {
    private uints_at *low = (private uints_at *)to, *high = (private uints_at *)(to + 16);
    *low += convert_uint16(sums.lo);
    *high += convert_uint16(sums.hi);
}

// Sum STRIP * POSITIONS positions from `here` on, for up to CHUNK shifts: 16 bits suffice. Narrow sums are stored from
// `at` on; otherwise the sums of all but the first `known` vectors are added to the wide sums.
static inline void sum_strip(global const ushort *here, private const int *shifts, int count, int left, int known,
                             int is_narrow, int at, private tile_sums *tile) {
    levels sums[STRIP];
    UNROLLED
    for (int k = 0; k < STRIP; k++) sums[k] = 0;
    for (int i = 0; i < count; i++) add_levels(here + shifts[i], left, sums);
    const int start = last_start(left);
    if (is_narrow) {
        private ushort *to = tile->narrow + at;
        UNROLLED
        for (int k = 0; k < STRIP - 1; k++) *(private levels_at *)(to + k * POSITIONS) = sums[k];
        *(private levels_at *)(to + start) = sums[STRIP - 1];
        return;
    }
    private uint *to = tile->wide + at;
    UNROLLED
    for (int k = 0; k < STRIP - 1; k++)
        if (k >= known) keep_sums(sums[k], to + k * POSITIONS);
    // The last vector may repeat positions of the one before it.
    const levels lane = LANES_OF_LEVELS + (levels)(ushort)start;
    keep_sums(lane >= (levels)(ushort)((STRIP - 1) * POSITIONS) ? sums[STRIP - 1] : (levels)0, to + start);
}

// Return 16 sums of a tile.
static inline uint16 sums_at(private const tile_sums *tile, int is_narrow, int at) {
    if (is_narrow) return convert_uint16(*(private const ushorts_at *)(tile->narrow + at));
    return *(private const uints_at *)(tile->wide + at);
}

// Store the scores of a block of min(columns, BLOCK) positions, with the sums from `at` on, at `to`; return its least key.
static inline uint store_scores(private const tile_sums *tile, int is_narrow, int at, int columns, float scale,
                                global float *to) {
    const uint16 lane = (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    uint16 least = NO_KEY;
    if (columns >= BLOCK) {
        UNROLLED
        for (int k = 0; k < BLOCK; k += 16) {
            const uint16 part = sums_at(tile, is_narrow, at + k), key = part * BLOCK + (lane + (uint)k);
            least = LOWER(least, key);
#ifdef WITH_SCORES
            *(global floats_at *)(to + k) = convert_float16(part) * scale;
#endif
        }
        return min_of_lanes(least);
    }
    uint key = NO_KEY;
    for (int k = 0; k < columns; k++) {
        const uint sum = is_narrow ? tile->narrow[at + k] : tile->wide[at + k];
        key = min(key, sum * BLOCK + (uint)k);
#ifdef WITH_SCORES
        to[k] = (float)sum * scale;
#endif
    }
    return key;
}

// Sum all positions of the rows `first` to `end` - 1, for the shifts of one heading (index `turn`).
//
// All rows of a tile are summed for a chunk of shifts before the next chunk: the chunk reads parts of the map that stay in
// the caches. The scores are computed after the tile, when the sums have left the store buffers. A map narrower than a
// block is read beyond its columns (the host provides the cells), but only `columns` positions count.
static inline void sum_rows(global const ushort *restrict level, private const int *shifts, int used, int turn,
                            int first, int end, int rows, int columns, int stride, global float *restrict scores,
                            global float *restrict least, global int *restrict column) {
    const int blocks = (columns + BLOCK - 1) / BLOCK;
    const int vectors = (max(columns, BLOCK) + POSITIONS - 1) / POSITIONS, length = vectors * POSITIONS;
    const int tile = TILE / length;
    const float scale = score_scale(used);
    const int is_narrow = used <= CHUNK;
    tile_sums sums;
    for (int top = first; top < end; top += tile) {
        const int bottom = min(top + tile, end);
        if (!is_narrow)
            for (int k = 0; k < (bottom - top) * length; k += 16) *(private uint16 *)(sums.wide + k) = 0;
        // Without shifts one pass stores sums of 0.
        for (int chunk = 0; chunk < max(used, 1); chunk += CHUNK) {
            const int count = min(used - chunk, CHUNK);
            for (int row = top; row < bottom; row++) {
                global const ushort *here = level + (size_t)row * stride;
                for (int vector = 0; vector < vectors; vector += STRIP) {
                    const int from = min(vector, vectors - STRIP), at = from * POSITIONS;
                    sum_strip(here + at, shifts + chunk, count, columns - at, vector - from, is_narrow,
                              (row - top) * length + at, &sums);
                }
            }
        }
        for (int row = top; row < bottom; row++) {
            const size_t place = (size_t)turn * rows + row;
            for (int block = 0; block < blocks; block++) {
                const int from = block_from(block, columns);
                const uint key = store_scores(&sums, is_narrow, (row - top) * length + from, columns, scale,
                                              scores + place * columns + from);
                store_least(key, scale, least, column, place * blocks + block, from);
            }
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
