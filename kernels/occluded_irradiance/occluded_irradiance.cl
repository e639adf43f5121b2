// Irradiance of the receivers of a sensor strip from all lit segments, with occlusion, and the strip's two currents.
//
// E = sum over segments of the closed form of line_irradiance.h, over the part of each segment that is visible from the
// receiver. The currents are sums of E times two weights per receiver.
//
// Inputs:  receivers (strips, each, 6) position [m] and normal; weights (strips, each, 2); segments (n, 10) start, end,
//          surface normal, exitance [W/m2]; with SELECTED also starts (lists + 1) and selected, the segments of each list
//          (list: SELECTION_BLOCK receivers; a pick ~k is segment k, which no surface can hide).
// Outputs: irradiance (strips, each) [W/m2]; left, right (strips,); status (strips, each) flags.
// Options: INPUT (type of the inputs), REAL_IS_DOUBLE, DOUBLE_POSITIONS, SELECTED, GROUP (size of a work-group), BVH_DEPTH;
//          INTERVALS (exact visibility, visible.h), RAYS (shadow rays to `samples` parts of a segment); without both:
//          no occlusion.
// Variants: vector: a work-item per share of the strips, 16 receivers in a vector; work-item: a work-group per strip,
//          an item per receiver.
//
// Order of work: (1) facing tests of 16 receivers with a line reject most pairs; (2) the visible parts of the remaining
// pairs are found pair by pair; (3) the visible parts of any receivers and segments are collected until 16 of them fill
// the vectors of the closed form.
// In single precision the work-item variant keeps hidden intervals in local memory: 256 bytes for each item. In double
// precision a group would need more than 32 KiB, and they stay in private memory.
#if defined(INTERVALS) && !defined(VECTOR_VARIANT) && !defined(REAL_IS_DOUBLE)
#define HIDDEN_GROUP GROUP
#endif
#include "line_irradiance/line_irradiance.h"
#include "occluded_irradiance/lit_lines.h"
#include "common/status.h"
#include "occluded_irradiance/visible.h"

// Number of receivers that share a list of picked segments.
#define SELECTION_BLOCK 16
// The clearance takes at most this fraction of the height of either end above the other's surface.
#define CLEARANCE_SHARE ((real)0.5)

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

// Visible parts of segments that wait for the closed form, each with the lane of its receiver.
typedef struct {
    real along[LANES], height[LANES], aside[LANES], past[LANES], length[LANES], by_u[LANES], by_n[LANES], by_w[LANES];
    real exitance[LANES];
    int lane[LANES];
    int count;
#ifdef HIDDEN_GROUP
    local real *room; // of this item, for hidden intervals
#endif
} pieces;

// Evaluate the closed form of the waiting parts; unused lanes have height 0, which gives 0.
static __attribute__((noinline)) void finish(pieces *waiting, place *sums) {
    for (int n = waiting->count; n < LANES; n++) waiting->height[n] = 0;
    const reals factor = LANED(line_factor)(load_private(waiting->along), load_private(waiting->height),
                                            load_private(waiting->aside), load_private(waiting->past),
                                            load_private(waiting->length), load_private(waiting->by_u),
                                            load_private(waiting->by_n), load_private(waiting->by_w));
    real light[LANES];
    store_private(load_private(waiting->exitance) * factor, light);
    for (int n = 0; n < waiting->count; n++) sums[waiting->lane[n]] += light[n];
    waiting->count = 0;
}

// Append the part of segment k from fraction `start` to `stop`, which is visible from the receiver of a lane.
static __attribute__((noinline)) void add_piece(const chunk *lit, int k, const facing *all, int lane, real start, real stop,
                                         pieces *waiting, place *sums) {
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
    waiting->lane[n] = lane;
    if (waiting->count == LANES) finish(waiting, sums);
}

