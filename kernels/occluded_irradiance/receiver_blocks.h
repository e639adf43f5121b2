// Vector variant of occluded_irradiance.cl: blocks of 16 receivers in the lanes of a vector.
//
// Order of work for BATCH blocks and a line: (1) facing tests of 16 receivers with the line reject most pairs; (2) the
// receivers that face the line are packed, so that the facing tests with the segments of the line have full vectors;
// (3) the visible parts of the packed receivers are found one by one; (4) the visible parts of any receivers and segments
// are collected until 16 of them fill the vectors of the closed form. The segments are grouped into lines once per batch.
#ifndef RECEIVER_BLOCKS_H
#define RECEIVER_BLOCKS_H
#include "line_irradiance/line_irradiance.h"
#include "occluded_irradiance/lit_lines.h"
#include "common/status.h"
#include "occluded_irradiance/segment_view.h"

#if LANES != SELECTION_BLOCK
#error a list of segments serves the receivers of one vector
#endif

#define COLUMN_TYPE places
#define CONVERT_COLUMN LANED(convert_place)
#include "common/six_columns.h"

// Number of blocks of a batch. Receivers with their own lists of segments are processed block by block.
#ifdef SELECTED
#define BATCH 1
#else
#define BATCH 16
#endif
// Least number of receivers of a block that face a line, so that the block is not packed (speed only).
#define LEAST_UNPACKED 10

// Receivers in the frame of a segment, as line_irradiance.h takes them.
typedef struct {
    real along[LANES], height[LANES], aside[LANES], past[LANES], by_u[LANES], by_n[LANES], by_w[LANES];
    real toward[LANES], toward_end[LANES]; // height of the segment's ends above the receiver's plane
} facing;

// Receivers in front of a line, in the line's frame and in the frames of its segments, and the lanes that face each
// segment.
typedef struct {
    facing whole, own[SEGMENTS];
    uint lanes[SEGMENTS];
} before;

// Visible parts of segments that wait for the closed form, each with the sum of its receiver.
typedef struct {
    real along[LANES], height[LANES], aside[LANES], past[LANES], length[LANES], by_u[LANES], by_n[LANES], by_w[LANES];
    real exitance[LANES];
    place *sum[LANES];
    int count;
} pieces;

// Evaluate the closed form of the waiting parts; unused lanes have height 0, which gives 0.
static inline __attribute__((noinline)) void finish(pieces *waiting) {
    for (int n = waiting->count; n < LANES; n++) waiting->height[n] = 0;
    const reals factor = LANED(line_factor)(load_private(waiting->along), load_private(waiting->height),
                                            load_private(waiting->aside), load_private(waiting->past),
                                            load_private(waiting->length), load_private(waiting->by_u),
                                            load_private(waiting->by_n), load_private(waiting->by_w));
    real light[LANES];
    store_private(load_private(waiting->exitance) * factor, light);
    for (int n = 0; n < waiting->count; n++) *waiting->sum[n] += light[n];
    waiting->count = 0;
}

// Append the part of segment k from fraction `start` to `stop`, which is visible from the receiver of a lane.
static inline __attribute__((noinline)) void add_piece(const chunk *lit, int k, const facing *all, int lane, real start, real stop,
                                         pieces *waiting, place *sum) {
    if (!(start < stop)) return;
    const int n = waiting->count++;
    const real length = (real)lit->each.length[k];
    waiting->along[n] = all->along[lane] - start * length;
    waiting->height[n] = all->height[lane];
    waiting->aside[n] = all->aside[lane];
    waiting->past[n] = all->past[lane] - ((real)1 - stop) * length;
    waiting->length[n] = (stop - start) * length;
    waiting->by_u[n] = all->by_u[lane], waiting->by_n[n] = all->by_n[lane], waiting->by_w[n] = all->by_w[lane];
    waiting->exitance[n] = lit->exitance[k];
    waiting->sum[n] = sum;
    if (waiting->count == LANES) finish(waiting);
}

// Receiver of a lane before a line, with its place for the visible parts.
typedef struct {
    const chunk *lit;
    int line, lane;
    const before *all;
    pieces *waiting;
    place *sum; // of the receiver
#ifdef RAYS
    int segment; // whose parts are seen
#endif
} receiving;

