// Cut through a light tree: bounds of its nodes, and the decision at each node, for both variants of light_clustering.cl.
#ifndef LIGHT_CUT_H
#define LIGHT_CUT_H
#include "light_clustering/light_bounds.h"

// Flag of a pick: no surface can occlude the segment. A picked cluster is ~node.
#define CLEAR (1 << 30)
// Occlusion is tested for clusters of at most this many segments, not for single ones: the test costs as much as the exact
// visibility of one segment. PATIENCE: failed tests per block before it gives up; each success adds PATIENCE_WON.
#define MOST_LOOKED_AT 16
#define PATIENCE 32
#define PATIENCE_WON 2
#ifdef OCCLUDERS
#define OPEN_LEVEL 99
#else
#define OPEN_LEVEL -1
#endif

typedef struct {
    global const real *rows, *placed;
    global const int *spans;
    real rounding; // bound of the rounding of positions
} light_tree;

// Lists of a block.
typedef struct {
    global int *selected;
    global float *errors;
    uint capacity;
} entry_lists;

// Result of a block, and the state of its traversal.
typedef struct {
    uint found;               // entries
    int omitted, represented; // segments that are left out, and segments represented by a cluster
    real lost, whole;         // bounds of the error by omitted and clustered nodes, and by omitting all segments
    int culprit;              // leaf that hid a part of the last cluster that was not clear, or -1
    int patience;
    int open_level; // level of the ancestor that no surface can occlude; OPEN_LEVEL if no such ancestor exists
} light_cut;

// Segments of a node (none if it has no power), its largest cost, and the bound of the error of its representing segment.
typedef struct {
    int place, count;
    real most, error;
    int is_omitted; // its light is below its share
    int is_close;   // a segment may represent it
} node_bounds;

INLINE light_cut new_cut(void) { return (light_cut){0, 0, 0, 0, 0, -1, PATIENCE, OPEN_LEVEL}; }

static inline int level_of(uint node) { return 31 - (int)clz(node); }

// Next node in heap order that is not below `node`; 0 after the last.
static inline uint after(uint node) {
    const uint next = node + 1;
    const uint at = next >> popcount((next & -next) - 1);
    return at == 1 ? 0 : at;
}

INLINE node_bounds bounds_of(const light_tree *lights, uint node, const block_bounds *block,
                             BLOCK_SPACE const real *lanes, real share) {
    global const real *row = lights->rows + (size_t)node * NODE_SIZE;
    const real power = row[NODE_POWER], rounding = lights->rounding;
    node_bounds of = {lights->spans[2 * node], lights->spans[2 * node + 1], 0, 0, 0, 0};
    if (!(power > 0)) {
        of.count = 0, of.is_omitted = 1;
        return of;
    }
    const meeting met = meeting_of(block, row, of.count == 1, rounding);
    // Avoid 0 times infinity: a zero bound may meet an infinite cost.
    of.most = met.bound > 0 ? met.bound * power * block->cost : 0;
    if (of.count == 1 && met.bound > share) {
        global const real *lit = lights->placed + SEGMENT_SIZE * of.place;
        of.most = lower(of.most, most_of_segment(lanes, lit, row[NODE_LENGTH], power, rounding));
    }
    if (of.most == 0 || met.bound <= share || of.most <= share * power * block->cost) {
        of.is_omitted = 1;
        return of;
    }
    real wrong = of.count > 1 ? (real)INFINITY : (real)0;
#ifdef CLUSTERS
    if (of.count > 1 && met.faces) wrong = error_of(block, row, rounding);
#endif
    of.is_close = wrong <= share;
    of.error = wrong * power;
    return of;
}

// Forget the open ancestor where the traversal leaves it.
INLINE void enter_level(light_cut *cut, int level) {
    if (level <= cut->open_level) cut->open_level = OPEN_LEVEL;
}

// Whether to test a cluster that is not omitted for occluders: only where it can save work, for many segments, or for few
// that one could represent.
INLINE int wants_test(const light_cut *cut, const node_bounds *of, int level) {
    const int is_worth = of->count > 1 && of->count <= MOST_LOOKED_AT &&
                         (2 * of->count > MOST_LOOKED_AT || of->is_close);
    return level < cut->open_level && cut->patience > 0 && is_worth;
}

INLINE void keep_test(light_cut *cut, int is_clear, int level) {
    if (is_clear) cut->open_level = level;
    cut->patience += is_clear ? PATIENCE_WON : -1;
}

// Omit a node. Return the next node.
INLINE uint omit_node(light_cut *cut, const node_bounds *of, uint node) {
    cut->omitted += of->count;
    cut->lost += of->most, cut->whole += of->most;
    return after(node);
}

// Represent or open a node that is not omitted; `writes`: whether this work-item writes the entry. Return the next node.
INLINE uint take_node(light_cut *cut, const node_bounds *of, uint node, int level, real cost, const entry_lists *to,
                      int writes) {
    const int open = level >= cut->open_level, is_cluster = of->count > 1;
    if (is_cluster && !(open && of->is_close)) return 2 * node;
    if (is_cluster) cut->represented += of->count, cut->lost += of->error * cost;
    cut->whole += of->most;
    if (writes && cut->found < to->capacity) {
        to->selected[cut->found] = is_cluster ? ~(int)node : open ? of->place | CLEAR : of->place;
        to->errors[cut->found] = (float)of->most * 1.000001f;
    }
    cut->found++;
    return after(node);
}

#endif
