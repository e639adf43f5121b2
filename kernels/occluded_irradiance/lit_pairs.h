// Work-item variant of occluded_irradiance.cl: a work-group lists the pairs of receivers and segments that face each
// other, and its items work on the pairs.
//
// A tile is BLOCK = 16 receivers times TILE = 64 segments.
//   (1) Item s computes the frame of segment s, tests which of the 16 receivers face it, and writes a mask of 16 bits.
//   (2) A prefix sum of the numbers of facing receivers gives each segment its place in the list of pairs. The pairs of a
//       segment are neighbours: the items of a warp trace similar views.
//   (3) Item n takes the pairs n, n + GROUP, ... It traces the view in local memory (hidden intervals) and writes the light
//       in the place of the pair.
//   (4) Four items add up the light of a receiver, each over 16 segments in their order.
// No sum depends on the order in which items run: results are equal from run to run.
//
// Most pairs do not face each other. With one item for each receiver, the items of a warp would wait for the item that has
// most facing segments, and each item would compute the frames of all segments.
//
// Positions are `places` (common/places.h): doubles, or two floats. With two floats, the directions of frames are exact to
// 2^-42, the lengths of their axes to 2^-40 (place_per_root), and the heights of receivers above segments to 2^-42 of their
// distance, as in line_irradiance.cl, and to 2^-40 of the height.
//
// Local memory in single precision: 16 KiB hidden intervals, 6.5 KiB frames, 4 KiB list, and 2 KiB more, of the 32 KiB that
// every device has. In double precision the hidden intervals stay in private memory.
#ifndef LIT_PAIRS_H
#define LIT_PAIRS_H
#if defined(INTERVALS) && !defined(REAL_IS_DOUBLE)
#define HIDDEN_GROUP GROUP
#endif
#include "line_irradiance/line_irradiance.h"
#include "common/places.h"
#include "common/status.h"
#include "occluded_irradiance/segment_view.h"

#define BLOCK SELECTION_BLOCK
#define TILE GROUP
#define SUMMERS (GROUP / BLOCK)    // items that add up the light of one receiver
#define SHARE (TILE / SUMMERS)     // segments that each of them adds up
#define FRAME 13                   // numbers of a frame

// Counts of a tile in one word, so that one prefix sum serves all: pairs, segments with NaN or infinity, picks whose
// index is out of range.
#define ONE_BAD (1u << 11)
#define ONE_BEYOND (1u << 18)
#define PAIRS_OF(counts) ((counts) & (ONE_BAD - 1))
#define BAD_OF(counts) ((counts) & (ONE_BEYOND - ONE_BAD))
#define BEYOND_OF(counts) ((counts) & ~(ONE_BEYOND - 1))

// Type of the normals of receivers and of exitances.
#ifdef TWO_FLOAT_POSITIONS
typedef INPUT wide_number;
#else
typedef place wide_number;
#endif

// Start and axes of a segment as in segment_axes; 13 numbers in this order in local memory.
typedef struct {
    places x, y, z, ux, uy, uz, ex, ey, ez, wx, wy, wz, length;
} segment_frame;

typedef struct {
    place frames[FRAME * TILE]; // number k of segment s at k * TILE + s
    real exitance[TILE];        // exitance / (2 pi)
    uint counts[TILE];          // (2) counts, then place in the list << 16 | mask of receivers
    uchar is_open[TILE];        // no surface can hide the segment
    real list[BLOCK * TILE];    // (2) segment * BLOCK + receiver, then (3) light, with the sign bit where AMBIGUOUS
    place at[3 * BLOCK];        // positions of the receivers
    real normals[3 * BLOCK];    // unit normals
    uchar is_none[BLOCK];       // no receiver
    place sums[GROUP];          // (4)
    uchar unclear[GROUP];       // (4) an AMBIGUOUS pair
    place currents[2 * BLOCK];
#ifdef HIDDEN_GROUP
    real room[2 * HIDDEN_AT(MAX_HIDDEN)];
#endif
} pair_memory;

typedef struct {
    places x, y, z;
    real nx, ny, nz;
} group_receiver;

INLINE real real_of(places value) { return convert_to_reals(value); }

// Light of the visible parts of a segment, per unit of exitance / (2 pi).
typedef struct {
    const placement *from;
    real length;
    places light;
} receiving;