#ifdef INTERVALS
// Append the visible parts of segment k: the part of the line from `from` to `to` without the sorted hidden intervals.
static inline void add_segment(const hidden *dark, real from, real to, int k, receiving *seen) {
    const chunk *lit = seen->lit;
    const facing *own = seen->all->own + k;
    const real begin = lit->begin[k], end = lit->end[k], per = (real)1 / (end - begin), stop = fmin(to, end);
    real start = fmax(from, begin);
    for (int n = 0; n <= dark->count && start < stop; n++) {
        const real low = n < dark->count ? fmin(dark->low[HIDDEN_AT(n)], stop) : stop;
        const real share = low == end ? (real)1 : (low - begin) * per;
        add_piece(lit, k, own, seen->lane, (start - begin) * per, share, seen->waiting, seen->sum);
        if (n < dark->count) start = fmax(start, dark->high[HIDDEN_AT(n)]);
    }
}

// Append the visible parts of all segments of the line that the receiver faces.
static inline void add_seen(const hidden *dark, real from, real to, receiving *seen) {
    for (uint left = seen->lit->members[seen->line]; left; left &= left - 1) {
        const int k = lowest_bit(left);
        if (seen->all->lanes[k] >> seen->lane & 1) add_segment(dark, from, to, k, seen);
    }
}
#endif

#ifdef RAYS
static inline void add_part(real start, real stop, receiving *seen) {
    const int k = seen->segment;
    add_piece(seen->lit, k, seen->all->own + k, seen->lane, start, stop, seen->waiting, seen->sum);
}
#endif
#include "occluded_irradiance/visible_part.h"

// LANES receivers in structure-of-arrays form, with the places of their results: positions from the scene's middle in
// place (`wide`), positions and unit normals in real (`at`).
typedef struct {
    place wide[3][LANES];
    real at[6][LANES];
    place *sum[LANES];
    uchar *flag[LANES];
    uint count;
} packet;

// Receivers of a strip. Sets of lanes: entries without receiver; receivers with a component that is not finite.
typedef struct {
    packet lanes;
    place sums[LANES];
    uchar flags[LANES];
    uint none, bad;
} block;

// Load the positions and normals of LANES receivers, of which `present` ones are in the memory; repeat the last one.
static inline void load_receivers(global const INPUT *rows, ulong present, places *columns) {
    if (present >= LANES) {
        load_columns(rows, columns);
        return;
    }
    for (int k = 0; k < 6; k++) {
        place column[LANES];
        for (uint lane = 0; lane < LANES; lane++) column[lane] = (place)rows[6 * min((ulong)lane, present - 1) + k];
        columns[k] = load_places(column);
    }
}

// Load a block of `count` receivers. The lanes behind them hold any receivers.
static inline void load_block(global const INPUT *rows, constant place *middle, uint count, ulong present, block *here) {
    packet *to = &here->lanes;
    places columns[6];
    load_receivers(rows, present, columns);
    to->count = count;
    for (int lane = 0; lane < LANES; lane++) {
        here->sums[lane] = 0, here->flags[lane] = STATUS_OK;
        to->sum[lane] = here->sums + lane, to->flag[lane] = here->flags + lane;
    }
    for (int k = 0; k < 3; k++) store_places(columns[k] - middle[k], to->wide[k]);
    places nx = columns[3], ny = columns[4], nz = columns[5];
    const places zero = (places)0, longest = fmax(fmax(fabs(nx), fabs(ny)), fabs(nz));
    here->none = lane_bits(mask_of_places(nx == zero) & mask_of_places(ny == zero) & mask_of_places(nz == zero));
    nx /= longest, ny /= longest, nz /= longest;
    const places per = (place)1 / sqrt(nx * nx + ny * ny + nz * nz);
    for (int k = 0; k < 3; k++) store_private(convert_to_reals(load_places(to->wide[k])), to->at[k]);
    store_private(convert_to_reals(nx * per), to->at[3]);
    store_private(convert_to_reals(ny * per), to->at[4]);
    store_private(convert_to_reals(nz * per), to->at[5]);
    masks bad[2] = {0, 0};
    for (int k = 0; k < 6; k++) bad[k / 3] |= LANED(not_finite)(load_private(to->at[k]));
    here->bad = lane_bits(bad[0]) | (lane_bits(bad[1]) & ~here->none);
}

