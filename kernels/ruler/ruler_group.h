// Measurement of rulers by a work-group (ruler.h, work-item variant).
//
// The RULER_GROUP items share RULERS_PER_GROUP rulers: item n works on ruler n % RULERS_PER_GROUP, on every
// RULER_ITEMS-th of its samples. Sample i of ruler r is number i * RULERS_PER_GROUP + r of an array in local memory:
// neighbouring items access neighbouring words, in different banks. The first RULERS_PER_GROUP items, neighbours in a
// warp, compute the parameters of one edge each.
//
// The items search for edges together and find the edges of the sequential search (ruler_find in ruler.h). The
// choice of a single edge depends on its gradient and the two neighbours. The choice of a pair also depends on the peak
// before it: each peak is a bit, and the peak before gradient i is the highest bit below i. Atomic minima and maxima of integers, whose results do not
// depend on the order of the items, join the choices. (The bits of a float above 0, read as an integer, have the order
// of the float.)
//
// Options: RULERS_PER_GROUP: a power of two; RULER_GROUP: a multiple of it.
#ifndef RULER_GROUP_H
#define RULER_GROUP_H

#define RULER_ITEMS (RULER_GROUP / RULERS_PER_GROUP)
#define RULER_WORDS (RULER_CAPACITY / 32) // a bit for each gradient

// Local memory of a work-group.
typedef struct {
    real profile[RULER_CAPACITY * RULERS_PER_GROUP];
    real slopes[RULER_SLOPES_CAPACITY * RULERS_PER_GROUP];
#ifdef PAIRS
    uint peaks[RULER_WORDS * RULERS_PER_GROUP];
#endif
#ifdef CHOOSE_ALL
    uint candidates[RULER_WORDS * RULERS_PER_GROUP];
#endif
    int flags[RULERS_PER_GROUP];
    int strength[RULERS_PER_GROUP], at[RULERS_PER_GROUP], rival[RULERS_PER_GROUP]; // of the chosen candidate
#ifdef CHOOSE_STRONGEST
    real best[RULER_GROUP], second[RULER_GROUP]; // strengths among the samples of each item
    int best_at[RULER_GROUP];
#endif
} ruler_memory;

// Ruler of this item in its group, and number of the item among the items of the ruler.
static inline int ruler_of_item(void) { return (int)get_local_id(0) % RULERS_PER_GROUP; }
static inline int ruler_lane(void) { return (int)get_local_id(0) / RULERS_PER_GROUP; }

// Split (x, y) into a pixel that has neighbours and the fraction within it.
static inline int ruler_split(private const ruler_place *place, int pitch, real *x, real *y) {
    const int column = min((int)*x, place->last_column), row = min((int)*y, place->last_row);
    *x -= column;
    *y -= row;
    return place->pixel + row * pitch + column;
}

static inline real ruler_bilinear(real a, real b, real c, real d, real x, real y) {
    a += x * (b - a);
    c += x * (d - c);
    return a + y * (c - a);
}

static inline real ruler_sum(global const CODE *image, private const ruler_place *place, int pitch, int i,
                             constant real *table, constant real *model, int *flags) {
    real sum = 0;
    for (int line = 0; line < WIDTH; line++) {
        real x = place->x + i * place->along_x + line * place->across_x;
        real y = place->y + i * place->along_y + line * place->across_y;
#if defined(LENS) || defined(CAMERA)
        *flags |= ruler_distort(&x, &y, place, model);
#endif
        global const CODE *pixel = image + ruler_split(place, pitch, &x, &y);
        const real sample = ruler_bilinear(pixel[0], pixel[1], pixel[pitch], pixel[pitch + 1], x, y);
        *flags |= ruler_sample_flags(sample, table);
        sum += sample;
    }
    *flags |= ruler_sum_flags(sum);
    return sum;
}

static inline real ruler_slope(local const real *profile, int i, constant real *table) {
    real slope = 0;
    for (int k = 1; k <= TAPS; k++)
        slope += table[RULER_TAPS + k - 1] *
                 (profile[(i + TAPS + k) * RULERS_PER_GROUP] - profile[(i + TAPS - k) * RULERS_PER_GROUP]);
    return slope;
}