#ifdef INTERVALS
// View of a line from a receiver at (x, y, z) with normal (nx, ny, nz).
static view view_from(const frames *of, int n, const facing *all, int lane, real x, real y, real z, real nx, real ny, real nz,
               real clearance) {
    view v;
    const real height = all->height[lane], aside = all->aside[lane], along = all->along[lane];
    const real toward = all->toward[lane], most = fmax(toward, all->toward_end[lane]);
    const real depth = sqrt(height * height + aside * aside), per = (real)1 / depth;
    const real up = -height * per, side = -aside * per, per_length = (real)1 / (real)of->length[n];
    const real ux = (real)of->along_x[n], uy = (real)of->along_y[n], uz = (real)of->along_z[n];
    const real ex = (real)of->off_x[n], ey = (real)of->off_y[n], ez = (real)of->off_z[n];
    const real wx = (real)of->across_x[n], wy = (real)of->across_y[n], wz = (real)of->across_z[n];
    v.x = x, v.y = y, v.z = z;
    v.start_x = (real)of->x[n], v.start_y = (real)of->y[n], v.start_z = (real)of->z[n];
    v.step_x = (real)of->length[n] * ux, v.step_y = (real)of->length[n] * uy, v.step_z = (real)of->length[n] * uz;
    v.deep_x = up * ex + side * wx, v.deep_y = up * ey + side * wy, v.deep_z = up * ez + side * wz;
    v.across_x = up * wx - side * ex, v.across_y = up * wy - side * ey, v.across_z = up * wz - side * ez;
    v.along_x = (depth * ux + along * v.deep_x) * per_length;
    v.along_y = (depth * uy + along * v.deep_y) * per_length;
    v.along_z = (depth * uz + along * v.deep_z) * per_length;
    const real over = fmin(clearance, CLEARANCE_SHARE * height);
    v.far = depth - depth * (over / height);
    v.lift = fmin(clearance, CLEARANCE_SHARE * most);
    v.lift_deep = toward * per, v.lift_along = (all->toward_end[lane] - toward) * per;
    v.near = fmax(depth * (v.lift / most), depth * (real)1e-12);
    view_set_plane(&v);
    // Occluders lie above the lit surface and above the receiver's surface.
    v.halves[4] = view_half_of(&v, ex, ey, ez, over - height);
    v.halves[5] = view_half_of(&v, nx, ny, nz, v.lift);
    return v;
}

// Append the visible parts of segment k: the part of the line from `from` to `to` without the sorted hidden intervals.
static void add_seen(const hidden *dark, real from, real to, const chunk *lit, int k, const facing *own, int lane,
              pieces *waiting, place *sums) {
    const real begin = lit->begin[k], end = lit->end[k], per = (real)1 / (end - begin), stop = fmin(to, end);
    real start = fmax(from, begin);
    for (int n = 0; n <= dark->count && start < stop; n++) {
        const real low = n < dark->count ? fmin(dark->low[HIDDEN_AT(n)], stop) : stop;
        const real share = low == end ? (real)1 : (low - begin) * per;
        add_piece(lit, k, own, lane, (start - begin) * per, share, waiting, sums);
        if (n < dark->count) start = fmax(start, dark->high[HIDDEN_AT(n)]);
    }
}

// Append the visible parts of a line's segments for the receiver of a lane. Returns 0 if the hidden intervals exceed the
// capacity even in the smallest window: the result is then incomplete (AMBIGUOUS).
static int add_visible(const bvh_tree *tree, const chunk *lit, int line, const before *all, int lane, view *v, int *hint,
                pieces *waiting, place *sums) {
    // Part above the receiver's plane, widened by rounding; the closed form cuts it exactly.
    const real toward = all->whole.toward[lane], toward_end = all->whole.toward_end[lane];
    const real slack = (real)8 * (real)REAL_EPSILON, horizon = toward / (toward - toward_end);
    const real begin = toward < 0 ? fmax(horizon - slack, (real)0) : 0;
    const real end = toward_end < 0 ? fmin(horizon + slack, (real)1) : 1;
    int is_whole = 1;
    real from = begin, to = end;
    hidden dark;
#ifdef HIDDEN_GROUP
    dark.low = waiting->room, dark.high = waiting->room + HIDDEN_AT(MAX_HIDDEN);
#endif
    while (from < end) {
        hidden_begin(&dark, from, to);
        view_trace(tree, v, &dark, hint);
        if (dark.is_full && to - from > SMALLEST_WINDOW) {
            to = (real)0.5 * (from + to);
            continue;
        }
        is_whole &= !dark.is_full;
        hidden_sort(&dark);
        // Extend an end that lies at the horizon to the end of the line: the closed form cuts there exactly.
        const real first = dark.from == begin ? 0 : dark.from, last = dark.to == end ? 1 : dark.to;
        for (uint left = dark.from < dark.to ? lit->members[line] : 0; left; left &= left - 1) {
            const int k = lowest_bit(left);
            if (all->lanes[k] >> lane & 1) add_seen(&dark, first, last, lit, k, all->own + k, lane, waiting, sums);
        }
        from = to, to = end;
    }
    return is_whole;
}
#endif

