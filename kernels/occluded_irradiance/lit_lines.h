// Lit segments by columns, and the lines on which they lie: segments of one line, like those of a sheet of light on a
// board between its parts, are looked at together.
#ifndef LIT_LINES_H
#define LIT_LINES_H
#include "occluded_irradiance/places.h"
#include "common/status.h"
#include "occluded_irradiance/visible.h"

// Of places, how far they may be off a line; of unit normals, by how much they may differ.
#define LINE_SLACK ((real)8 * (real)REAL_EPSILON)

#ifdef VECTOR_VARIANT
// Segments that are taken together.
#define SEGMENTS 32
#define LOAD_PLACES(from) (*(const places_at *)(from))
#define narrow convert_real16
#define STORE_LANES(value, to) (*(reals_at *)(to) = (value))
#define LOAD_LANES(from) (*(const reals_at *)(from))
#define STORE_PLACES(value, to) (*(places_at *)(to) = (value))
#define NARROW_MASK(comparison) convert_bits16(comparison)
#define lanes_of lane_bits
#else
#define SEGMENTS 1
#define LOAD_PLACES(from) (*(from))
#define narrow convert_real
#define STORE_LANES(value, to) (*(to) = (value))
#define LOAD_LANES(from) (*(from))
#define STORE_PLACES(value, to) (*(to) = (value))
#define NARROW_MASK(comparison) (-(bits)(comparison))
#define lanes_of(mask) ((mask) ? 1u : 0u)
#endif

// Starts and frames of segments, `off` being the normals of their surfaces.
typedef struct {
    place x[SEGMENTS], y[SEGMENTS], z[SEGMENTS], along_x[SEGMENTS], along_y[SEGMENTS], along_z[SEGMENTS];
    place off_x[SEGMENTS], off_y[SEGMENTS], off_z[SEGMENTS], across_x[SEGMENTS], across_y[SEGMENTS], across_z[SEGMENTS];
    place length[SEGMENTS];
} frames;

// Segments that are taken together, and the lines on which they lie, each from the first to the last of its segments.
// Sets are bits.
typedef struct {
    frames each, lines;
    real exitance[SEGMENTS];             // over 2 pi
    real begin[SEGMENTS], end[SEGMENTS]; // of a segment, on its line from 0 to 1
    uint members[SEGMENTS];              // of a line
    uint lit, unseen, is_good;
    int line_count;
} chunk;

// Frames of LANES segments from `first` on, by their numbers; the last again where there are fewer.
void load_frames(global const INPUT *rows, const uint *numbers, uint count, uint first, constant place *middle,
                 chunk *all) {
    place at[10][LANES];
    for (uint lane = 0; lane < LANES; lane++) {
        global const INPUT *row = rows + 10 * (ulong)numbers[min(first + lane, count - 1)];
        for (int k = 0; k < 3; k++) at[k][lane] = (place)row[k] - middle[k];
        for (int k = 3; k < 6; k++) at[k][lane] = (place)row[k] - (place)row[k - 3];
        for (int k = 6; k < 10; k++) at[k][lane] = row[k];
    }
    const places x = LOAD_PLACES(at[0]), y = LOAD_PLACES(at[1]), z = LOAD_PLACES(at[2]), zero = (places)0;
    places ux = LOAD_PLACES(at[3]), uy = LOAD_PLACES(at[4]), uz = LOAD_PLACES(at[5]);
    places nx = LOAD_PLACES(at[6]), ny = LOAD_PLACES(at[7]), nz = LOAD_PLACES(at[8]);
    const places square = ux * ux + uy * uy + uz * uz, lean = ux * nx + uy * ny + uz * nz;
    nx = square * nx - lean * ux, ny = square * ny - lean * uy, nz = square * nz - lean * uz;
    const places size = fabs(nx) + fabs(ny) + fabs(nz);
    const reals exitance = narrow(LOAD_PLACES(at[9]) * (place)0.15915494309189533577);
    const masks emits = mask_of(exitance > (reals)0) & NARROW_MASK(square > zero);
    const masks bad = LANED(not_finite)(narrow(x + y + z)) | LANED(not_finite)(narrow(square + size)) |
                      LANED(not_finite)(exitance) | (emits & NARROW_MASK(size == zero));
    const uint present = (uint)((1ul << min((uint)LANES, count - first)) - 1);
    all->is_good &= !(lanes_of(bad) & present);
    all->lit |= (lanes_of(emits & ~bad) & present) << first;
    const places length = sqrt(square), per = (place)1 / length;
    const places per_size = (place)1 / sqrt(nx * nx + ny * ny + nz * nz);
    ux *= per, uy *= per, uz *= per, nx *= per_size, ny *= per_size, nz *= per_size;
    frames *to = &all->each;
    STORE_PLACES(x, to->x + first), STORE_PLACES(y, to->y + first), STORE_PLACES(z, to->z + first);
    STORE_PLACES(ux, to->along_x + first), STORE_PLACES(uy, to->along_y + first), STORE_PLACES(uz, to->along_z + first);
    STORE_PLACES(nx, to->off_x + first), STORE_PLACES(ny, to->off_y + first), STORE_PLACES(nz, to->off_z + first);
    STORE_PLACES(uy * nz - uz * ny, to->across_x + first), STORE_PLACES(uz * nx - ux * nz, to->across_y + first);
    STORE_PLACES(ux * ny - uy * nx, to->across_z + first), STORE_PLACES(length, to->length + first);
    STORE_LANES(exitance, all->exitance + first);
}

