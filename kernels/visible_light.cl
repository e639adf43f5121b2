// Irradiance of a sensor strip's receivers from all lit segments, as far as each sees them, and what it adds to the
// strip's two currents. A CPU's work-item has a strip and takes its receivers 16 at a time, a GPU's work-group has one
// and takes an item per receiver.
//
// Facing comes first: of the few pairs left, what is seen is found one after another (visible.h, or shadow rays to
// parts of the segment), and the pieces wait until 16 of them, of any receiver and segment, are worth the closed form.
#include "line_irradiance.h"
#include "places.h"
#include "status.h"
#include "visible.h"

// Receivers that share a list of picked segments.
#define PICK_BLOCK 16
// Of how high either stands above the other's surface: a clearance takes no more of it.
#define LEAST_SHARE ((real)0.5)

#ifdef STRIP
#define LOAD_PLACES(from) (*(const places_at *)(from))
#define narrow convert_real16
#define STORE_LANES(value, to) (*(reals_at *)(to) = (value))
#define LOAD_LANES(from) (*(const reals_at *)(from))
#else
#define LOAD_PLACES(from) (*(from))
#define narrow convert_real
#define STORE_LANES(value, to) (*(to) = (value))
#define LOAD_LANES(from) (*(from))
#endif

// A lit segment: its start and its frame, `off` being the normal of its surface.
typedef struct {
    place x, y, z, along_x, along_y, along_z, off_x, off_y, off_z, across_x, across_y, across_z;
    place length;
    real exitance; // over 2 pi
    int is_lit, is_good;
} lit;

// Receivers, in the frame of the segment: as line_irradiance.h takes them.
typedef struct {
    real along[LANES], height[LANES], aside[LANES], past[LANES], by_u[LANES], by_n[LANES], by_w[LANES];
    real toward[LANES], toward_end[LANES]; // how far above the receiver's plane the segment's ends are
} facing;

// What waits for the closed form: visible parts of segments, each with its lane's receiver.
typedef struct {
    real along[LANES], height[LANES], aside[LANES], past[LANES], length[LANES], by_u[LANES], by_n[LANES], by_w[LANES];
    real exitance[LANES];
    int lane[LANES];
    int count;
} pieces;

inline int has_no_number(place value) { return not_finite((real)value); }

// A segment's start, and not yet of unit length: along it, and off it its normal.
lit lit_of(global const INPUT *row, constant place *middle) {
    lit one;
    one.x = (place)row[0] - middle[0], one.y = (place)row[1] - middle[1], one.z = (place)row[2] - middle[2];
    one.along_x = (place)row[3] - (place)row[0], one.along_y = (place)row[4] - (place)row[1];
    one.along_z = (place)row[5] - (place)row[2];
    const place nx = row[6], ny = row[7], nz = row[8];
    const place square = one.along_x * one.along_x + one.along_y * one.along_y + one.along_z * one.along_z;
    const place lean = one.along_x * nx + one.along_y * ny + one.along_z * nz;
    one.off_x = square * nx - lean * one.along_x, one.off_y = square * ny - lean * one.along_y;
    one.off_z = square * nz - lean * one.along_z;
    one.exitance = (real)(row[9] * (INPUT)0.15915494309189533577);
    const place size = fabs(one.off_x) + fabs(one.off_y) + fabs(one.off_z);
    const int emits = one.exitance > 0 && square > 0;
    one.is_good = !(has_no_number(one.x + one.y + one.z) | has_no_number(square + size) | not_finite(one.exitance)) &&
                  !(emits && size == 0);
    one.is_lit = one.is_good && emits;
    return one;
}

// Completes a segment that a receiver faces.
void finish_lit(lit *one) {
    one->length = sqrt(one->along_x * one->along_x + one->along_y * one->along_y + one->along_z * one->along_z);
    const place per = (place)1 / one->length;
    one->along_x *= per, one->along_y *= per, one->along_z *= per;
    const place size = sqrt(one->off_x * one->off_x + one->off_y * one->off_y + one->off_z * one->off_z);
    const place per_size = (place)1 / size;
    one->off_x *= per_size, one->off_y *= per_size, one->off_z *= per_size;
    one->across_x = one->along_y * one->off_z - one->along_z * one->off_y;
    one->across_y = one->along_z * one->off_x - one->along_x * one->off_z;
    one->across_z = one->along_x * one->off_y - one->along_y * one->off_x;
}

