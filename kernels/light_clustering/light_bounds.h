// Bounds for light clustering: the largest irradiance that a cluster or a segment can cause on a block of receivers, and the
// largest error of the segment that represents a cluster. Derivations: gpuvision/simulation/clustering/light_tree.py.
#ifndef LIGHT_BOUNDS_H
#define LIGHT_BOUNDS_H
#include "common/bvh.h"

// Offsets in the rows of nodes (NODE_CENTRE, ..., NODE_SIZE) and of segments (SEGMENT_NORMAL, ..., SEGMENT_SIZE) are build
// options: NODE_SIZES in gpuvision/simulation/clustering/light_tree.py, _SEGMENT_SIZES in light_clustering.py.

#define PER_PI ((real)0.31830988618379067)
#define PI ((real)3.14159265358979324)
// Factor that covers the rounding of the bounds themselves.
#define UP ((real)1 + (real)256 * (real)REAL_EPSILON)

// Memory of the receivers: a work-item's own, or local where a work-group processes a block.
#ifdef VECTOR_VARIANT
#define BLOCK_SPACE private
#define load_lanes load_private
#else
#define BLOCK_SPACE local
#define load_lanes(from) (*(from))
#endif

// Receivers of a block with a cost.
typedef struct {
    real places[3 * BLOCK], normals[3 * BLOCK];
    real lanes[7 * WIDTH]; // x, y, z of places, then of normals, and costs, side by side; no cost behind the last
} block_receivers;

// Bounds of these receivers: box and its centre, mean normal, largest deviation of a normal (spread), heights of the centre
// above their planes, largest distance from the mean plane (slab).
typedef struct {
    real centre[3], low[3], high[3], normal[3];
    real radius, spread, most_height, least_height, slab, cost;
    int count;
} block_bounds;

typedef struct {
    real bound; // the largest cos cos / (pi r^2) of any two points
    int faces;  // whether all of one face all of the other
} meeting;

// fmin() and fmax() may become function calls. NaN in b is ignored.
static inline real lower(real a, real b) { return b < a ? b : a; }
static inline real higher(real a, real b) { return b > a ? b : a; }

