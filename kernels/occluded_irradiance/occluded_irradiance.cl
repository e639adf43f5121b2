// Irradiance of the receivers of a sensor strip from all lit segments, with occlusion, and the strip's two currents.
//
// E = sum over segments of the closed form of line_irradiance.h, over the part of each segment that is visible from the
// receiver. The currents are sums of E times two weights per receiver.
//
// Inputs:  receivers (strips, each, 6) position [m] and normal; weights (strips, each, 2); segments (n, 10) start, end,
//          surface normal, exitance [W/m2]; with SELECTED also starts (lists + 1) and selected, the segments of each list
//          (list: SELECTION_BLOCK receivers; a pick ~k is segment k, which no surface can hide).
// Outputs: irradiance (strips, each) [W/m2]; left, right (strips,); status (strips, each) flags.
// Options: INPUT (type of the inputs), REAL_IS_DOUBLE, DOUBLE_POSITIONS or, in the work-item variant,
//          TWO_FLOAT_POSITIONS (common/places.h), SELECTED, GROUP (size of a work-group), BVH_DEPTH;
//          INTERVALS (exact visibility, visible.h), CONVEX_PARTS (INTERVALS in the vector variant: some leaves belong to
//          convex parts), RAYS (shadow rays to `samples` parts of a segment); without both:
//          no occlusion.
// Variants: vector: strips in turn for each work-item, 16 receivers in a vector (receiver_blocks.h); work-item: a
//          work-group per strip, a pair of a receiver and a segment per item (lit_pairs.h).

// Number of receivers that share a list of picked segments.
#define SELECTION_BLOCK 16
#include "common/team.h"
#ifdef VECTOR_VARIANT
#include "occluded_irradiance/receiver_blocks.h"
#else
#include "occluded_irradiance/lit_pairs.h"
#endif