// The closed form for what waits.
__attribute__((noinline)) void finish(pieces *waiting, place *sums) {
    for (int n = waiting->count; n < LANES; n++) waiting->height[n] = 0;
    const reals factor = LANED(line_factor)(LOAD_LANES(waiting->along), LOAD_LANES(waiting->height),
                                            LOAD_LANES(waiting->aside), LOAD_LANES(waiting->past),
                                            LOAD_LANES(waiting->length), LOAD_LANES(waiting->by_u),
                                            LOAD_LANES(waiting->by_n), LOAD_LANES(waiting->by_w));
    real light[LANES];
    STORE_LANES(LOAD_LANES(waiting->exitance) * factor, light);
    for (int n = 0; n < waiting->count; n++) sums[waiting->lane[n]] += light[n];
    waiting->count = 0;
}

// A lane's receiver sees the segment from `start` to `stop` of its length.
__attribute__((noinline)) void add_piece(const lit *one, const facing *all, int lane, real start, real stop,
                                         pieces *waiting, place *sums) {
    if (!(start < stop)) return;
    const int n = waiting->count++;
    const real length = (real)one->length;
    waiting->along[n] = all->along[lane] - start * length;
    waiting->height[n] = all->height[lane];
    waiting->aside[n] = all->aside[lane];
    waiting->past[n] = all->past[lane] - ((real)1 - stop) * length;
    waiting->length[n] = (stop - start) * length;
    waiting->by_u[n] = all->by_u[lane], waiting->by_n[n] = all->by_n[lane], waiting->by_w[n] = all->by_w[lane];
    waiting->exitance[n] = one->exitance;
    waiting->lane[n] = lane;
    if (waiting->count == LANES) finish(waiting, sums);
}

#ifdef INTERVALS
// (x, y, z) is the receiver and (nx, ny, nz) its normal.
view view_from(const lit *one, const facing *all, int lane, real x, real y, real z, real nx, real ny, real nz,
               real clearance) {
    view v;
    const real height = all->height[lane], aside = all->aside[lane], along = all->along[lane];
    const real toward = all->toward[lane], most = fmax(toward, all->toward_end[lane]);
    const real depth = sqrt(height * height + aside * aside), per = (real)1 / depth;
    const real up = -height * per, side = -aside * per, per_length = (real)1 / (real)one->length;
    const real ux = (real)one->along_x, uy = (real)one->along_y, uz = (real)one->along_z;
    const real ex = (real)one->off_x, ey = (real)one->off_y, ez = (real)one->off_z;
    const real wx = (real)one->across_x, wy = (real)one->across_y, wz = (real)one->across_z;
    v.x = x, v.y = y, v.z = z;
    v.start_x = (real)one->x, v.start_y = (real)one->y, v.start_z = (real)one->z;
    v.step_x = (real)one->length * ux, v.step_y = (real)one->length * uy, v.step_z = (real)one->length * uz;
    v.deep_x = up * ex + side * wx, v.deep_y = up * ey + side * wy, v.deep_z = up * ez + side * wz;
    v.across_x = up * wx - side * ex, v.across_y = up * wy - side * ey, v.across_z = up * wz - side * ez;
    v.along_x = (depth * ux + along * v.deep_x) * per_length;
    v.along_y = (depth * uy + along * v.deep_y) * per_length;
    v.along_z = (depth * uz + along * v.deep_z) * per_length;
    const real over = fmin(clearance, LEAST_SHARE * height);
    v.far = depth - depth * (over / height);
    v.lift = fmin(clearance, LEAST_SHARE * most);
    v.lift_deep = toward * per, v.lift_along = (all->toward_end[lane] - toward) * per;
    v.near = fmax(depth * (v.lift / most), depth * (real)1e-12);
    view_set_plane(&v);
    // Above the lit surface, and above the receiver's own.
    v.halves[4] = view_half_of(&v, ex, ey, ez, over - height);
    v.halves[5] = view_half_of(&v, nx, ny, nz, v.lift);
    return v;
}