// Compute the profiles and the gradients of the rulers of a group; `flags`: of the layout of this item's ruler.
static inline void ruler_gradients(global const CODE *image, int columns, private const ruler_place *place, int flags,
                                   constant real *table, constant real *model, local ruler_memory *shared) {
    const int ruler = ruler_of_item(), lane = ruler_lane(), length = (int)table[RULER_LENGTH];
    if (lane == 0) {
        shared->flags[ruler] = flags;
        shared->strength[ruler] = shared->rival[ruler] = 0;
#ifdef CHOOSE_LAST
        shared->at[ruler] = 0;
#else
        shared->at[ruler] = INT_MAX;
#endif
    }
    // The first item of a ruler may still read the bits of a measurement before: clear them after the barrier.
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int word = lane; word < RULER_WORDS; word += RULER_ITEMS) {
#ifdef PAIRS
        shared->peaks[word * RULERS_PER_GROUP + ruler] = 0;
#endif
#ifdef CHOOSE_ALL
        shared->candidates[word * RULERS_PER_GROUP + ruler] = 0;
#endif
    }
    int found = 0;
    for (int i = lane; i < length; i += RULER_ITEMS)
        shared->profile[i * RULERS_PER_GROUP + ruler] = ruler_sum(image, place, columns, i, table, model, &found);
    if (found) atomic_or(shared->flags + ruler, found);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = lane; i < length - 2 * TAPS; i += RULER_ITEMS)
        shared->slopes[i * RULERS_PER_GROUP + ruler] = ruler_slope(shared->profile + ruler, i, table);
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Gradient i of this item's ruler, and its neighbours.
static inline ruler_peak ruler_peak_at(local const ruler_memory *shared, int i) {
    local const real *slope = shared->slopes + i * RULERS_PER_GROUP + ruler_of_item();
    return (ruler_peak){i, slope[-RULERS_PER_GROUP], slope[0], slope[RULERS_PER_GROUP]};
}

// Whether gradient i of this item's ruler is a peak, and its strength.
static inline int ruler_finds_peak(local const ruler_memory *shared, int i, private const ruler_place *place,
                                   constant real *table, private real *strength) {
    const ruler_peak peak = ruler_peak_at(shared, i);
    *strength = ruler_strength(peak.here, place);
    return ruler_is_peak(*strength, ruler_strength(peak.before, place), ruler_strength(peak.after, place),
                         table[RULER_THRESHOLD]) != 0;
}

#if defined(PAIRS) || defined(CHOOSE_ALL)
static inline void ruler_mark(local uint *bits_of_rulers, int i) {
    atomic_or(bits_of_rulers + i / 32 * RULERS_PER_GROUP + ruler_of_item(), 1u << i % 32);
}
#endif