// LANES receivers of a strip in structure-of-arrays form: positions from the scene's middle and normals, in place
// (`wide`; normals scaled to about 1) and in real (`at`; unit normals).
typedef struct {
    place wide[6][LANES];
    real at[6][LANES];
    place sums[LANES];
    uchar flags[LANES], is_none[LANES];
    uint count;
} block;

// Load a block; repeat the last receiver to fill the lanes.
static void load_block(global const INPUT *receivers, constant place *middle, uint count, block *here) {
    here->count = count;
    for (int lane = 0; lane < LANES; lane++) {
        global const INPUT *row = receivers + 6 * min((uint)lane, count - 1);
        for (int k = 0; k < 3; k++) here->wide[k][lane] = (place)row[k] - middle[k];
        for (int k = 3; k < 6; k++) here->wide[k][lane] = (place)row[k];
        here->is_none[lane] = row[3] == 0 && row[4] == 0 && row[5] == 0;
        here->sums[lane] = 0, here->flags[lane] = STATUS_OK;
    }
    places nx = load_places(here->wide[3]), ny = load_places(here->wide[4]), nz = load_places(here->wide[5]);
    const places longest = fmax(fmax(fabs(nx), fabs(ny)), fabs(nz));
    nx /= longest, ny /= longest, nz /= longest;
    const places per = (place)1 / sqrt(nx * nx + ny * ny + nz * nz);
    *(places_at *)here->wide[3] = nx, *(places_at *)here->wide[4] = ny, *(places_at *)here->wide[5] = nz;
    for (int k = 0; k < 3; k++) store_private(convert_to_reals(load_places(here->wide[k])), here->at[k]);
    store_private(convert_to_reals(nx * per), here->at[3]);
    store_private(convert_to_reals(ny * per), here->at[4]);
    store_private(convert_to_reals(nz * per), here->at[5]);
}