// Returns whether all is found: it is, unless there is more to keep than fits even in a small part of the segment.
int add_visible(const bvh_tree *tree, const lit *one, const facing *all, int lane, view *v, int *hint,
                pieces *waiting, place *sums) {
    // What is above the receiver's plane; the closed form cuts it exactly.
    const real toward = all->toward[lane], toward_end = all->toward_end[lane], slack = (real)8 * (real)REAL_EPSILON;
    const real horizon = toward / (toward - toward_end);
    const real begin = toward < 0 ? fmax(horizon - slack, (real)0) : 0;
    const real end = toward_end < 0 ? fmin(horizon + slack, (real)1) : 1;
    int is_whole = 1;
    real from = begin, to = end;
    while (from < end) {
        hidden dark = hidden_none(from, to);
        view_trace(tree, v, &dark, hint);
        if (dark.is_full && to - from > LEAST_WINDOW) {
            to = (real)0.5 * (from + to);
            continue;
        }
        is_whole &= !dark.is_full;
        hidden_sort(&dark);
        // To a horizon and a little beyond, so that the end itself need not be rounded.
        real start = dark.from == begin ? 0 : dark.from;
        for (int n = 0; n < dark.count; n++) {
            add_piece(one, all, lane, start, dark.low[n], waiting, sums);
            start = dark.high[n];
        }
        if (dark.from < dark.to) add_piece(one, all, lane, start, dark.to == end ? 1 : dark.to, waiting, sums);
        from = to, to = end;
    }
    return is_whole;
}
#endif

#ifdef RAYS
// A ray to the middle of each of `samples` parts of the segment; origin (x, y, z) and `ends` are lifted already.
void add_sampled(const bvh_tree *tree, const lit *one, const facing *all, int lane, const real *origin,
                 const real *start, uint samples, pieces *waiting, place *sums) {
    const real per = (real)1 / (real)samples, length = (real)one->length;
    const real ux = (real)one->along_x * length, uy = (real)one->along_y * length, uz = (real)one->along_z * length;
    uint begun = 0, seen = 0;
    for (uint n = 0; n <= samples; n++) {
        int hit = 1;
        if (n < samples) {
            const real t = ((real)n + (real)0.5) * per;
            const real dx = start[0] + t * ux - origin[0], dy = start[1] + t * uy - origin[1];
            const real dz = start[2] + t * uz - origin[2];
            const bvh_ray ray = bvh_ray_of(origin[0], origin[1], origin[2], dx, dy, dz, 0, 1);
            hit = bvh_any(tree, &ray);
        }
        if (!hit) {
            begun = seen ? begun : n;
            seen = 1;
        } else if (seen) {
            add_piece(one, all, lane, (real)begun * per, n == samples ? (real)1 : (real)n * per, waiting, sums);
            seen = 0;
        }
    }
}
#endif

// Receivers of a strip that are taken together, by columns: places from the scene's middle and normals of about unit
// length, and both in real, the normals of unit length.
typedef struct {
    place wide[6][LANES];
    real at[6][LANES];
    place sums[LANES];
    uchar flags[LANES], is_none[LANES];
    uint count;
} block;

// The last receiver again where there are fewer than lanes.
void load_block(global const INPUT *receivers, constant place *middle, uint count, block *here) {
    here->count = count;
    for (int lane = 0; lane < LANES; lane++) {
        global const INPUT *row = receivers + 6 * min((uint)lane, count - 1);
        for (int k = 0; k < 3; k++) here->wide[k][lane] = (place)row[k] - middle[k];
        for (int k = 3; k < 6; k++) here->wide[k][lane] = (place)row[k];
        here->is_none[lane] = row[3] == 0 && row[4] == 0 && row[5] == 0;
        here->sums[lane] = 0, here->flags[lane] = STATUS_OK;
    }
    places nx = LOAD_PLACES(here->wide[3]), ny = LOAD_PLACES(here->wide[4]), nz = LOAD_PLACES(here->wide[5]);
    const places longest = fmax(fmax(fabs(nx), fabs(ny)), fabs(nz));
    nx /= longest, ny /= longest, nz /= longest;
    const places per = (place)1 / sqrt(nx * nx + ny * ny + nz * nz);
    *(places_at *)here->wide[3] = nx, *(places_at *)here->wide[4] = ny, *(places_at *)here->wide[5] = nz;
    for (int k = 0; k < 3; k++) STORE_LANES(narrow(LOAD_PLACES(here->wide[k])), here->at[k]);
    STORE_LANES(narrow(nx * per), here->at[3]);
    STORE_LANES(narrow(ny * per), here->at[4]);
    STORE_LANES(narrow(nz * per), here->at[5]);
}