// Add the closed form of the part from fraction `start` to `stop`.
static inline void add_part(real start, real stop, receiving *seen) {
    if (!(start < stop)) return;
    const placement *from = seen->from;
    const real factor =
        line_factor(from->along - start * seen->length, from->height, from->aside,
                    from->past - ((real)1 - stop) * seen->length, (stop - start) * seen->length, from->by_u, from->by_n,
                    from->by_w);
    seen->light = place_plus_real(seen->light, factor);
}

#ifdef INTERVALS
// Add the part from `start` to `stop` without the sorted hidden intervals.
static inline void add_seen(const hidden *dark, real start, real stop, receiving *seen) {
    for (int n = 0; n <= dark->count && start < stop; n++) {
        add_part(start, n < dark->count ? fmin(dark->low[HIDDEN_AT(n)], stop) : stop, seen);
        if (n < dark->count) start = fmax(start, dark->high[HIDDEN_AT(n)]);
    }
}
#endif
#include "occluded_irradiance/visible_part.h"

// ---- segments --------------------------------------------------------------------------------------------------------

// Scale a vector by a power of two to a length of about 1, so that squares neither overflow nor underflow; return the
// reciprocal of the power. Doubles have the exponents for any vector of floats, and stay as they are.
static inline real scale_to_one(places *vector) {
#ifdef DOUBLE_POSITIONS
    return 1;
#else
    const real most = fmax(fmax(fabs(real_of(vector[0])), fabs(real_of(vector[1]))), fabs(real_of(vector[2])));
    const bits exponent = min(as_bits(most) & EXPONENT_BITS, 253 << 23);
    const places scale = convert_places(as_real((254 << 23) - exponent));
    for (int k = 0; k < 3; k++) vector[k] = places_times(vector[k], scale);
    return as_real(exponent);
#endif
}

// Frame of a segment. Returns whether it emits; `is_bad`: a number is not finite, or it emits without a normal.
static inline int frame_of(global const INPUT *row, constant place *middle, segment_frame *of, real *exitance, int *is_bad) {
    of->x = input_minus(row[0], middle[0]), of->y = input_minus(row[1], middle[1]);
    of->z = input_minus(row[2], middle[2]);
    places u[3], n[3];
    for (int k = 0; k < 3; k++) u[k] = input_difference(row[k + 3], row[k]);
    load_direction(row + 6, n);
    scale_to_one(n);
    const real unit = scale_to_one(u);
    const places square = places_dot(u[0], u[0], u[1], u[1], u[2], u[2]);
    const places lean = places_dot(u[0], n[0], u[1], n[1], u[2], n[2]);
    for (int k = 0; k < 3; k++) n[k] = places_minus(places_times(square, n[k]), places_times(lean, u[k]));
    const real size = fabs(real_of(n[0])) + fabs(real_of(n[1])) + fabs(real_of(n[2]));
    *exitance = (real)((wide_number)row[9] * (wide_number)0.15915494309189533577);
    const places per = place_per_root(square);
    of->length = places_times(places_times(square, per), convert_places(unit));
    const int emits = *exitance > 0 && real_of(square) > 0 && real_of(of->length) > 0;
    *is_bad = not_finite(real_of(of->x) + real_of(of->y) + real_of(of->z)) | not_finite(real_of(square) + size) |
              not_finite(*exitance) | (emits && size == 0);
    const places per_size = place_per_root(places_dot(n[0], n[0], n[1], n[1], n[2], n[2]));
    of->ux = places_times(u[0], per), of->uy = places_times(u[1], per), of->uz = places_times(u[2], per);
    of->ex = places_times(n[0], per_size), of->ey = places_times(n[1], per_size), of->ez = places_times(n[2], per_size);
    of->wx = places_minus(places_times(of->uy, of->ez), places_times(of->uz, of->ey));
    of->wy = places_minus(places_times(of->uz, of->ex), places_times(of->ux, of->ez));
    of->wz = places_minus(places_times(of->ux, of->ey), places_times(of->uy, of->ex));
    return emits && !*is_bad;
}

INLINE void store_vector(places x, places y, places z, local place *to) {
    to[0] = as_place(x), to[TILE] = as_place(y), to[2 * TILE] = as_place(z);
}

INLINE void store_frame(const segment_frame *of, local place *to) {
    store_vector(of->x, of->y, of->z, to);
    store_vector(of->ux, of->uy, of->uz, to + 3 * TILE);
    store_vector(of->ex, of->ey, of->ez, to + 6 * TILE);
    store_vector(of->wx, of->wy, of->wz, to + 9 * TILE);
    to[12 * TILE] = as_place(of->length);
}