// Lanes whose receiver and a segment face each other; if any, the receivers' coordinates in the segment's frame.
static inline uint face(const packet *here, const frames *of, int n, facing *all) {
    const places dx = load_places(here->wide[0]) - of->x[n], dy = load_places(here->wide[1]) - of->y[n];
    const places dz = load_places(here->wide[2]) - of->z[n];
    const reals zero = (reals)0, height = convert_to_reals(dx * of->off_x[n] + dy * of->off_y[n] + dz * of->off_z[n]);
    const masks above = mask_of(height > zero);
    if (!any_lane(above)) return 0;
    const places along = dx * of->along_x[n] + dy * of->along_y[n] + dz * of->along_z[n];
    const reals aside = convert_to_reals(dx * of->across_x[n] + dy * of->across_y[n] + dz * of->across_z[n]);
    const real ux = (real)of->along_x[n], uy = (real)of->along_y[n], uz = (real)of->along_z[n];
    const real ex = (real)of->off_x[n], ey = (real)of->off_y[n], ez = (real)of->off_z[n];
    const real wx = (real)of->across_x[n], wy = (real)of->across_y[n], wz = (real)of->across_z[n];
    const reals nx = load_private(here->at[3]), ny = load_private(here->at[4]), nz = load_private(here->at[5]);
    const reals by_u = nx * ux + ny * uy + nz * uz, by_n = nx * ex + ny * ey + nz * ez;
    const reals by_w = nx * wx + ny * wy + nz * wz;
    const reals past = convert_to_reals(of->length[n] - along), foot = -(by_n * height + by_w * aside);
    const reals toward = foot - by_u * convert_to_reals(along), toward_end = foot + by_u * past;
    const uint found = lane_bits(above & (mask_of(toward > zero) | mask_of(toward_end > zero)));
    if (!found) return 0;
    store_private(convert_to_reals(along), all->along), store_private(height, all->height), store_private(aside, all->aside);
    store_private(past, all->past), store_private(by_u, all->by_u), store_private(by_n, all->by_n);
    store_private(by_w, all->by_w), store_private(toward, all->toward), store_private(toward_end, all->toward_end);
    return found & (uint)((1ul << here->count) - 1);
}

static inline segment_axes axes_of(const frames *of, int n) {
    return (segment_axes){(real)of->x[n],        (real)of->y[n],        (real)of->z[n],        (real)of->along_x[n],
                          (real)of->along_y[n],  (real)of->along_z[n],  (real)of->off_x[n],    (real)of->off_y[n],
                          (real)of->off_z[n],    (real)of->across_x[n], (real)of->across_y[n], (real)of->across_z[n],
                          (real)of->length[n]};
}

static inline placement placement_of(const facing *all, int lane) {
    return (placement){all->along[lane], all->height[lane], all->aside[lane],  all->past[lane],      all->by_u[lane],
                       all->by_n[lane],  all->by_w[lane],   all->toward[lane], all->toward_end[lane]};
}

static inline observer observer_of(const packet *here, int lane) {
    return (observer){here->at[0][lane], here->at[1][lane], here->at[2][lane],
                      here->at[3][lane], here->at[4][lane], here->at[5][lane]};
}

// Append the visible parts of a line, with axes `of`, that the receiver of a lane faces.
static inline void add_light(const bvh_tree *tree, const chunk *lit, int line, const segment_axes *of, const before *all,
                             int lane, real clearance, uint samples, const packet *here, pieces *waiting) {
    const uint members = lit->members[line];
#if defined(INTERVALS)
    if (!(members & lit->unseen)) {
        receiving seen = {lit, line, lane, all, waiting, here->sum[lane]};
        const placement from = placement_of(&all->whole, lane);
        const observer at = observer_of(here, lane);
        view v = view_from(of, &from, &at, clearance);
        hidden dark;
        if (!add_visible(tree, &from, &v, &dark, &seen)) *here->flag[lane] = STATUS_AMBIGUOUS;
        return;
    }
#endif
    for (uint left = members; left; left &= left - 1) {
        const int k = lowest_bit(left);
        const facing *own = all->own + k;
        if (!(all->lanes[k] >> lane & 1)) continue;
#if defined(RAYS)
        if (!(members & lit->unseen)) {
            receiving seen = {lit, line, lane, all, waiting, here->sum[lane], k};
            const segment_axes own_axes = axes_of(&lit->each, k);
            const placement from = placement_of(own, lane);
            const observer at = observer_of(here, lane);
            add_sampled(tree, &own_axes, &from, &at, clearance, samples, &seen);
            continue;
        }
#endif
        add_piece(lit, k, own, lane, 0, 1, waiting, here->sum[lane]);
    }
}

