// Error-bounded light clustering: the cut through a light tree (lightcuts, Walter et al. 2005) for each block of receivers.
//
// Inputs:  receivers (strips, of_strip, 6) position [m] and normal, type INPUT; costs (strips, of_strip), weight of a
//          receiver's irradiance in the reading; shares (strips,), error allowed per watt; rows (nodes, NODE_SIZE), spans
//          (nodes, 2), the tree of gpuvision/simulation/clustering/light_tree.py; placed (segments, SEGMENT_SIZE); frame (4,),
//          middle of the positions and their rounding.
// Outputs: per block: picks and errors (blocks, capacity), counts, spent (2), tallies (2).
// Options: OCCLUDERS (a scene can hide light), CLUSTERS (clusters may be represented), BLOCK (receivers per block), INPUT,
//          REAL_IS_DOUBLE, BVH_DEPTH. Variants: vector: `each` blocks per work-item; work-item: one block per item.
//
// From the root down, a cluster is (1) omitted if the light that it can send is below its share; (2) represented by one
// segment if the bound of the error is below its share and no surface can occlude it; (3) else opened.
#include "light_clustering/light_bounds.h"
#include "light_clustering/shaft.h"

// Flag of a pick: no surface can occlude the segment. A picked cluster is ~node.
#define CLEAR (1 << 30)
// Occlusion is tested for clusters of at most this many segments, not for single ones: the test costs as much as the exact
// visibility of one segment. PATIENCE: failed tests per block before it gives up; each success adds PATIENCE_WON.
#define MOST_LOOKED_AT 16
#define PATIENCE 32
#define PATIENCE_WON 2
// Counts of a block: omitted segments, and segments represented by a cluster.
#define OUT 0
#define TOGETHER 1
#define TALLIES 2

#ifdef OCCLUDERS
typedef struct {
    reals x, y, z;
} vectors;

// Bounds of a set of points with normals: box, disc, and cone of normals.
typedef struct {
    real centre[3], low[3], high[3], normal[3];
    real radius, slab, spread, most_height;
} extent;

INLINE vectors corner_of(global const real *leaf, int corner) {
    global const real *at = leaf + 3 * corner * WIDTH;
    const vectors v = {load_reals(at), load_reals(at + WIDTH), load_reals(at + 2 * WIDTH)};
    return v;
}

INLINE vectors from(vectors v, const real *place) {
    const vectors way = {v.x - place[0], v.y - place[1], v.z - place[2]};
    return way;
}

INLINE vectors cross(vectors p, vectors q) {
    const vectors n = {p.y * q.z - p.z * q.y, p.z * q.x - p.x * q.z, p.x * q.y - p.y * q.x};
    return n;
}

INLINE reals along(vectors v, real x, real y, real z) { return v.x * x + v.y * y + v.z * z; }
INLINE reals size_of(vectors v) { return sqrt(v.x * v.x + v.y * v.y + v.z * v.z); }

INLINE reals highest(vectors a, vectors b, vectors c, const real *up) {
    const reals u = along(a, up[0], up[1], up[2]), v = along(b, up[0], up[1], up[2]);
    return lane_max(lane_max(u, v), along(c, up[0], up[1], up[2]));
}

// Upper bound of the height of a point above any of the planes.
INLINE reals rise(const extent *many, vectors corner) {
    const vectors way = from(corner, many->centre);
    return along(way, many->normal[0], many->normal[1], many->normal[2]) + many->spread * size_of(way) +
           many->most_height;
}

// Interval of the points along a direction, from a level.
INLINE void between(const extent *many, vectors n, reals size, reals level, reals *low,
                        reals *high) {
    const reals middle = along(n, many->centre[0], many->centre[1], many->centre[2]) - level;
    reals front = (reals)0, back = (reals)0;
    const reals parts[3] = {n.x, n.y, n.z};
    for (int k = 0; k < 3; k++) {
        const reals one = parts[k] * (many->low[k] - many->centre[k]);
        const reals two = parts[k] * (many->high[k] - many->centre[k]);
        front += lane_max(one, two), back += lane_min(one, two);
    }
    const reals cosine = fabs(along(n, many->normal[0], many->normal[1], many->normal[2]));
    const reals sine = sqrt(lane_max(size * size - cosine * cosine, (reals)0));
    const reals disc = cosine * many->slab + sine * many->radius;
    *low = middle + lane_max(back, -disc), *high = middle + lane_min(front, disc);
}