// Lanes whose receiver and a segment face each other; if any, the receivers' coordinates in the segment's frame.
static uint face(const block *here, const frames *of, int n, facing *all) {
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

#ifdef RAYS
// Visible parts of segment k by shadow rays: one ray from the receiver to the middle of each of `samples` parts.
static void add_sampled(const bvh_tree *tree, const chunk *lit, int k, const facing *own, int lane, real clearance,
                 uint samples, block *here, pieces *waiting) {
    const frames *of = &lit->each;
    const real over = fmin(clearance, CLEARANCE_SHARE * own->height[lane]);
    const real lift = fmin(clearance, CLEARANCE_SHARE * fmax(own->toward[lane], own->toward_end[lane]));
    const real origin[3] = {here->at[0][lane] + lift * here->at[3][lane], here->at[1][lane] + lift * here->at[4][lane],
                            here->at[2][lane] + lift * here->at[5][lane]};
    const real start[3] = {(real)of->x[k] + over * (real)of->off_x[k], (real)of->y[k] + over * (real)of->off_y[k],
                           (real)of->z[k] + over * (real)of->off_z[k]};
    const real per = (real)1 / (real)samples, length = (real)of->length[k];
    const real ux = (real)of->along_x[k] * length, uy = (real)of->along_y[k] * length;
    const real uz = (real)of->along_z[k] * length;
    uint begun = 0, seen = 0;
    bvh_occluder last = NO_OCCLUDER;
    for (uint n = 0; n <= samples; n++) {
        int hit = 1;
        if (n < samples) {
            const real t = ((real)n + (real)0.5) * per;
            const real dx = start[0] + t * ux - origin[0], dy = start[1] + t * uy - origin[1];
            const real dz = start[2] + t * uz - origin[2];
            const bvh_ray ray = bvh_ray_of(origin[0], origin[1], origin[2], dx, dy, dz, 0, 1);
            hit = bvh_any(tree, &ray, &last);
        }
        if (!hit) {
            begun = seen ? begun : n;
            seen = 1;
        } else if (seen) {
            const real stop = n == samples ? (real)1 : (real)n * per;
            add_piece(lit, k, own, lane, (real)begun * per, stop, waiting, here->sums);
            seen = 0;
        }
    }
}
#endif

// Append the visible parts of a line that the receiver of a lane faces.
static void add_light(const bvh_tree *tree, const chunk *lit, int line, const before *all, int lane, real clearance,
               uint samples, int *hint, block *here, pieces *waiting) {
    const uint members = lit->members[line];
#if defined(INTERVALS)
    if (!(members & lit->unseen)) {
        view v = view_from(&lit->lines, line, &all->whole, lane, here->at[0][lane], here->at[1][lane],
                           here->at[2][lane], here->at[3][lane], here->at[4][lane], here->at[5][lane], clearance);
        if (!add_visible(tree, lit, line, all, lane, &v, hint, waiting, here->sums))
            here->flags[lane] = STATUS_AMBIGUOUS;
        return;
    }
#endif
    for (uint left = members; left; left &= left - 1) {
        const int k = lowest_bit(left);
        const facing *own = all->own + k;
        if (!(all->lanes[k] >> lane & 1)) continue;
#if defined(RAYS)
        if (!(members & lit->unseen)) {
            add_sampled(tree, lit, k, own, lane, clearance, samples, here, waiting);
            continue;
        }
#endif
        add_piece(lit, k, own, lane, 0, 1, waiting, here->sums);
    }
}

// Append the visible parts of a line for all receivers of a block.
static void light_block(const bvh_tree *tree, const chunk *lit, int line, real clearance, uint samples, int *hint, block *here,
                 pieces *waiting) {
    before all;
    uint lanes = face(here, &lit->lines, line, &all.whole);
    if (!lanes) return;
    const uint members = lit->members[line];
    for (uint left = members; left; left &= left - 1) {
        const int k = lowest_bit(left);
        if (members == (1u << k)) all.own[k] = all.whole, all.lanes[k] = lanes;
        else all.lanes[k] = face(here, &lit->each, k, all.own + k);
    }
    for (; lanes; lanes &= lanes - 1)
        add_light(tree, lit, line, &all, lowest_bit(lanes), clearance, samples, hint, here, waiting);
}

static inline int has_no_number(place value) { return not_finite((real)value); }

// Store the result of a receiver; return its contribution to the currents per unit of weight.
static place result_of(const block *here, int lane, uchar flag, global real *irradiance, global uchar *status) {
    int is_bad = 0;
    for (int k = 0; k < 6; k++) is_bad |= not_finite(here->at[k][lane]) && !(k >= 3 && here->is_none[lane]);
    const uchar wrong = flag | (is_bad || has_no_number(here->sums[lane]) ? STATUS_NOT_FINITE : 0);
    const int is_none = here->is_none[lane];
    const place light = wrong ? (place)REAL_NAN : here->sums[lane];
    *irradiance = is_none ? REAL_NAN : (real)light;
    *status = is_none ? STATUS_NO_DATA : wrong | here->flags[lane];
    return is_none ? 0 : light;
}

// Store the results of a block and add them to the currents.
static void store_block(const block *here, uchar flag, global real *irradiance, global uchar *status,
                 global const INPUT *weights, place *to_left, place *to_right) {
    for (uint lane = 0; lane < here->count; lane++) {
        const place light = result_of(here, lane, flag, irradiance + lane, status + lane);
        if (here->is_none[lane]) continue;
        *to_left += light * (place)weights[2 * lane], *to_right += light * (place)weights[2 * lane + 1];
    }
}

#ifdef SELECTED
#define SEGMENT_LISTS global const int *restrict starts, global const int *restrict selected,
#else
#define SEGMENT_LISTS
#endif

// Add the light of a chunk of segments to a block of receivers.
static void light_chunk(const bvh_tree *tree, const chunk *lit, real clearance, uint samples, int *hint, block *here,
                        pieces *waiting, uchar *flag) {
    if (!lit->is_good) *flag |= STATUS_NOT_FINITE;
    for (int line = 0; line < lit->line_count; line++)
        light_block(tree, lit, line, clearance, samples, hint, here, waiting);
}

#ifndef VECTOR_VARIANT
// Sum two values over the work-group, by halves; all items return the sums.
static void sum_over_group(local place *both, place *to_left, place *to_right) {
    const uint item = get_local_id(0);
    both[2 * item] = *to_left, both[2 * item + 1] = *to_right;
    for (uint half_size = GROUP / 2; half_size; half_size /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < half_size) {
            both[2 * item] += both[2 * (item + half_size)];
            both[2 * item + 1] += both[2 * (item + half_size) + 1];
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    *to_left = both[0], *to_right = both[1];
    barrier(CLK_LOCAL_MEM_FENCE);
}
#endif

AS_IT_IS kernel void occluded_irradiance(global const INPUT *restrict receivers, global const INPUT *restrict weights,
                                         global const INPUT *restrict segments, SEGMENT_LISTS
                                         global real *restrict irradiance, global real *restrict left,
                                         global real *restrict right, global uchar *restrict status,
                                         global const real *nodes, global const int *children, global const int *axes,
                                         global const real *leaves, global const int *triangles,
                                         constant place *middle, const real clearance, const uint samples,
                                         const uint each, const uint segment_count, const uint pick_count,
                                         const uint strips) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong group = get_group_id(0), groups = get_num_groups(0);
#ifndef VECTOR_VARIANT
    local place both[2 * GROUP];
#endif
#ifdef HIDDEN_GROUP
    local real room[2 * HIDDEN_AT(MAX_HIDDEN)];
#endif
    chunk lit;
    int hint = NO_HINT, loaded = -1; // first segment of the chunk that is loaded
    for (ulong strip = strips * group / groups; strip < strips * (group + 1) / groups; strip++) {
        place to_left = 0, to_right = 0;
        for (uint first = get_local_id(0) * LANES; first < each; first += get_local_size(0) * LANES) {
            const ulong row = strip * each + first;
            block here;
            load_block(receivers + 6 * row, middle, min((uint)LANES, each - first), &here);
            uchar flag = STATUS_OK;
            pieces waiting;
            waiting.count = 0;
#ifdef HIDDEN_GROUP
            waiting.room = room + get_local_id(0);
#endif
#ifdef SELECTED
            const ulong list = strip * ((each + SELECTION_BLOCK - 1) / SELECTION_BLOCK) + first / SELECTION_BLOCK;
            if (starts[list] < 0 || starts[list + 1] > (int)pick_count) flag |= STATUS_OUT_OF_RANGE;
            const int end = min(starts[list + 1], (int)pick_count);
            for (int next = max(starts[list], 0); next < end;) {
                next = load_selected(segments, selected, next, end, segment_count, middle, &lit, &flag);
                light_chunk(&tree, &lit, clearance, samples, &hint, &here, &waiting, &flag);
            }
#else
            for (int next = 0; next < (int)segment_count; next += SEGMENTS) {
                if (loaded != next) load_from(segments, next, (int)segment_count, middle, &lit);
                loaded = next;
                light_chunk(&tree, &lit, clearance, samples, &hint, &here, &waiting, &flag);
            }
#endif
            finish(&waiting, here.sums);
            store_block(&here, flag, irradiance + row, status + row, weights + 2 * row, &to_left, &to_right);
        }
#ifndef VECTOR_VARIANT
        sum_over_group(both, &to_left, &to_right);
        if (get_local_id(0)) continue;
#endif
        left[strip] = (real)to_left, right[strip] = (real)to_right;
    }
}