// Which receivers and the segment face each other; completes the segment if any may.
masks face(const block *here, lit *one, facing *all) {
    const places dx = LOAD_PLACES(here->wide[0]) - one->x, dy = LOAD_PLACES(here->wide[1]) - one->y;
    const places dz = LOAD_PLACES(here->wide[2]) - one->z;
    const places wide_x = LOAD_PLACES(here->wide[3]), wide_y = LOAD_PLACES(here->wide[4]);
    const places wide_z = LOAD_PLACES(here->wide[5]);
    // Before the segment's frame: whether any receiver is above its surface, and it above the receiver's.
    const places above = dx * one->off_x + dy * one->off_y + dz * one->off_z;
    const places start = -(dx * wide_x + dy * wide_y + dz * wide_z);
    const places end = start + one->along_x * wide_x + one->along_y * wide_y + one->along_z * wide_z;
    const reals zero = (reals)0;
    const masks may = mask_of(narrow(above) > zero) & (mask_of(narrow(start) > zero) | mask_of(narrow(end) > zero));
    if (!any_lane(may)) return may;
    finish_lit(one);
    const reals nx = LOAD_LANES(here->at[3]), ny = LOAD_LANES(here->at[4]), nz = LOAD_LANES(here->at[5]);
    const reals height = narrow(dx * one->off_x + dy * one->off_y + dz * one->off_z);
    const places along = dx * one->along_x + dy * one->along_y + dz * one->along_z;
    const reals aside = narrow(dx * one->across_x + dy * one->across_y + dz * one->across_z);
    const reals by_u = nx * (real)one->along_x + ny * (real)one->along_y + nz * (real)one->along_z;
    const reals by_n = nx * (real)one->off_x + ny * (real)one->off_y + nz * (real)one->off_z;
    const reals by_w = nx * (real)one->across_x + ny * (real)one->across_y + nz * (real)one->across_z;
    const reals past = narrow(one->length - along), foot = -(by_n * height + by_w * aside);
    const reals toward = foot - by_u * narrow(along), toward_end = foot + by_u * past;
    STORE_LANES(narrow(along), all->along), STORE_LANES(height, all->height), STORE_LANES(aside, all->aside);
    STORE_LANES(past, all->past), STORE_LANES(by_u, all->by_u), STORE_LANES(by_n, all->by_n);
    STORE_LANES(by_w, all->by_w), STORE_LANES(toward, all->toward), STORE_LANES(toward_end, all->toward_end);
    return mask_of(height > zero) & (mask_of(toward > zero) | mask_of(toward_end > zero));
}

// What a lane's receiver gets from a segment that it faces.
void add_light(const bvh_tree *tree, const lit *one, const facing *all, int lane, real clearance, uint samples,
               int *hint, block *here, pieces *waiting) {
#if defined(INTERVALS)
    view v = view_from(one, all, lane, here->at[0][lane], here->at[1][lane], here->at[2][lane], here->at[3][lane],
                       here->at[4][lane], here->at[5][lane], clearance);
    if (!add_visible(tree, one, all, lane, &v, hint, waiting, here->sums)) here->flags[lane] = STATUS_AMBIGUOUS;
#elif defined(RAYS)
    const real over = fmin(clearance, LEAST_SHARE * all->height[lane]);
    const real lift = fmin(clearance, LEAST_SHARE * fmax(all->toward[lane], all->toward_end[lane]));
    const real origin[3] = {here->at[0][lane] + lift * here->at[3][lane], here->at[1][lane] + lift * here->at[4][lane],
                            here->at[2][lane] + lift * here->at[5][lane]};
    const real start[3] = {(real)one->x + over * (real)one->off_x, (real)one->y + over * (real)one->off_y,
                           (real)one->z + over * (real)one->off_z};
    add_sampled(tree, one, all, lane, origin, start, samples, waiting, here->sums);
#else
    add_piece(one, all, lane, 0, 1, waiting, here->sums);
#endif
}