static inline real dot3(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
static inline real length3(const real *a) { return sqrt(dot3(a, a)); }

static inline void cross3(const real *a, const real *b, real *c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

// Store the receivers of a block and return their bounds. Skip receivers without cost, which do not affect the reading, and
// receivers with a zero normal.
static inline block_bounds block_of(global const INPUT *receivers, global const real *costs, int count,
                                    global const INPUT *middle, BLOCK_SPACE block_receivers *all) {
    block_bounds block;
    int kept = 0;
    block.cost = 0;
    for (int k = 0; k < 3; k++) block.low[k] = INFINITY, block.high[k] = -INFINITY, block.normal[k] = 0;
    for (int i = 0; i < count; i++) {
        real size = 0;
        for (int k = 0; k < 3; k++) size += (real)receivers[6 * i + 3 + k] * (real)receivers[6 * i + 3 + k];
        if (!(costs[i] > 0 && size > 0)) continue;
        all->lanes[6 * WIDTH + kept] = costs[i], block.cost += costs[i];
        BLOCK_SPACE real *place = all->places + 3 * kept, *normal = all->normals + 3 * kept;
        for (int k = 0; k < 3; k++) {
            place[k] = (real)(receivers[6 * i + k] - middle[k]);
            normal[k] = (real)receivers[6 * i + 3 + k];
            block.low[k] = lower(block.low[k], place[k]);
            block.high[k] = higher(block.high[k], place[k]);
        }
        const real per = (real)1 / sqrt(size);
        for (int k = 0; k < 3; k++) block.normal[k] += normal[k] *= per;
        kept++;
    }
    block.count = kept;
    if (!kept) return block;
    for (int i = 0; i < WIDTH; i++) {
        const int from = i < kept ? i : 0;
        for (int k = 0; k < 3; k++) {
            all->lanes[k * WIDTH + i] = all->places[3 * from + k];
            all->lanes[(3 + k) * WIDTH + i] = all->normals[3 * from + k];
        }
        if (i >= kept) all->lanes[6 * WIDTH + i] = 0;
    }
    const real size = length3(block.normal);
    for (int k = 0; k < 3; k++) {
        block.centre[k] = (real)0.5 * (block.low[k] + block.high[k]);
        block.normal[k] = size > 0 ? block.normal[k] / size : all->normals[k];
    }
    block.radius = block.spread = block.slab = 0;
    block.most_height = -INFINITY, block.least_height = INFINITY;
    for (int i = 0; i < kept; i++) {
        real from[3], off[3], normal[3];
        for (int k = 0; k < 3; k++) {
            normal[k] = all->normals[3 * i + k];
            from[k] = all->places[3 * i + k] - block.centre[k];
            off[k] = normal[k] - block.normal[k];
        }
        const real height = -dot3(normal, from);
        block.radius = higher(block.radius, length3(from));
        block.spread = higher(block.spread, length3(off));
        block.slab = higher(block.slab, fabs(dot3(block.normal, from)));
        block.most_height = higher(block.most_height, height);
        block.least_height = lower(block.least_height, height);
    }
    return block;
}

static inline meeting meeting_of(const block_bounds *block, global const real *row, int single, real rounding) {
    real to[3], side[3], reach = 0, back = 0, front = 0;
    const real normal[3] = {row[NODE_NORMAL], row[NODE_NORMAL + 1], row[NODE_NORMAL + 2]};
    for (int k = 0; k < 3; k++) {
        to[k] = block->centre[k] - row[NODE_CENTRE + k];
        side[k] = (real)0.5 * (block->high[k] - block->low[k]);
        reach += fabs(normal[k]) * side[k];
        const real low = block->normal[k] * (row[NODE_LOW + k] - row[NODE_CENTRE + k]);
        const real high = block->normal[k] * (row[NODE_HIGH + k] - row[NODE_CENTRE + k]);
        front += higher(low, high), back -= lower(low, high);
    }
    // Extent along a normal: the smaller of the bounds from the box and from the disc.
    real across[3];
    cross3(normal, block->normal, across);
    const real sine = length3(across), cosine = fabs(dot3(normal, block->normal));
    const real between = length3(to), wide = row[NODE_RADIUS], lit_disc = cosine * row[NODE_SLAB] + sine * wide;
    reach = lower(reach, cosine * block->slab + sine * block->radius);
    front = lower(front, lit_disc), back = lower(back, lit_disc);
    // Heights of the receivers above the lit surfaces, and of the segments above the receivers' planes.
    const real lit_turn = row[NODE_SPREAD] * (between + block->radius), got_turn = block->spread * (between + wide);
    const real lit = dot3(normal, to), got = -dot3(block->normal, to);
    const real lit_most = lit + lit_turn + row[NODE_MAX_HEIGHT] + reach;
    const real got_most = got + got_turn + block->most_height + front;
    meeting met = {0, 0};
    if (!(lit_most > 0 && got_most > 0)) return met;
    met.faces = lit - lit_turn + row[NODE_MIN_HEIGHT] - reach > rounding &&
                got - got_turn + block->least_height - back > rounding;
    real gap = 0;
    for (int k = 0; k < 3; k++) {
        const real apart = higher(higher(block->low[k] - row[NODE_HIGH + k], row[NODE_LOW + k] - block->high[k]), (real)0);
        gap += apart * apart;
    }
    const real distance = higher(sqrt(gap), between - block->radius - wide) - rounding;
    if (!(distance > 0)) {
        met.bound = INFINITY;
        return met;
    }
    const real per = UP / distance;
    const real cosines = lower((lit_most + rounding) * per, (real)1) * lower((got_most + rounding) * per, (real)1);
    // The integral of dt / r^2 over a line at distance r is at most pi / r.
    const real spread = single ? PI * per / row[NODE_LENGTH] : (real)INFINITY;
    met.bound = cosines * lower(per * per, spread) * PER_PI * UP;
    return met;
}

// Largest error of the representing segment: irradiance per watt (third-order expansion of the kernel, light_tree.py).
static inline real error_of(const block_bounds *block, global const real *row, real rounding) {
    real gap = 0;
    for (int k = 0; k < 3; k++) {
        const real apart =
            higher(higher(block->low[k] - row[NODE_CENTRE + k], row[NODE_CENTRE + k] - block->high[k]), (real)0);
        gap += apart * apart;
    }
    const real distance = sqrt(gap) - rounding, per = UP / distance;
    const real q = row[NODE_RADIUS] * per, arm = row[NODE_ARM] * per;
    if (!(distance > 0 && q < 1 && arm < 1)) return INFINITY;
    const real third = ((real)4 - 3 * q) / ((1 - q) * (1 - q)), fourth = ((real)5 - 4 * arm) / ((1 - arm) * (1 - arm));
    const real beyond = row[NODE_SECOND_ORDER] + per * (row[NODE_THIRD_MOMENT] * third + per * row[NODE_FOURTH_MOMENT] * fourth);
    return per * per * per * (row[NODE_FIRST_ORDER] + per * beyond) * PER_PI * UP;
}

// Largest cost of a watt of a segment at the receiver of each lane, times pi.
INLINE reals most_of_lane(BLOCK_SPACE const real *lane, global const real *lit, real length, real rounding) {
    const reals zero = (reals)0, one = (reals)1;
    const reals nx = load_lanes(lane + 3 * WIDTH), ny = load_lanes(lane + 4 * WIDTH);
    const reals nz = load_lanes(lane + 5 * WIDTH), cost = load_lanes(lane + 6 * WIDTH);
    const reals x = load_lanes(lane) - lit[SEGMENT_START], y = load_lanes(lane + WIDTH) - lit[SEGMENT_START + 1];
    const reals z = load_lanes(lane + 2 * WIDTH) - lit[SEGMENT_START + 2];
    const real dx = lit[SEGMENT_END] - lit[SEGMENT_START], dy = lit[SEGMENT_END + 1] - lit[SEGMENT_START + 1], dz = lit[SEGMENT_END + 2] - lit[SEGMENT_START + 2];
    const reals up = x * lit[SEGMENT_NORMAL] + y * lit[SEGMENT_NORMAL + 1] + z * lit[SEGMENT_NORMAL + 2];
    const reals start = -(nx * x + ny * y + nz * z);
    const reals ahead = start + lane_max(nx * dx + ny * dy + nz * dz, zero);
    const reals part = lane_min(lane_max((x * dx + y * dy + z * dz) / (length * length), zero), one);
    const reals u = x - part * dx, v = y - part * dy, w = z - part * dz;
    const reals distance = sqrt(u * u + v * v + w * w) - rounding, per = UP / distance;
    const reals cosines = lane_min((up + rounding) * per, one) * lane_min((ahead + rounding) * per, one);
    const reals light = cost * cosines * lane_min(per * per, per * (PI / length));
    const masks gets = mask_of(up > 0) & mask_of(ahead > 0) & mask_of(cost > 0);
    return gets ? (mask_of(distance > 0) ? light : (reals)INFINITY) : zero;
}

// Largest cost of a segment, summed over receivers: finite even where the block touches the lit surface.
static inline real most_of_segment(BLOCK_SPACE const real *lanes, global const real *lit, real length, real power,
                            real rounding) {
    real sum = 0;
#ifdef VECTOR_VARIANT
    real each[WIDTH];
    *(reals_at *)each = most_of_lane(lanes, lit, length, rounding);
    for (int i = 0; i < WIDTH; i++) sum += each[i];
#else
    for (int i = 0; i < WIDTH; i++) sum += most_of_lane(lanes + i, lit, length, rounding);
#endif
    return sum * power * PER_PI * UP;
}

#endif
