// Work-item variant of light_clustering.cl: a work-group follows the traversal of one block of receivers.
//
// The order of the nodes decides which clusters are tested for occluders (PATIENCE) and where an entry is written, so that
// the traversal is one sequence. Its bounds do not depend on the order: the items compute them ahead.
//   (1) Item: bounds of one node of the subtree of GROUP - 1 nodes below the next node, in local memory.
//   (2) All items follow the traversal through these bounds with the same state; item 0 writes the entries. They stop where
//       it leaves the subtree, or where a cluster is to be tested.
//   (3) Test: the nodes and leaves of the scene's tree that are still to be searched are a stack in local memory. Each round
//       takes up to four: 16 items test the boxes of a node, or the triangles of a leaf, and push the children. Children
//       are pushed in any order, and the result is the same: whether any triangle may hide a part of the cluster.
// The receivers and their bounds are in local memory, where item 0 stores them: a copy of each item would take 1 KiB of its
// stack.
#ifndef BLOCK_GROUP_H
#define BLOCK_GROUP_H
#include "light_clustering/light_cut.h"

#define SUBTREE GROUP              // nodes of a subtree: node n of its heap has the bounds n, 1 is its root
#define MOST_TAKEN (GROUP / WIDTH) // entries of the stack in a round
// Single entries need (WIDTH - 1) BVH_DEPTH places beyond the entries below them. Several are taken only where these remain.
#define ROOM_TO_TAKE ((2 * GROUP) - MOST_TAKEN * (WIDTH - 1))
#define STACK (2 * GROUP + (WIDTH - 1) * BVH_DEPTH)

typedef struct {
    block_receivers all;
    block_bounds block;
    node_bounds bounds[SUBTREE];
#ifdef OCCLUDERS
    int stack[STACK]; // index of a node, or ~index of a leaf
    int sizes[2];     // entries of the stack, for even and odd rounds
    int culprit;      // leaf that hides a part of the cluster, or -1
#endif
} group_memory;

// Place of a node in the heap of a subtree, or 0 if it is not in the subtree; no node is in the subtree of root 0.
INLINE uint place_in_subtree(uint node, uint root) {
    const int levels = level_of(node) - level_of(root);
    if (!node || !root || levels < 0 || node >> levels != root) return 0;
    const uint place = (1u << levels) + (node - (root << levels));
    return place < SUBTREE ? place : 0;
}

// (1) Store the bounds of one node of a subtree.
static inline void store_bounds(const light_tree *lights, uint root, uint tree_nodes, const block_bounds *block,
                                real share, local group_memory *memory) {
    const uint place = get_local_id(0);
    if (!place) return;
    const int levels = level_of(place);
    const uint node = (root << levels) + (place - (1u << levels));
    if (node < tree_nodes) memory->bounds[place] = bounds_of(lights, node, block, memory->all.lanes, share);
}

// (2) Follow the traversal from a node; return the node at which it stops, or 0 at its end. `tested`: node whose test has
// been kept.
static inline uint follow(light_cut *cut, uint node, uint root, uint tested, real cost, const entry_lists *to,
                          local const group_memory *memory) {
    uint place = place_in_subtree(node, root);
    while (place) {
        const int level = level_of(node);
        const node_bounds of = memory->bounds[place];
        if (node != tested) {
            enter_level(cut, level);
            if (!of.is_omitted && wants_test(cut, &of, level)) break;
        }
        node = of.is_omitted ? omit_node(cut, &of, node)
                             : take_node(cut, &of, node, level, cost, to, get_local_id(0) == 0);
        place = place_in_subtree(node, root);
    }
    return node;
}

#ifdef OCCLUDERS
// (3) Test a box or a triangle of an entry of the stack.
static inline void test_entry(const bvh_tree *tree, const shaft *hull, int receivers, const extent *got,
                              const extent *out, global const real *lit, int count, real margin, int entry,
                              local int *size, local group_memory *memory) {
    const int lane = get_local_id(0) % WIDTH;
    if (entry < 0) {
        global const real *leaf = tree->leaves + (size_t)~entry * (9 * WIDTH) + lane;
        if (hides(hull, &memory->all, receivers, got, out, lit, count, margin, leaf)) atomic_max(&memory->culprit, ~entry);
    } else if (shaft_node(hull, tree->nodes + (size_t)entry * (6 * WIDTH) + lane)) {
        memory->stack[atomic_inc(size)] = tree->children[entry * WIDTH + lane];
    }
}

// (3) Whether no triangle can lie between the block and a cluster, where `is_test` is set. All items call it.
INLINE int group_is_clear(const bvh_tree *tree, const block_bounds *block, int is_test, global const real *row,
                          global const real *lit, int count, real margin, int *culprit, local group_memory *memory) {
    const uint item = get_local_id(0);
    const extent got = extent_of_block(block), out = extent_of_cluster(row);
    const shaft hull = shaft_of(got.low, got.high, out.low, out.high, margin);
    // A leaf that hides some of one cluster may hide some of the next: it is among the first entries.
    int left = !is_test ? 0 : *culprit < 0 ? 1 : 2, round = 0;
    if (item == 0) memory->stack[0] = 0, memory->stack[1] = ~*culprit, memory->culprit = -1;
    barrier(CLK_LOCAL_MEM_FENCE);
    while (left) {
        local int *size = memory->sizes + round % 2;
        const int taken = left <= ROOM_TO_TAKE ? min(left, MOST_TAKEN) : 1, of_item = item / WIDTH;
        const int entry = of_item < taken ? memory->stack[left - 1 - of_item] : 0;
        if (item == 0) *size = left - taken;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (of_item < taken)
            test_entry(tree, &hull, block->count, &got, &out, lit, count, margin, entry, size, memory);
        barrier(CLK_LOCAL_MEM_FENCE);
        left = memory->culprit < 0 ? *size : 0;
        round++;
    }
    const int found = memory->culprit;
    if (is_test && found >= 0) *culprit = found;
    return found < 0;
}
#endif

INLINE light_cut cut_of_block(const light_tree *lights, const bvh_tree *tree, uint tree_nodes,
                              global const INPUT *receivers, global const real *costs, int count,
                              global const INPUT *middle, real share, real margin, const entry_lists *to,
                              local group_memory *memory) {
    if (get_local_id(0) == 0) memory->block = block_of(receivers, costs, count, middle, &memory->all);
    barrier(CLK_LOCAL_MEM_FENCE);
    const block_bounds block = memory->block;
    light_cut cut = new_cut();
    uint node = block.count ? 1 : 0, root = 0, tested = 0;
    while (node) {
        if (!place_in_subtree(node, root)) {
            root = node;
            store_bounds(lights, root, tree_nodes, &block, share, memory);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        node = follow(&cut, node, root, tested, block.cost, to, memory);
#ifdef OCCLUDERS
        const uint place = place_in_subtree(node, root);
        const node_bounds of = memory->bounds[place ? place : 1];
        const int is_clear = group_is_clear(tree, &block, place > 0, lights->rows + (size_t)node * NODE_SIZE,
                                            lights->placed + SEGMENT_SIZE * of.place, of.count, margin, &cut.culprit,
                                            memory);
        if (place) {
            keep_test(&cut, is_clear, level_of(node));
            tested = node;
        }
#endif
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    return cut;
}

#endif