INLINE segment_frame load_frame(local const place *from) {
    segment_frame of;
    of.x = load_place(from[0]), of.y = load_place(from[TILE]), of.z = load_place(from[2 * TILE]);
    of.ux = load_place(from[3 * TILE]), of.uy = load_place(from[4 * TILE]), of.uz = load_place(from[5 * TILE]);
    of.ex = load_place(from[6 * TILE]), of.ey = load_place(from[7 * TILE]), of.ez = load_place(from[8 * TILE]);
    of.wx = load_place(from[9 * TILE]), of.wy = load_place(from[10 * TILE]), of.wz = load_place(from[11 * TILE]);
    of.length = load_place(from[12 * TILE]);
    return of;
}

// ---- receivers -------------------------------------------------------------------------------------------------------

INLINE void load_receiver(global const INPUT *row, constant place *middle, uint number, local pair_memory *memory) {
    for (int k = 0; k < 3; k++) memory->at[3 * number + k] = as_place(input_minus(row[k], middle[k]));
    wide_number nx = row[3], ny = row[4], nz = row[5];
    const wide_number longest = fmax(fmax(fabs(nx), fabs(ny)), fabs(nz));
    nx /= longest, ny /= longest, nz /= longest;
    const wide_number per = 1 / sqrt(nx * nx + ny * ny + nz * nz);
    memory->normals[3 * number] = (real)(nx * per);
    memory->normals[3 * number + 1] = (real)(ny * per);
    memory->normals[3 * number + 2] = (real)(nz * per);
    memory->is_none[number] = row[3] == 0 && row[4] == 0 && row[5] == 0;
}

INLINE group_receiver receiver_at(local const pair_memory *memory, uint number) {
    local const place *at = memory->at + 3 * number;
    local const real *normal = memory->normals + 3 * number;
    return (group_receiver){load_place(at[0]), load_place(at[1]), load_place(at[2]), normal[0], normal[1], normal[2]};
}

// Whether a receiver and a segment face each other; if they do, the receiver in the segment's frame.
static inline int face(const group_receiver *here, const segment_frame *of, placement *from) {
    const places dx = places_minus(here->x, of->x), dy = places_minus(here->y, of->y);
    const places dz = places_minus(here->z, of->z);
    from->height = real_of(places_dot(dx, of->ex, dy, of->ey, dz, of->ez));
    if (!(from->height > 0)) return 0;
    const places along = places_dot(dx, of->ux, dy, of->uy, dz, of->uz);
    from->along = real_of(along);
    from->aside = real_of(places_dot(dx, of->wx, dy, of->wy, dz, of->wz));
    from->past = real_of(places_minus(of->length, along));
    const real nx = here->nx, ny = here->ny, nz = here->nz;
    from->by_u = nx * real_of(of->ux) + ny * real_of(of->uy) + nz * real_of(of->uz);
    from->by_n = nx * real_of(of->ex) + ny * real_of(of->ey) + nz * real_of(of->ez);
    from->by_w = nx * real_of(of->wx) + ny * real_of(of->wy) + nz * real_of(of->wz);
    const real foot = -(from->by_n * from->height + from->by_w * from->aside);
    from->toward = foot - from->by_u * from->along, from->toward_end = foot + from->by_u * from->past;
    return from->toward > 0 || from->toward_end > 0;
}

// ---- pairs -----------------------------------------------------------------------------------------------------------

// (1) Store the frame of this item's segment; return the set of receivers that face it. A negative pick ~k is segment k,
// which no surface can hide.
static inline uint facing_receivers(global const INPUT *segments, int pick, uint segment_count, constant place *middle,
                             uint receivers, local pair_memory *memory, uint *wrong) {
    const uint item = get_local_id(0), number = pick < 0 ? ~pick : pick;
    *wrong = 0;
    if (number >= segment_count) {
        *wrong = ONE_BEYOND;
        return 0;
    }
    segment_frame of;
    real exitance;
    int is_bad;
    const int emits = frame_of(segments + 10 * (ulong)number, middle, &of, &exitance, &is_bad);
    if (is_bad) *wrong = ONE_BAD;
    if (!emits) return 0;
    uint facing = 0;
    for (uint n = 0; n < receivers; n++) {
        const group_receiver here = receiver_at(memory, n);
        placement from;
        if (face(&here, &of, &from)) facing |= 1u << n;
    }
    memory->exitance[item] = exitance;
    memory->is_open[item] = pick < 0;
    store_frame(&of, memory->frames + item);
    return facing;
}