// Which segments lie on the line of one, run the same way, and are lit on the same side.
uint on_line_of(const frames *each, int one, uint last) {
    const place x = each->x[one], y = each->y[one], z = each->z[one];
    const place ux = each->along_x[one], uy = each->along_y[one], uz = each->along_z[one];
    const real slack = LINE_SLACK * (real)(fabs(x) + fabs(y) + fabs(z) + each->length[one]);
    uint found = 0;
    for (uint first = 0; first < last; first += LANES) {
        const places dx = LOAD_PLACES(each->x + first) - x, dy = LOAD_PLACES(each->y + first) - y;
        const places dz = LOAD_PLACES(each->z + first) - z, at = dx * ux + dy * uy + dz * uz;
        const reals off_x = fabs(narrow(dx - at * ux)), off_y = fabs(narrow(dy - at * uy));
        const reals off_z = fabs(narrow(dz - at * uz));
        masks is_on = mask_of(off_x <= slack) & mask_of(off_y <= slack) & mask_of(off_z <= slack);
        const reals length = narrow(LOAD_PLACES(each->length + first));
#define TURNED(name) fabs(narrow(LOAD_PLACES(each->name + first) - each->name[one]))
        is_on &= mask_of(length * TURNED(along_x) <= slack) & mask_of(length * TURNED(along_y) <= slack) &
                 mask_of(length * TURNED(along_z) <= slack) & mask_of(TURNED(off_x) <= LINE_SLACK) &
                 mask_of(TURNED(off_y) <= LINE_SLACK) & mask_of(TURNED(off_z) <= LINE_SLACK);
#undef TURNED
        found |= lanes_of(is_on) << first;
    }
    return found;
}

// The line from the first to the last of its members.
void add_line(chunk *all, uint members) {
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

void load_chunk(global const INPUT *rows, const uint *numbers, uint count, constant place *middle, chunk *all) {
    all->lit = 0, all->line_count = 0, all->is_good = 1;
    for (uint first = 0; first < count; first += LANES) load_frames(rows, numbers, count, first, middle, all);
    for (uint left = all->lit; left;) {
        const uint lowest = left & -left;
        const uint alike = lowest & all->unseen ? 0 : on_line_of(&all->each, lowest_bit(left), count) & ~all->unseen;
        const uint members = (alike & left) | lowest;
        add_line(all, members);
        left &= ~members;
    }
}

#ifdef PICKED
// Takes picks from `next` on; returns where to go on.
int load_picked(global const INPUT *rows, global const int *picks, int next, int end, uint segment_count,
                constant place *middle, chunk *all, uchar *flag) {
    uint numbers[SEGMENTS], count = 0;
    all->unseen = 0;
    for (; next < end && count < SEGMENTS; next++) {
        const int is_unseen = picks[next] < 0;
        const uint number = is_unseen ? ~picks[next] : picks[next];
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
void load_from(global const INPUT *rows, int first, int end, constant place *middle, chunk *all) {
    uint numbers[SEGMENTS];
    const uint count = (uint)min(SEGMENTS, end - first);
    for (uint n = 0; n < count; n++) numbers[n] = (uint)first + n;
    all->unseen = 0;
    load_chunk(rows, numbers, count, middle, all);
}
#endif

#endif