// Return the triangles of a leaf that may hide a part of the lit cluster from a receiver. Such a triangle intersects
// the convex hull of both, rises above the plane of each, and has the receiver on one side of its plane and a part of
// the cluster on the other side. In projection from the receiver, no edge of the triangle has the whole cluster on its
// outer side.
INLINE int hides(const shaft *hull, const receivers_block *block, const extent *got, const extent *out,
                     global const real *lit, int count, real margin, global const real *leaf) {
    masks left = shaft_leaf(hull, leaf);
    if (!any_compared(left)) return 0;
    const vectors a = corner_of(leaf, 0), b = corner_of(leaf, 1), c = corner_of(leaf, 2);
    left &= mask_of(lane_max(rise(got, a), lane_max(rise(got, b), rise(got, c))) > margin);
    if (!any_compared(left)) return 0;
    const vectors p = {b.x - a.x, b.y - a.y, b.z - a.z}, q = {c.x - a.x, c.y - a.y, c.z - a.z};
    const vectors n = cross(p, q);
    const reals level = n.x * a.x + n.y * a.y + n.z * a.z, slack = margin * size_of(n);
    masks above = (masks)(0), below = (masks)(0);
    for (int i = 0; i < count; i++) {
        const real normal[3] = {lit[SEGMENT_NORMAL], lit[SEGMENT_NORMAL + 1], lit[SEGMENT_NORMAL + 2]};
        const masks over = left & mask_of(highest(a, b, c, normal) > lit[SEGMENT_HEIGHT] + margin);
        const reals start = along(n, lit[SEGMENT_START], lit[SEGMENT_START + 1], lit[SEGMENT_START + 2]) - level;
        const reals end = along(n, lit[SEGMENT_END], lit[SEGMENT_END + 1], lit[SEGMENT_END + 2]) - level;
        above |= over & mask_of(lane_max(start, end) > slack);
        below |= over & mask_of(lane_min(start, end) < -slack);
        lit += SEGMENT_SIZE;
    }
    left &= above | below;
    if (!any_compared(left)) return 0;
    for (int i = 0; i < block->count; i++) {
        const real *place = block->places + 3 * i, *normal = block->normals + 3 * i;
        const vectors u = from(a, place), v = from(b, place), w = from(c, place);
        const reals top = highest(u, v, w, normal);
        const reals side = along(n, place[0], place[1], place[2]) - level;
        masks may = left & mask_of(top > margin);
        may &= (mask_of(side > slack) & below) | (mask_of(side < -slack) & above);
        if (!any_compared(may)) continue;
        // The cone from the receiver over the triangle: inside is where all edges have the sign of `side`, turned.
        const vectors edges[3] = {cross(u, v), cross(v, w), cross(w, u)};
        for (int edge = 0; edge < 3; edge++) {
            const vectors m = edges[edge];
            reals first, last;
            between(out, m, size_of(m), along(m, place[0], place[1], place[2]), &first, &last);
            may &= (mask_of(side < 0) & mask_of(last > 0)) | (mask_of(side > 0) & mask_of(first < 0));
            if (!any_compared(may)) break;
        }
        if (any_compared(may)) return 1;
    }
    return 0;
}