// (2) Prefix sum of the counts of the segments before this item; `all`: of all segments of the tile.
INLINE uint counts_before(local const uint *counts, uint *all) {
    const uint item = get_local_id(0);
    uint before = 0, total = 0;
    for (uint n = 0; n < TILE; n++) {
        before += n < item ? counts[n] : 0;
        total += counts[n];
    }
    *all = total;
    return before;
}

INLINE void list_pairs(uint facing, uint first, local pair_memory *memory) {
    const uint item = get_local_id(0);
    uint at = first;
    for (uint left = facing; left; left &= left - 1) memory->list[at++] = (real)(int)(item * BLOCK + lowest_bit(left));
}

// (3) Light of a pair, with the sign bit set where the visible parts are incomplete.
static inline real light_of(uint pair, const bvh_tree *tree, real clearance, uint samples,
                     local pair_memory *memory) {
    const uint segment = pair / BLOCK;
    const segment_frame frame = load_frame(memory->frames + segment);
    const group_receiver here = receiver_at(memory, pair % BLOCK);
    placement from;
    if (!face(&here, &frame, &from)) return 0;
    const real length = real_of(frame.length);
    receiving seen = {&from, length, convert_places(0)};
    int is_whole = 1;
#if defined(INTERVALS) || defined(RAYS)
    if (!memory->is_open[segment]) {
        const segment_axes of = {real_of(frame.x),  real_of(frame.y),  real_of(frame.z),  real_of(frame.ux), real_of(frame.uy),
                                 real_of(frame.uz), real_of(frame.ex), real_of(frame.ey), real_of(frame.ez), real_of(frame.wx),
                                 real_of(frame.wy), real_of(frame.wz), length};
        const observer at = {real_of(here.x), real_of(here.y), real_of(here.z), here.nx, here.ny, here.nz};
#ifdef INTERVALS
        view v = view_from(&of, &from, &at, clearance);
        hidden dark;
#ifdef HIDDEN_GROUP
        dark.low = memory->room + get_local_id(0), dark.high = dark.low + HIDDEN_AT(MAX_HIDDEN);
#endif
        is_whole = add_visible(tree, &from, &v, &dark, &seen);
#else
        add_sampled(tree, &of, &from, &at, clearance, samples, &seen);
#endif
    } else
#endif
        add_part(0, 1, &seen);
    const real light = memory->exitance[segment] * real_of(seen.light);
    return is_whole ? light : copysign(light, (real)-1);
}

// (4) Add the light that this item's share of the segments sends to its receiver.
INLINE places add_share(local const pair_memory *memory, places sum, uchar *unclear) {
    const uint receiver = get_local_id(0) % BLOCK, share = get_local_id(0) / BLOCK;
    for (uint s = share * SHARE; s < (share + 1) * SHARE; s++) {
        const uint entry = memory->counts[s];
        if (!(entry >> receiver & 1)) continue;
        const real light = memory->list[(entry >> 16) + popcount(entry & ((1u << receiver) - 1))];
        *unclear |= as_bits(light) < 0 && !not_finite(light);
        sum = place_plus_real(sum, fabs(light));
    }
    return sum;
}

// Store the result of a receiver; return its contribution to the currents per unit of weight.
INLINE places store_result(local const pair_memory *memory, uchar flag, global real *irradiance, global uchar *status) {
    const uint n = get_local_id(0);
    places light = load_place(memory->sums[n]);
    uchar unclear = memory->unclear[n];
    for (uint share = 1; share < SUMMERS; share++) {
        light = places_plus(light, load_place(memory->sums[share * BLOCK + n]));
        unclear |= memory->unclear[share * BLOCK + n];
    }
    const group_receiver here = receiver_at(memory, n);
    const int is_none = memory->is_none[n];
    const int bad_place = not_finite(real_of(here.x)) | not_finite(real_of(here.y)) | not_finite(real_of(here.z));
    const int bad_normal = not_finite(here.nx) | not_finite(here.ny) | not_finite(here.nz);
    const int is_bad = bad_place | (bad_normal && !is_none) | not_finite(real_of(light));
    const uchar wrong = flag | (is_bad ? STATUS_NOT_FINITE : 0);
    if (wrong) light = convert_places(REAL_NAN);
    *irradiance = is_none ? REAL_NAN : real_of(light);
    *status = is_none ? STATUS_NO_DATA : wrong | (unclear ? STATUS_AMBIGUOUS : 0);
    return is_none ? convert_places(0) : light;
}

#endif
