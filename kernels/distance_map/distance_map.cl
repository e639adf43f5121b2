// Distance map of a field: distance to the nearest line, candidates for the nearest line, and cost, for each cell of a
// grid.
//
// The cost of a point at the cell's centre is d^2 / (c^2 + d^2), d its distance to the nearest line.
//
// Inputs:  at_x (columns,) x of the columns [m]; first_y, cell: y of the first row, and distance between rows [m];
//          scale_squared: c^2 [m2].
// Tables:  shapes (count, SHAPE): lines and arcs (field.h).
// Outputs: distance (rows, columns) float32 [m]; nearest (rows, columns, NEAREST) uint8, indices of the shapes that may
//          be nearest to a point of the cell; level (rows, columns) uint16, the cost in COST_LEVELS steps.
// Options: COST_LEVELS: the cost 1; vector variant: TILE_ROWS: rows of a work-item, MAX_SHAPES: largest count.
// Variants: vector: a work-item per TILE_ROWS rows, in tiles of LANES columns; in a tile it visits only the shapes that
//          can be among the candidates of one of its cells. Work-item: an item per cell, which visits all shapes; rows of
//          items are padded to whole work-groups.
#include "common/lanes.h"
#include "distance_map/field.h"

// Within the cell a distance differs from that at the centre by up to half the diagonal, 0.71 cell: a shape can be
// nearest somewhere only if it is at most 1.42 cell farther from the centre than the nearest one.
#define DIAGONALS 1.42f

// Distance of (x, y) to a shape: the absolute value of field_distance, in lanes.
INLINE reals shape_distance(constant float *shape, reals x, reals y) {
    const float c = shape[2], s = shape[3], radius = shape[6];
    const reals dx = x - shape[0], dy = y - shape[1];
    const reals along = c * dx + s * dy, across = fabs(c * dy - s * dx);
    if (radius == 0) {
        const reals over = fabs(along) - shape[4];
        return over > 0 ? sqrt(over * over + across * across) : across;
    }
    const reals away = sqrt(along * along + across * across);
    const reals from_end = along - radius * shape[4], beside_end = across - radius * shape[5];
    const reals end = sqrt(from_end * from_end + beside_end * beside_end);
    return along < away * shape[4] ? end : fabs(away - radius);
}

#ifdef VECTOR_VARIANT
typedef ushort16 ushorts;
#else
typedef ushort ushorts;
#endif
// Types for stores at addresses that are aligned to an element of the array only.
typedef ushorts ushorts_at __attribute__((aligned(2)));
typedef uints four_bytes_at __attribute__((aligned(1)));

// The NEAREST smallest distances and their shapes, in ascending order.
typedef struct {
    reals distance[NEAREST];
    uints shape[NEAREST];
} nearest_shapes;

static inline nearest_shapes no_shapes(void) {
    nearest_shapes list;
    for (int place = 0; place < NEAREST; place++) {
        list.distance[place] = INFINITY;
        list.shape[place] = 0;
    }
    return list;
}

// Insert a shape behind the shapes that are not farther away. A place keeps its shape, takes that of the place before, or
// the new one, by selections: a loop that ends at the right place differs from lane to lane.
INLINE void insert_shape(nearest_shapes *list, reals distance, uint shape) {
    for (int place = NEAREST - 1; place > 0; place--) {
        const reals before = list->distance[place - 1], here = list->distance[place];
        const uints shape_before = list->shape[place - 1], shape_here = list->shape[place];
        list->distance[place] = distance < before ? before : distance < here ? distance : here;
        list->shape[place] = distance < before ? shape_before : distance < here ? (uints)shape : shape_here;
    }
    list->shape[0] = distance < list->distance[0] ? (uints)shape : list->shape[0];
    list->distance[0] = distance < list->distance[0] ? distance : list->distance[0];
}

INLINE void store_cells(const nearest_shapes *list, size_t i, float cell, float scale_squared,
                        global float *restrict cell_distance, global uchar *restrict nearest,
                        global ushort *restrict level) {
    const reals distance = list->distance[0], limit = distance + DIAGONALS * cell, square = distance * distance;
    uints packed = list->shape[0]; // the first shape is the lowest byte
    for (int place = 1; place < NEAREST; place++)
        packed |= (list->distance[place] <= limit ? list->shape[place] : list->shape[0]) << (uint)(8 * place);
    const ushorts steps = LANED(convert_ushort)(square / (scale_squared + square) * (float)COST_LEVELS + 0.5f);
    store_reals(distance, cell_distance + i);
    *(global four_bytes_at *)(nearest + NEAREST * i) = packed;
    *(global ushorts_at *)(level + i) = steps;
}