INLINE uint shaft_met(const shaft *hull, global const real *node) {
#ifdef VECTOR_VARIANT
    return lane_bits(shaft_node(hull, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= shaft_node(hull, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

static inline int leaf_hides(const shaft *hull, const receivers_block *block, const extent *got, const extent *out,
                      global const real *lit, int count, real margin, global const real *leaf) {
#ifdef VECTOR_VARIANT
    return hides(hull, block, got, out, lit, count, margin, leaf);
#else
    for (int lane = 0; lane < WIDTH; lane++)
        if (hides(hull, block, got, out, lit, count, margin, leaf + lane)) return 1;
    return 0;
#endif
}

// Whether no triangle can lie between a block and a cluster. A leaf that hides some of one cluster may hide some of the
// next: it is tried first.
static inline int is_clear(const bvh_tree *tree, const receivers_block *block, global const real *row, global const real *lit,
                    int count, real margin, int *culprit) {
    extent got, out;
    for (int k = 0; k < 3; k++) {
        got.centre[k] = block->centre[k], got.low[k] = block->low[k], got.high[k] = block->high[k];
        got.normal[k] = block->normal[k];
        out.centre[k] = row[NODE_CENTRE + k], out.low[k] = row[NODE_LOW + k], out.high[k] = row[NODE_HIGH + k];
        out.normal[k] = row[NODE_NORMAL + k];
    }
    got.radius = block->radius, got.slab = block->slab;
    got.spread = block->spread, got.most_height = block->most_height;
    out.radius = row[NODE_RADIUS], out.slab = row[NODE_SLAB], out.spread = row[NODE_SPREAD], out.most_height = row[NODE_MAX_HEIGHT];
    const shaft hull = shaft_of(got.low, got.high, out.low, out.high, margin);
    if (*culprit >= 0) {
        global const real *leaf = tree->leaves + (size_t)*culprit * (9 * WIDTH);
        if (leaf_hides(&hull, block, &got, &out, lit, count, margin, leaf)) return 0;
    }
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0;
    uint met = shaft_met(&hull, tree->nodes);
    while (true) {
        if (!met) {
            if (!depth) return 1;
            node = nodes[--depth];
            met = left[depth];
            continue;
        }
        const int lane = lowest_bit(met);
        met ^= 1u << lane;
        const int child = tree->children[node * WIDTH + lane];
        if (child < 0) {
            global const real *leaf = tree->leaves + (size_t)~child * (9 * WIDTH);
            if (!leaf_hides(&hull, block, &got, &out, lit, count, margin, leaf)) continue;
            *culprit = ~child;
            return 0;
        }
        if (met) {
            nodes[depth] = node;
            left[depth++] = met;
        }
        node = child;
        met = shaft_met(&hull, tree->nodes + (size_t)node * (6 * WIDTH));
    }
}
#endif

// Next node in heap order that is not below `node`; 0 after the last.
static inline uint after(uint node) {
    const uint next = node + 1;
    const uint at = next >> popcount((next & -next) - 1);
    return at == 1 ? 0 : at;
}

#ifdef OCCLUDERS
#define OPEN_LEVEL 99
#else
#define OPEN_LEVEL -1
#endif

kernel void select_lights(global const INPUT *restrict receivers, global const real *restrict costs,
                       global const real *restrict shares, global const real *restrict rows,
                       global const int *restrict spans, global const real *restrict placed,
                       global const INPUT *restrict frame,
                       global int *restrict selected, global float *restrict errors, global int *restrict counts,
                       global real *restrict spent, global int *restrict tallies, global const real *nodes,
                       global const int *children, global const int *axes, global const real *leaves,
                       global const int *triangles, const real margin, const uint capacity,
                       const uint blocks, const uint blocks_of_strip, const uint of_strip, const uint each) {
#ifdef OCCLUDERS
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
#endif
    // Positions are relative to the middle of the frame; frame[3] bounds their rounding.
    const real rounding = (real)frame[3];
    const uint begin = get_global_id(0) * each, end = min(begin + each, blocks);
    for (uint b = begin; b < end; b++) {
        const uint strip = b / blocks_of_strip, first = (b % blocks_of_strip) * BLOCK;
        const size_t at = (size_t)strip * of_strip + first;
        const receivers_block block =
            block_of(receivers + 6 * at, costs + at, (int)min((uint)BLOCK, of_strip - first), frame);
        const real share = shares[strip];
        global int *pick = selected + (size_t)b * capacity;
        global float *error = errors + (size_t)b * capacity;
        uint found = 0;
        int out = 0, together = 0, culprit = -1, patience = PATIENCE;
        // Level of the ancestor that no surface can occlude; OPEN_LEVEL if no such ancestor exists.
        int open_level = OPEN_LEVEL;
        real lost = 0, whole = 0;
        uint node = block.count ? 1 : 0;
        while (node) {
            const int place = spans[2 * node], count = spans[2 * node + 1], level = 31 - (int)clz(node);
            global const real *row = rows + (size_t)node * NODE_SIZE;
            const uint next = after(node);
            if (level <= open_level) open_level = OPEN_LEVEL;
            if (!(row[NODE_POWER] > 0)) {
                node = next;
                continue;
            }
            const meeting met = meeting_of(&block, row, count == 1, rounding);
            // Avoid 0 times infinity: a zero bound may meet an infinite cost.
            real most = met.bound > 0 ? met.bound * row[NODE_POWER] * block.cost : 0;
            if (count == 1 && met.bound > share) {
                global const real *lit = placed + SEGMENT_SIZE * place;
                most = lower(most, most_of_segment(&block, lit, row[NODE_LENGTH], row[NODE_POWER], rounding));
            }
            if (most == 0 || met.bound <= share || most <= share * row[NODE_POWER] * block.cost) {
                out += count;
                lost += most, whole += most;
                node = next;
                continue;
            }
            real wrong = count > 1 ? (real)INFINITY : (real)0;
#ifdef CLUSTERS
            if (count > 1 && met.faces) wrong = error_of(&block, row, rounding);
#endif
            const int close = wrong <= share;
#ifdef OCCLUDERS
            // Test occlusion only where it can save work: for many segments, or for few that one could represent.
            const int worth = count > 1 && count <= MOST_LOOKED_AT && (2 * count > MOST_LOOKED_AT || close);
            if (level < open_level && patience > 0 && worth) {
                const int clear = is_clear(&tree, &block, row, placed + SEGMENT_SIZE * place, count, margin, &culprit);
                if (clear) open_level = level;
                patience += clear ? PATIENCE_WON : -1;
            }
#endif
            const int open = level >= open_level;
            if (count > 1 && !(open && close)) {
                node = 2 * node;
                continue;
            }
            if (count > 1) together += count, lost += wrong * row[NODE_POWER] * block.cost;
            whole += most;
            if (found < capacity) {
                pick[found] = count > 1 ? ~(int)node : open ? place | CLEAR : place;
                error[found] = (float)most * 1.000001f;
            }
            found++;
            node = next;
        }
        counts[b] = (int)found;
        spent[2 * b] = lost * UP, spent[2 * b + 1] = whole * UP;
        tallies[TALLIES * b + OUT] = out;
        tallies[TALLIES * b + TOGETHER] = together;
    }
}