// A receiver's result; returns what is to be added to the currents for a unit of weight.
place result_of(const block *here, int lane, uchar flag, global real *irradiance, global uchar *status) {
    int is_bad = 0;
    for (int k = 0; k < 6; k++) is_bad |= not_finite(here->at[k][lane]) && !(k >= 3 && here->is_none[lane]);
    const uchar wrong = flag | (is_bad || has_no_number(here->sums[lane]) ? STATUS_NOT_FINITE : 0);
    const int is_none = here->is_none[lane];
    const place light = wrong ? (place)REAL_NAN : here->sums[lane];
    *irradiance = is_none ? REAL_NAN : (real)light;
    *status = is_none ? STATUS_HOLE : wrong | here->flags[lane];
    return is_none ? 0 : light;
}

AS_IT_IS kernel void visible_light(global const INPUT *restrict receivers, global const INPUT *restrict weights,
                                   global const INPUT *restrict segments,
#ifdef PICKED
                                   global const int *restrict starts, global const int *restrict picks,
#endif
                                   global real *restrict irradiance, global real *restrict left,
                                   global real *restrict right, global uchar *restrict status,
                                   global const real *nodes, global const int *children, global const int *axes,
                                   global const real *leaves, global const int *triangles, constant place *middle,
                                   const real clearance, const uint samples, const uint each,
                                   const uint segment_count, const uint pick_count) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong strip = get_group_id(0);
    int hint = NO_HINT;
    place to_left = 0, to_right = 0;
    for (uint first = get_local_id(0) * LANES; first < each; first += get_local_size(0) * LANES) {
        const ulong row = strip * each + first;
        block here;
        load_block(receivers + 6 * row, middle, min((uint)LANES, each - first), &here);
        uchar flag = STATUS_OK;
        pieces waiting;
        waiting.count = 0;
#ifdef PICKED
        const ulong list = strip * ((each + PICK_BLOCK - 1) / PICK_BLOCK) + first / PICK_BLOCK;
        const int begin = starts[list], end = starts[list + 1];
        if (begin < 0 || end > (int)pick_count) flag |= STATUS_OUT_OF_RANGE;
        for (int k = max(begin, 0); k < min(end, (int)pick_count); k++) {
            const int unseen = picks[k] < 0;
            const uint number = unseen ? ~picks[k] : picks[k];
            if (number >= segment_count) {
                flag |= STATUS_OUT_OF_RANGE;
                continue;
            }
#else
        for (uint number = 0; number < segment_count; number++) {
            const int unseen = 0;
#endif
            lit one = lit_of(segments + 10 * (ulong)number, middle);
            if (!one.is_good) flag |= STATUS_NOT_FINITE;
            if (!one.is_lit) continue;
            facing all;
            const masks faces = face(&here, &one, &all);
#ifdef STRIP
            uint lanes = bvh_lanes(faces) & ((1u << here.count) - 1);
#else
            uint lanes = faces ? 1 : 0;
#endif
            for (; lanes; lanes &= lanes - 1) {
                const int lane = bvh_lowest(lanes);
                if (unseen) add_piece(&one, &all, lane, 0, 1, &waiting, here.sums);
                else add_light(&tree, &one, &all, lane, clearance, samples, &hint, &here, &waiting);
            }
        }
        finish(&waiting, here.sums);
        for (uint lane = 0; lane < here.count; lane++) {
            const ulong i = row + lane;
            const place light = result_of(&here, lane, flag, irradiance + i, status + i);
            if (here.is_none[lane]) continue;
            to_left += light * (place)weights[2 * i], to_right += light * (place)weights[2 * i + 1];
        }
    }
#ifdef STRIP
    left[strip] = (real)to_left, right[strip] = (real)to_right;
#else
    local place both[2 * GROUP];
    const uint item = get_local_id(0);
    both[2 * item] = to_left, both[2 * item + 1] = to_right;
    for (uint half_size = GROUP / 2; half_size; half_size /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < half_size) {
            both[2 * item] += both[2 * (item + half_size)];
            both[2 * item + 1] += both[2 * (item + half_size) + 1];
        }
    }
    if (item == 0) left[strip] = (real)both[0], right[strip] = (real)both[1];
#endif
}