#ifdef VECTOR_VARIANT
// Rounding of a distance, relative to the distance and the size of the shape, and of a coordinate: 32 units of 2^-24, for
// a dozen operations of half a unit to three units each.
#define ROUNDING 2e-6f

// Find the shapes that can be within the limit of a cell of a tile, in their order; return their number.
//
// From the tile's centre (x, y) to a cell, at most `reach` away, no distance changes by more than reach. A shape that is
// farther from the centre than the nearest one by more than 2 reach + DIAGONALS cell is beyond the limit in all cells.
static inline int shapes_of_tile(constant float *shapes, int count, float x, float y, float reach, float cell,
                                 uchar *of_tile) {
    float least[MAX_SHAPES], limit = INFINITY;
    for (int k = 0; k < count; k++) {
        constant float *shape = shapes + SHAPE * k;
        const float distance = fabs(field_distance(shape, x, y).distance);
        const float error = ROUNDING * (distance + fabs(shape[4]) + shape[6]), most = distance + error;
        least[k] = distance - error;
        limit = most < limit ? most : limit;
    }
    limit += 2 * (reach + ROUNDING * (fabs(x) + fabs(y))) + DIAGONALS * cell;
    int used = 0;
    for (int k = 0; k < count; k++) {
        of_tile[used] = (uchar)k;
        used += !(least[k] > limit); // a distance that is NaN counts
    }
    return used;
}

AS_IT_IS kernel void distance_map(global const float *restrict at_x, global float *restrict cell_distance,
                                  global uchar *restrict nearest, global ushort *restrict level, const float first_y,
                                  const float cell, constant float *shapes, const int count,
                                  const float scale_squared, const uint columns, const uint rows) {
    const uint first = get_global_id(0) * TILE_ROWS, end = min(first + TILE_ROWS, rows);
    const float half_height = 0.5f * (float)(end - 1 - first) * cell;
    for (uint next = 0; next < columns; next += LANES) {
        const uint column = (uint)whole_vector(next, columns);
        const reals x = load_reals(at_x + column);
        float low = at_x[column], high = low;
        for (uint lane = 1; lane < LANES; lane++) {
            low = at_x[column + lane] < low ? at_x[column + lane] : low;
            high = at_x[column + lane] > high ? at_x[column + lane] : high;
        }
        uchar of_tile[MAX_SHAPES];
        const float half_width = 0.5f * (high - low);
        // The last term is the rounding of the rows first_y + row * cell.
        const float reach = sqrt(half_width * half_width + half_height * half_height) + ROUNDING * fabs(first_y);
        const int used = shapes_of_tile(shapes, count, 0.5f * (low + high), first_y + (float)first * cell + half_height,
                                        reach, cell, of_tile);
        for (uint row = first; row < end; row++) {
            nearest_shapes list = no_shapes();
            for (int n = 0; n < used; n++)
                insert_shape(&list, shape_distance(shapes + SHAPE * of_tile[n], x, first_y + (float)row * cell),
                             of_tile[n]);
            store_cells(&list, (size_t)row * columns + column, cell, scale_squared, cell_distance, nearest, level);
        }
    }
}
#else
kernel void distance_map(global const float *restrict at_x, global float *restrict cell_distance,
                         global uchar *restrict nearest, global ushort *restrict level, const float first_y,
                         const float cell, constant float *shapes, const int count, const float scale_squared,
                         const uint columns, const uint rows) {
    const size_t column = get_global_id(0), row = get_global_id(1);
    if (column >= columns || row >= rows) return;
    nearest_shapes list = no_shapes();
    for (int k = 0; k < count; k++)
        insert_shape(&list, shape_distance(shapes + SHAPE * k, at_x[column], first_y + (float)row * cell), (uint)k);
    store_cells(&list, row * columns + column, cell, scale_squared, cell_distance, nearest, level);
}
#endif
