// Error-bounded light clustering: the cut through a light tree (lightcuts, Walter et al. 2005) for each block of receivers.
//
// Inputs:  receivers (strips, of_strip, 6) position [m] and normal, type INPUT; costs (strips, of_strip), weight of a
//          receiver's irradiance in the reading; shares (strips,), error allowed per watt; rows (nodes, NODE_SIZE), spans
//          (nodes, 2), the tree of gpuvision/simulation/clustering/light_tree.py; placed (segments, SEGMENT_SIZE); frame (4,),
//          middle of the positions and their rounding.
// Outputs: per block: picks and errors (blocks, capacity), counts, spent (2), tallies (2).
// Options: OCCLUDERS (a scene can hide light), CLUSTERS (clusters may be represented), BLOCK (receivers per block), INPUT,
//          REAL_IS_DOUBLE, BVH_DEPTH, GROUP (work-items of a group of the work-item variant).
// Variants: vector: `each` blocks per work-item, 16 boxes or triangles at once; work-item: a work-group per block, whose
//          items compute the bounds of clusters and test triangles side by side (block_group.h). Both take the nodes in the
//          same order and select the same lights.
//
// From the root down, a cluster is (1) omitted if the light that it can send is below its share; (2) represented by one
// segment if the bound of the error is below its share and no surface can occlude it; (3) else opened.
#include "light_clustering/light_cut.h"
#ifdef OCCLUDERS
#include "light_clustering/occluders.h"
#endif
#ifndef VECTOR_VARIANT
#include "light_clustering/block_group.h"
#endif

// Counts of a block: omitted segments, and segments represented by a cluster.
#define OUT 0
#define TOGETHER 1
#define TALLIES 2

#ifdef VECTOR_VARIANT
#ifdef OCCLUDERS
// Whether no triangle can lie between a block and a cluster. A leaf that hides some of one cluster may hide some of the
// next: it is tried first.
static inline int is_clear(const bvh_tree *tree, const block_receivers *all, const block_bounds *block,
                           global const real *row, global const real *lit, int count, real margin, int *culprit) {
    const extent got = extent_of_block(block), out = extent_of_cluster(row);
    const shaft hull = shaft_of(got.low, got.high, out.low, out.high, margin);
    if (*culprit >= 0) {
        global const real *leaf = tree->leaves + (size_t)*culprit * (9 * WIDTH);
        if (hides(&hull, all, block->count, &got, &out, lit, count, margin, leaf)) return 0;
    }
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0;
    uint met = lane_bits(shaft_node(&hull, tree->nodes));
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
            if (!hides(&hull, all, block->count, &got, &out, lit, count, margin, leaf)) continue;
            *culprit = ~child;
            return 0;
        }
        if (met) {
            nodes[depth] = node;
            left[depth++] = met;
        }
        node = child;
        met = lane_bits(shaft_node(&hull, tree->nodes + (size_t)node * (6 * WIDTH)));
    }
}
#endif

INLINE light_cut cut_of_block(const light_tree *lights, const bvh_tree *tree, global const INPUT *receivers,
                              global const real *costs, int count, global const INPUT *middle, real share, real margin,
                              const entry_lists *to) {
    block_receivers all;
    const block_bounds block = block_of(receivers, costs, count, middle, &all);
    light_cut cut = new_cut();
    for (uint node = block.count ? 1 : 0; node;) {
        const int level = level_of(node);
        enter_level(&cut, level);
        const node_bounds of = bounds_of(lights, node, &block, all.lanes, share);
        if (of.is_omitted) {
            node = omit_node(&cut, &of, node);
            continue;
        }
#ifdef OCCLUDERS
        if (wants_test(&cut, &of, level)) {
            global const real *row = lights->rows + (size_t)node * NODE_SIZE;
            global const real *lit = lights->placed + SEGMENT_SIZE * of.place;
            keep_test(&cut, is_clear(tree, &all, &block, row, lit, of.count, margin, &cut.culprit), level);
        }
#endif
        node = take_node(&cut, &of, node, level, block.cost, to, 1);
    }
    return cut;
}
#endif

kernel void select_lights(global const INPUT *restrict receivers, global const real *restrict costs,
                       global const real *restrict shares, global const real *restrict rows,
                       global const int *restrict spans, global const real *restrict placed,
                       global const INPUT *restrict frame,
                       global int *restrict selected, global float *restrict errors, global int *restrict counts,
                       global real *restrict spent, global int *restrict tallies, global const real *nodes,
                       global const int *children, global const int *axes, global const real *leaves,
                       global const int *triangles, const real margin, const uint capacity,
                       const uint blocks, const uint blocks_of_strip, const uint of_strip, const uint each,
                       const uint tree_nodes) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    // Positions are relative to the middle of the frame; frame[3] bounds their rounding.
    const light_tree lights = {rows, placed, spans, (real)frame[3]};
#ifndef VECTOR_VARIANT
    local group_memory memory;
#endif
    const uint begin = get_group_id(0) * each, end = min(begin + each, blocks);
    for (uint b = begin; b < end; b++) {
        const uint strip = b / blocks_of_strip, first = (b % blocks_of_strip) * BLOCK;
        const size_t at = (size_t)strip * of_strip + first;
        const int count = min((uint)BLOCK, of_strip - first);
        const entry_lists to = {selected + (size_t)b * capacity, errors + (size_t)b * capacity, capacity};
#ifdef VECTOR_VARIANT
        const light_cut cut = cut_of_block(&lights, &tree, receivers + 6 * at, costs + at, count, frame, shares[strip],
                                           margin, &to);
#else
        const light_cut cut = cut_of_block(&lights, &tree, tree_nodes, receivers + 6 * at, costs + at, count, frame,
                                           shares[strip], margin, &to, &memory);
#endif
        if (get_local_id(0)) continue;
        counts[b] = (int)cut.found;
        spent[2 * b] = cut.lost * UP, spent[2 * b + 1] = cut.whole * UP;
        tallies[TALLIES * b + OUT] = cut.omitted;
        tallies[TALLIES * b + TOGETHER] = cut.represented;
    }
}
