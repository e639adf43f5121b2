// Lit segments in structure-of-arrays form, grouped by the line on which they lie.
//
// For the vector variant. Segments on one line, such as the segments of a sheet of light on a board between its parts,
// share one visibility traversal.
#ifndef LIT_LINES_H
#define LIT_LINES_H
#include "common/places.h"
#include "common/status.h"
#include "occluded_irradiance/visible.h"

// Relative tolerance of "on one line": distances from the line over coordinates, and differences of unit vectors.
#define LINE_SLACK ((real)8 * (real)REAL_EPSILON)

// Number of segments that are processed together.
#define SEGMENTS 32

// Starts and frames of segments: `along` the segment, `off` normal to its surface, `across` both.
typedef struct {
    place x[SEGMENTS], y[SEGMENTS], z[SEGMENTS], along_x[SEGMENTS], along_y[SEGMENTS], along_z[SEGMENTS];
    place off_x[SEGMENTS], off_y[SEGMENTS], off_z[SEGMENTS], across_x[SEGMENTS], across_y[SEGMENTS], across_z[SEGMENTS];
    place length[SEGMENTS];
} frames;

// Segments that are processed together, and their lines, each from its first to its last segment. Sets of segments are
// bit masks.
typedef struct {
    frames each, lines;
    real exitance[SEGMENTS];             // exitance / (2 pi)
    real begin[SEGMENTS], end[SEGMENTS]; // position of a segment on its line, which runs from 0 to 1
    uint members[SEGMENTS];              // set of segments of a line
    uint lit, unseen, is_good; // segments that emit; segments that no surface can hide; whether all numbers are finite
    int line_count;
} chunk;

// Load the frames of LANES segments from `first` on, by their indices; repeat the last one to fill the lanes.
static inline void load_frames(global const INPUT *rows, const uint *numbers, uint count, uint first, constant place *middle,
                 chunk *all) {
    place at[10][LANES];
    for (uint lane = 0; lane < LANES; lane++) {
        global const INPUT *row = rows + 10 * (ulong)numbers[min(first + lane, count - 1)];
        for (int k = 0; k < 3; k++) at[k][lane] = (place)row[k] - middle[k];
        for (int k = 3; k < 6; k++) at[k][lane] = (place)row[k] - (place)row[k - 3];
        for (int k = 6; k < 10; k++) at[k][lane] = row[k];
    }
    const places x = load_places(at[0]), y = load_places(at[1]), z = load_places(at[2]), zero = (places)0;
    places ux = load_places(at[3]), uy = load_places(at[4]), uz = load_places(at[5]);
    places nx = load_places(at[6]), ny = load_places(at[7]), nz = load_places(at[8]);
    const places square = ux * ux + uy * uy + uz * uz, lean = ux * nx + uy * ny + uz * nz;
    nx = square * nx - lean * ux, ny = square * ny - lean * uy, nz = square * nz - lean * uz;
    const places size = fabs(nx) + fabs(ny) + fabs(nz);
    const reals exitance = convert_to_reals(load_places(at[9]) * (place)0.15915494309189533577);
    const masks emits = mask_of(exitance > (reals)0) & mask_of_places(square > zero);
    const masks bad = LANED(not_finite)(convert_to_reals(x + y + z)) | LANED(not_finite)(convert_to_reals(square + size)) |
                      LANED(not_finite)(exitance) | (emits & mask_of_places(size == zero));
    const uint present = (uint)((1ul << min((uint)LANES, count - first)) - 1);
    all->is_good &= !(lane_bits(bad) & present);
    all->lit |= (lane_bits(emits & ~bad) & present) << first;
    const places length = sqrt(square), per = (place)1 / length;
    const places per_size = (place)1 / sqrt(nx * nx + ny * ny + nz * nz);
    ux *= per, uy *= per, uz *= per, nx *= per_size, ny *= per_size, nz *= per_size;
    frames *to = &all->each;
    store_places(x, to->x + first), store_places(y, to->y + first), store_places(z, to->z + first);
    store_places(ux, to->along_x + first), store_places(uy, to->along_y + first), store_places(uz, to->along_z + first);
    store_places(nx, to->off_x + first), store_places(ny, to->off_y + first), store_places(nz, to->off_z + first);
    store_places(uy * nz - uz * ny, to->across_x + first), store_places(uz * nx - ux * nz, to->across_y + first);
    store_places(ux * ny - uy * nx, to->across_z + first), store_places(length, to->length + first);
    store_private(exitance, all->exitance + first);
}

// Absolute difference of a component of LANES segments from the component of segment `one`.
static inline reals change_of(const place *component, uint first, int one) {
    return fabs(convert_to_reals(load_places(component + first) - component[one]));
}