// Append the visible parts of a line for the receivers of a packet that face it: `lanes`, with their coordinates in
// `all->whole`.
static inline void light_packet(const bvh_tree *tree, const chunk *lit, int line, real clearance, uint samples,
                                const packet *here, uint lanes, before *all, pieces *waiting) {
    const uint members = lit->members[line];
    for (uint left = members; left; left &= left - 1) {
        const int k = lowest_bit(left);
        if (members == (1u << k)) all->own[k] = all->whole, all->lanes[k] = lanes;
        else all->lanes[k] = face(here, &lit->each, k, all->own + k);
    }
    const segment_axes of = axes_of(&lit->lines, line);
    for (; lanes; lanes &= lanes - 1)
        add_light(tree, lit, line, &of, all, lowest_bit(lanes), clearance, samples, here, waiting);
}

// Copy a receiver to the next lane of a packet.
static inline void pack(const packet *from, int lane, packet *to) {
    const uint n = to->count++;
    for (int k = 0; k < 3; k++) to->wide[k][n] = from->wide[k][lane];
    for (int k = 0; k < 6; k++) to->at[k][n] = from->at[k][lane];
    to->sum[n] = from->sum[lane], to->flag[n] = from->flag[lane];
}

static inline int has_no_number(place value) { return not_finite((real)value); }

// Store the result of a receiver; return its contribution to the currents per unit of weight.
static inline place result_of(const block *here, int lane, uchar flag, global real *irradiance, global uchar *status) {
    const int is_none = here->none >> lane & 1, is_bad = here->bad >> lane & 1;
    const uchar wrong = flag | (is_bad || has_no_number(here->sums[lane]) ? STATUS_NOT_FINITE : 0);
    const place light = wrong ? (place)REAL_NAN : here->sums[lane];
    *irradiance = is_none ? REAL_NAN : (real)light;
    *status = is_none ? STATUS_NO_DATA : wrong | here->flags[lane];
    return is_none ? 0 : light;
}

// Store the results of a block and add them to the currents.
static inline void store_block(const block *here, uchar flag, global real *irradiance, global uchar *status,
                 global const INPUT *weights, place *to_left, place *to_right) {
    for (uint lane = 0; lane < here->lanes.count; lane++) {
        const place light = result_of(here, lane, flag, irradiance + lane, status + lane);
        if (here->none >> lane & 1) continue;
        *to_left += light * (place)weights[2 * lane], *to_right += light * (place)weights[2 * lane + 1];
    }
}

// Add the light of a line to the receivers of a packet.
static inline void light_packed(const bvh_tree *tree, const chunk *lit, int line, real clearance, uint samples,
                                packet *packed, before *all, pieces *waiting) {
    const uint lanes = packed->count ? face(packed, &lit->lines, line, &all->whole) : 0;
    if (lanes) light_packet(tree, lit, line, clearance, samples, packed, lanes, all, waiting);
    packed->count = 0;
}

// Add the light of a chunk of segments to blocks of receivers. A block of which LEAST_UNPACKED receivers or more face a
// line, and a single block, are processed as they are.
static inline void light_chunk(const bvh_tree *tree, const chunk *lit, real clearance, uint samples, const block *blocks,
                               uint count, packet *packed, pieces *waiting, uchar *flag) {
    if (!lit->is_good) *flag |= STATUS_NOT_FINITE;
    before all;
    for (int line = 0; line < lit->line_count; line++) {
        for (uint n = 0; n < count; n++) {
            const packet *here = &blocks[n].lanes;
            uint lanes = face(here, &lit->lines, line, &all.whole);
            if (popcount(lanes) >= LEAST_UNPACKED || (lanes && count == 1)) {
                light_packet(tree, lit, line, clearance, samples, here, lanes, &all, waiting);
                continue;
            }
            for (; lanes; lanes &= lanes - 1) {
                pack(here, lowest_bit(lanes), packed);
                if (packed->count == LANES)
                    light_packed(tree, lit, line, clearance, samples, packed, &all, waiting);
            }
        }
        light_packed(tree, lit, line, clearance, samples, packed, &all, waiting);
    }
}

#endif