#ifdef VECTOR_VARIANT
AS_IT_IS kernel void occluded_irradiance(
    global const INPUT *restrict receivers, global const INPUT *restrict weights, global const INPUT *restrict segments,
#ifdef SELECTED
    global const int *restrict starts, global const int *restrict selected,
#endif
    global real *restrict irradiance, global real *restrict left, global real *restrict right,
    global uchar *restrict status, global const real *nodes, global const int *children, global const int *axes,
    global const real *leaves, global const int *triangles,
#ifdef CONVEX_PARTS
    global const real *restrict parts,
#endif
    constant place *middle, const real clearance, const uint samples, const uint each, const uint segment_count, const uint pick_count, const uint strips TEAM_ARGUMENTS
) {
    bvh_tree tree = {nodes, children, axes, leaves, triangles};
#ifdef CONVEX_PARTS
    tree.parts = parts;
#endif
    const ulong groups = ITEM_COLUMNS;
    const uint of_strip = (each + LANES - 1) / LANES; // blocks of a strip
    FOR_EACH_ITEM(item) {
        // Strips group, group + groups, ...: neighbouring strips need about the same time, so all groups do. (PoCL gives
        // half of the groups to the first of two workers at once: with contiguous strips, a scene with parts on one side
        // took 1.65 times as long.)
        const ulong group = item.x, end_block = (strips - group + groups - 1) / groups * of_strip;
        chunk lit;
        block blocks[BATCH];
        packet packed;
        packed.count = 0;
        pieces waiting;
        waiting.count = 0;
        place to_left = 0, to_right = 0;
        int loaded = -1; // first segment of the chunk that is loaded
        for (ulong begin = 0; begin < end_block; begin += BATCH) {
            const uint count = (uint)min((ulong)BATCH, end_block - begin);
            uchar flag = STATUS_OK;
            for (uint n = 0; n < count; n++) {
                const uint first = (begin + n) % of_strip * LANES;
                const ulong row = ((begin + n) / of_strip * groups + group) * each + first;
                const ulong present = (ulong)strips * each - row;
                load_block(receivers + 6 * row, middle, min((uint)LANES, each - first), present, blocks + n);
            }
#ifdef SELECTED
            const ulong list = (begin / of_strip * groups + group) * of_strip + begin % of_strip;
            if (starts[list] < 0 || starts[list + 1] > (int)pick_count) flag |= STATUS_OUT_OF_RANGE;
            const int end = min(starts[list + 1], (int)pick_count);
            for (int next = max(starts[list], 0); next < end;) {
                next = load_selected(segments, selected, next, end, segment_count, middle, &lit, &flag);
                light_chunk(&tree, &lit, clearance, samples, blocks, count, &packed, &waiting, &flag);
            }
#else
            for (int next = 0; next < (int)segment_count; next += SEGMENTS) {
                if (loaded != next) load_from(segments, next, (int)segment_count, middle, &lit);
                loaded = next;
                light_chunk(&tree, &lit, clearance, samples, blocks, count, &packed, &waiting, &flag);
            }
#endif
            finish(&waiting);
            for (uint n = 0; n < count; n++) {
                const uint first = (begin + n) % of_strip * LANES;
                const ulong strip = (begin + n) / of_strip * groups + group, row = strip * each + first;
                if (first == 0) to_left = 0, to_right = 0;
                store_block(blocks + n, flag, irradiance + row, status + row, weights + 2 * row, &to_left, &to_right);
                if (first + LANES >= each) left[strip] = (real)to_left, right[strip] = (real)to_right;
            }
        }
    }
}
#else
kernel void occluded_irradiance(
    global const INPUT *restrict receivers, global const INPUT *restrict weights, global const INPUT *restrict segments,
#ifdef SELECTED
    global const int *restrict starts, global const int *restrict selected,
#endif
    global real *restrict irradiance, global real *restrict left, global real *restrict right,
    global uchar *restrict status, global const real *nodes, global const int *children, global const int *axes,
    global const real *leaves, global const int *triangles, constant place *middle, const real clearance,
    const uint samples, const uint each, const uint segment_count, const uint pick_count, const uint strips
) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong strip = get_group_id(0);
    const uint item = get_local_id(0);
    local pair_memory memory;
    places to_left = convert_places(0), to_right = convert_places(0);
    for (uint first = 0; first < each; first += BLOCK) {
        const ulong row = strip * each + first;
        const uint receiver_count = min((uint)BLOCK, each - first);
        if (item < receiver_count) load_receiver(receivers + 6 * (row + item), middle, item, &memory);
        places sum = convert_places(0);
        uchar flag = STATUS_OK, unclear = 0;
#ifdef SELECTED
        const ulong list = strip * ((each + SELECTION_BLOCK - 1) / SELECTION_BLOCK) + first / SELECTION_BLOCK;
        if (starts[list] < 0 || starts[list + 1] > (int)pick_count) flag |= STATUS_OUT_OF_RANGE;
        const int begin = max(starts[list], 0), end = min(starts[list + 1], (int)pick_count);
#else
        const int begin = 0, end = (int)segment_count;
#endif
        for (int next = begin; next < end; next += TILE) {
            barrier(CLK_LOCAL_MEM_FENCE);
            const int own = next + (int)item;
            uint facing = 0, wrong = 0, all;
#ifdef SELECTED
            const int pick = own < end ? selected[own] : 0;
#else
            const int pick = own;
#endif
            if (own < end)
                facing = facing_receivers(segments, pick, segment_count, middle, receiver_count, &memory, &wrong);
            memory.counts[item] = popcount(facing) + wrong;
            barrier(CLK_LOCAL_MEM_FENCE);
            const uint place_in_list = PAIRS_OF(counts_before(memory.counts, &all));
            list_pairs(facing, place_in_list, &memory);
            barrier(CLK_LOCAL_MEM_FENCE);
            memory.counts[item] = place_in_list << 16 | facing;
            for (uint pair = item; pair < PAIRS_OF(all); pair += GROUP)
                memory.list[pair] = light_of((uint)memory.list[pair], &tree, clearance, samples, &memory);
            if (BAD_OF(all)) flag |= STATUS_NOT_FINITE;
            if (BEYOND_OF(all)) flag |= STATUS_OUT_OF_RANGE;
            barrier(CLK_LOCAL_MEM_FENCE);
            sum = add_share(&memory, sum, &unclear);
        }
        memory.sums[item] = as_place(sum), memory.unclear[item] = unclear;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < receiver_count) {
            const ulong at = row + item;
            const places light = store_result(&memory, flag, irradiance + at, status + at);
            if (!memory.is_none[item]) {
                to_left = places_plus(to_left, places_times(light, input_places(weights[2 * at])));
                to_right = places_plus(to_right, places_times(light, input_places(weights[2 * at + 1])));
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (item < BLOCK) memory.currents[2 * item] = as_place(to_left), memory.currents[2 * item + 1] = as_place(to_right);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item) return;
    for (uint n = 1; n < BLOCK; n++) {
        to_left = places_plus(to_left, load_place(memory.currents[2 * n]));
        to_right = places_plus(to_right, load_place(memory.currents[2 * n + 1]));
    }
    left[strip] = real_of(to_left), right[strip] = real_of(to_right);
}
#endif