// Set of segments that lie on the line of segment `one`, have its direction, and emit on the same side.
static inline uint on_line_of(const frames *each, int one, uint last) {
    const place x = each->x[one], y = each->y[one], z = each->z[one];
    const place ux = each->along_x[one], uy = each->along_y[one], uz = each->along_z[one];
    const real slack = LINE_SLACK * (real)(fabs(x) + fabs(y) + fabs(z) + each->length[one]);
    uint found = 0;
    for (uint first = 0; first < last; first += LANES) {
        const places dx = load_places(each->x + first) - x, dy = load_places(each->y + first) - y;
        const places dz = load_places(each->z + first) - z, at = dx * ux + dy * uy + dz * uz;
        const reals off_x = fabs(convert_to_reals(dx - at * ux)), off_y = fabs(convert_to_reals(dy - at * uy));
        const reals off_z = fabs(convert_to_reals(dz - at * uz));
        masks is_on = mask_of(off_x <= slack) & mask_of(off_y <= slack) & mask_of(off_z <= slack);
        const reals length = convert_to_reals(load_places(each->length + first));
        is_on &= mask_of(length * change_of(each->along_x, first, one) <= slack) &
                 mask_of(length * change_of(each->along_y, first, one) <= slack) &
                 mask_of(length * change_of(each->along_z, first, one) <= slack) &
                 mask_of(change_of(each->off_x, first, one) <= LINE_SLACK) &
                 mask_of(change_of(each->off_y, first, one) <= LINE_SLACK) &
                 mask_of(change_of(each->off_z, first, one) <= LINE_SLACK);
        found |= lane_bits(is_on) << first;
    }
    return found;
}

// Append the line from the first to the last of its member segments.
static inline void add_line(chunk *all, uint members) {
    const frames *each = &all->each;
    const int one = lowest_bit(members), n = all->line_count++;
    const place ux = each->along_x[one], uy = each->along_y[one], uz = each->along_z[one];
    place low = 0, high = each->length[one], at[SEGMENTS];
    for (uint left = members; left; left &= left - 1) {
        const int k = lowest_bit(left);
        at[k] = (each->x[k] - each->x[one]) * ux + (each->y[k] - each->y[one]) * uy + (each->z[k] - each->z[one]) * uz;
        low = fmin(low, at[k]), high = fmax(high, at[k] + each->length[k]);
    }
    const place length = high - low;
    for (uint left = members; left; left &= left - 1) {
        const int k = lowest_bit(left);
        all->begin[k] = (real)((at[k] - low) / length), all->end[k] = (real)((at[k] + each->length[k] - low) / length);
    }
    frames *to = &all->lines;
    to->x[n] = each->x[one] + low * ux, to->y[n] = each->y[one] + low * uy, to->z[n] = each->z[one] + low * uz;
    to->along_x[n] = ux, to->along_y[n] = uy, to->along_z[n] = uz, to->length[n] = length;
    to->off_x[n] = each->off_x[one], to->off_y[n] = each->off_y[one], to->off_z[n] = each->off_z[one];
    to->across_x[n] = each->across_x[one], to->across_y[n] = each->across_y[one];
    to->across_z[n] = each->across_z[one];
    all->members[n] = members;
}

static inline void load_chunk(global const INPUT *rows, const uint *numbers, uint count, constant place *middle, chunk *all) {
    all->lit = 0, all->line_count = 0, all->is_good = 1;
    for (uint first = 0; first < count; first += LANES) load_frames(rows, numbers, count, first, middle, all);
    for (uint left = all->lit; left;) {
        const uint lowest = left & -left;
        const uint alike = (lowest & all->unseen) ? 0 : on_line_of(&all->each, lowest_bit(left), count) & ~all->unseen;
        const uint members = (alike & left) | lowest;
        add_line(all, members);
        left &= ~members;
    }
}

#ifdef SELECTED
// Load picked segments from pick `next` on; return the next pick.
static inline int load_selected(global const INPUT *rows, global const int *selected, int next, int end, uint segment_count,
                constant place *middle, chunk *all, uchar *flag) {
    uint numbers[SEGMENTS], count = 0;
    all->unseen = 0;
    for (; next < end && count < SEGMENTS; next++) {
        const int is_unseen = selected[next] < 0;
        const uint number = is_unseen ? ~selected[next] : selected[next];
        if (number >= segment_count) {
            *flag |= STATUS_OUT_OF_RANGE;
            continue;
        }
        if (is_unseen) all->unseen |= 1u << count;
        numbers[count++] = number;
    }
    load_chunk(rows, numbers, count, middle, all);
    return next;
}
#else
static inline void load_from(global const INPUT *rows, int first, int end, constant place *middle, chunk *all) {
    uint numbers[SEGMENTS];
    const uint count = (uint)min(SEGMENTS, end - first);
    for (uint n = 0; n < count; n++) numbers[n] = (uint)first + n;
    all->unseen = 0;
    load_chunk(rows, numbers, count, middle, all);
}
#endif

#endif