#ifdef PAIRS
// Mark the peaks among the gradients of the rulers of a group.
static inline void ruler_mark_peaks(private const ruler_place *place, constant real *table, local ruler_memory *shared) {
    const int slopes = (int)table[RULER_LENGTH] - 2 * TAPS;
    real strength;
    for (int i = 1 + ruler_lane(); i < slopes - 1; i += RULER_ITEMS)
        if (ruler_finds_peak(shared, i, place, table, &strength)) ruler_mark(shared->peaks, i);
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Index of the last peak before gradient i, or 0 if no peak lies before it (gradient 0 is never a peak).
static inline int ruler_index_before(local const ruler_memory *shared, int i) {
    local const uint *peaks = shared->peaks + ruler_of_item();
    int index = 0;
    for (int word = 0; word <= i / 32; word++) {
        const uint set = peaks[word * RULERS_PER_GROUP] & (word < i / 32 ? ~0u : (1u << i % 32) - 1);
        index = set ? 32 * word + 31 - (int)clz(set) : index;
    }
    return index;
}
#endif

// Peak before gradient i: the first edge of a pair.
static inline ruler_peak ruler_peak_before(local const ruler_memory *shared, int i) {
#ifdef PAIRS
    const int before = ruler_index_before(shared, i);
    if (before) return ruler_peak_at(shared, before);
#endif
    return (ruler_peak){0, 0, 1, 0};
}

// Whether gradient i is an edge, or the second edge of a pair, and its strength.
static inline int ruler_is_candidate(local const ruler_memory *shared, int i, private const ruler_place *place,
                                     constant real *table, private real *strength) {
    if (!ruler_finds_peak(shared, i, place, table, strength)) return 0;
#ifdef PAIRS
    const ruler_peak from = ruler_peak_before(shared, i), peak = ruler_peak_at(shared, i);
    return ruler_closes(from, mask_of(from.at > 0), peak, place, table, strength) != 0;
#else
    return 1;
#endif
}

#ifdef CHOOSE_ALL
// Mark the edges of the rulers of a group.
static inline void ruler_mark_candidates(private const ruler_place *place, constant real *table,
                                         local ruler_memory *shared) {
    const int slopes = (int)table[RULER_LENGTH] - 2 * TAPS;
    real strength;
    for (int i = 1 + ruler_lane(); i < slopes - 1; i += RULER_ITEMS)
        if (ruler_is_candidate(shared, i, place, table, &strength)) ruler_mark(shared->candidates, i);
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Number of edges of this item's ruler before gradient i.
static inline int ruler_edges_before(local const ruler_memory *shared, int i) {
    local const uint *candidates = shared->candidates + ruler_of_item();
    int count = popcount(candidates[i / 32 * RULERS_PER_GROUP] & ((1u << i % 32) - 1));
    for (int word = 0; word < i / 32; word++) count += popcount(candidates[word * RULERS_PER_GROUP]);
    return count;
}
#else
// Choose among the edges of the rulers of a group: shared->at becomes the index of the chosen gradient.
static inline void ruler_choose(private const ruler_place *place, constant real *table, local ruler_memory *shared) {
    const int slopes = (int)table[RULER_LENGTH] - 2 * TAPS, ruler = ruler_of_item();
    real best = 0, second = 0, strength;
    int at = 0;
    for (int i = 1 + ruler_lane(); i < slopes - 1; i += RULER_ITEMS) {
        if (!ruler_is_candidate(shared, i, place, table, &strength)) continue;
#if defined(CHOOSE_FIRST)
        at = at ? at : i;
#elif defined(CHOOSE_LAST)
        at = i;
#else
        const int wins = strength > best;
        second = wins ? best : fmax(second, strength);
        best = wins ? strength : best;
        at = wins ? i : at;
#endif
    }
#if defined(CHOOSE_FIRST)
    if (at) atomic_min(shared->at + ruler, at);
#elif defined(CHOOSE_LAST)
    atomic_max(shared->at + ruler, at);
#else
    // The strongest edge, of equal ones the first. PoCL 3.1 loses private values at a barrier if the caller measures in
    // a loop (blob): each item keeps its choice in local memory.
    const int item = (int)get_local_id(0);
    shared->best[item] = best;
    shared->second[item] = second;
    shared->best_at[item] = at;
    if (at) atomic_max(shared->strength + ruler, as_int(best));
    barrier(CLK_LOCAL_MEM_FENCE);
    if (shared->best_at[item] && as_int(shared->best[item]) == shared->strength[ruler])
        atomic_min(shared->at + ruler, shared->best_at[item]);
#ifdef AMBIGUITY
    barrier(CLK_LOCAL_MEM_FENCE);
    const real rival = shared->best_at[item] == shared->at[ruler] ? shared->second[item] : shared->best[item];
    atomic_max(shared->rival + ruler, as_int(rival));
#endif
#endif
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Measure the rulers of a group, of given layouts with their flags: a result for each of the first RULERS_PER_GROUP items.
static inline ruler_edge ruler_measure_placed(global const CODE *image, int columns, private const ruler_place *place,
                                              int flags, constant real *table, constant real *model,
                                              local ruler_memory *shared) {
    ruler_gradients(image, columns, place, flags, table, model, shared);
#ifdef PAIRS
    ruler_mark_peaks(place, table, shared);
#endif
    ruler_choose(place, table, shared);
    ruler_edge edge = {REAL_NAN, REAL_NAN, REAL_NAN, REAL_NAN, REAL_NAN, 0};
    if (ruler_lane() > 0) return edge;
    const int ruler = ruler_of_item(), at = shared->at[ruler], found = at > 0 && at < INT_MAX;
    if (found) edge = ruler_edge_at(ruler_peak_before(shared, at), ruler_peak_at(shared, at), place, table);
#ifdef AMBIGUITY
    if (as_real(shared->rival[ruler]) >= table[RULER_AMBIGUITY] * as_real(shared->strength[ruler]))
        edge.status |= STATUS_AMBIGUOUS;
#endif
    return ruler_flagged(edge, mask_of(found), shared->flags[ruler]);
}

// Measure rulers (x, y, cos, sin) by a group: item n gives ruler n % RULERS_PER_GROUP.
static inline ruler_edge ruler_measure(global const CODE *image, int rows, int columns, real4 ruler, constant real *table,
                                       constant real *model, local ruler_memory *shared) {
    ruler_place place;
    const int flags = ruler_layout(rows, columns, ruler.x, ruler.y, ruler.z, ruler.w, table, &place);
    return ruler_measure_placed(image, columns, &place, flags, table, model, shared);
}
#endif
#endif
