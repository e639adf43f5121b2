// Rays relative to the scene's middle, and the part of a distant ray in the sphere around the scene.
//
// Positions have more digits than a real (common/places.h): doubles, or two floats. With two floats the foot of the
// sphere's middle on the ray is found in two steps of single precision: the first foot is wrong by 2^-24 of the distance,
// but the point of the ray at it is exact to 2^-45, and the second step starts there.
#ifndef CLIPPED_RAY_H
#define CLIPPED_RAY_H
#include "common/bvh.h"
#include "common/places.h"

#ifdef TWO_FLOAT_POSITIONS
#ifdef VECTOR_VARIANT
#error "rays are traced one by one: two floats need the work-item variant"
#endif
typedef two_floats coordinate;
typedef real amount; // of distances and of multiples of the direction
#else
typedef place coordinate;
typedef place amount;
#endif

typedef struct {
    coordinate x, y, z;
} spot;

// Part of a ray in the sphere around the scene.
typedef struct {
    spot origin;
    coordinate ahead; // its start, in multiples of the direction
    amount across;    // its length, in multiples of the direction
    int misses;
} part;

#ifdef TWO_FLOAT_POSITIONS
static inline real as_number(coordinate value) { return value.high; }
static inline amount as_amount(coordinate value) { return value.high; }
static inline spot direction_at(global const INPUT *three) {
    places to[3];
    load_direction(three, to);
    return (spot){to[0], to[1], to[2]};
}
static inline spot from_middle(global const INPUT *three, constant place *middle) {
    return (spot){input_minus(three[0], middle[0]), input_minus(three[1], middle[1]), input_minus(three[2], middle[2])};
}
static inline amount dot_of(spot a, spot b) { return a.x.high * b.x.high + a.y.high * b.y.high + a.z.high * b.z.high; }
static inline spot moved(spot a, spot b, amount by) {
    return (spot){two_plus(a.x, two_times_real(b.x, by)), two_plus(a.y, two_times_real(b.y, by)),
                  two_plus(a.z, two_times_real(b.z, by))};
}
static inline spot scaled(spot a, amount by) {
    return (spot){two_times_real(a.x, by), two_times_real(a.y, by), two_times_real(a.z, by)};
}
// Scale by a power of two before squaring: lengths of any size neither overflow nor underflow.
static inline amount length_of(spot direction, int *power) {
    const real longest = fmax(fmax(fabs(direction.x.high), fabs(direction.y.high)), fabs(direction.z.high));
    *power = longest > 0 && !not_finite(longest) ? ilogb(longest) : 0;
    const real x = ldexp(direction.x.high, -*power), y = ldexp(direction.y.high, -*power);
    const real z = ldexp(direction.z.high, -*power);
    return sqrt(x * x + y * y + z * z);
}
static inline amount size_of(spot direction) {
    int power;
    const real length = length_of(direction, &power);
    return ldexp(length, power);
}
static inline two_floats unit_part(two_floats part, int power, real per) {
    return two_times_real((two_floats){ldexp(part.high, -power), ldexp(part.low, -power)}, per);
}
static inline spot unit_of(spot direction) {
    int power;
    const real per = 1 / length_of(direction, &power);
    return (spot){unit_part(direction.x, power, per), unit_part(direction.y, power, per),
                  unit_part(direction.z, power, per)};
}
static inline part part_within(spot origin, spot direction, amount radius) {
    const real whole = dot_of(direction, direction), first = -dot_of(origin, direction) / whole;
    const spot near_foot = moved(origin, direction, first);
    const real second = -dot_of(near_foot, direction) / whole;
    const spot middle = moved(near_foot, direction, second);
    const real left = radius * radius - dot_of(middle, middle);
    if (!(left > 0 && first > 0)) return (part){origin, convert_places(0), 1, 1};
    const real half_of_it = sqrt(left / whole);
    return (part){moved(middle, direction, -half_of_it), two_plus_real(two_sum(first, second), -half_of_it),
                  2 * half_of_it, 0};
}
static inline amount after_start(amount value, amount less, part within) {
    const two_floats ahead = {-within.ahead.high, -within.ahead.low};
    return two_plus_real(two_plus_real(ahead, value), -less).high;
}
#else
static inline real as_number(coordinate value) { return (real)value; }
static inline amount as_amount(coordinate value) { return value; }
static inline spot direction_at(global const INPUT *three) { return (spot){three[0], three[1], three[2]}; }
static inline amount dot_of(spot a, spot b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline spot moved(spot a, spot b, amount by) { return (spot){a.x + b.x * by, a.y + b.y * by, a.z + b.z * by}; }
static inline spot scaled(spot a, amount by) { return moved((spot){0, 0, 0}, a, by); }
static inline spot from_middle(global const INPUT *three, constant place *middle) {
    return moved(direction_at(three), (spot){middle[0], middle[1], middle[2]}, -1);
}
static inline amount size_of(spot direction) { return sqrt(dot_of(direction, direction)); }
static inline spot unit_of(spot direction) { return scaled(direction, 1 / size_of(direction)); }
static inline part part_within(spot origin, spot direction, amount radius) {
    const place whole = dot_of(direction, direction), nearest = -dot_of(origin, direction) / whole;
    const spot middle = moved(origin, direction, nearest);
    const place left = radius * radius - dot_of(middle, middle);
    if (!(left > 0 && nearest > 0)) return (part){origin, 0, 1, 1};
    const place half_of_it = sqrt(left / whole);
    return (part){moved(middle, direction, -half_of_it), nearest - half_of_it, 2 * half_of_it, 0};
}
static inline amount after_start(amount value, amount less, part within) { return value - less - within.ahead; }
#endif

static inline int finite_spot(spot a) {
    return !(not_finite(as_number(a.x)) | not_finite(as_number(a.y)) | not_finite(as_number(a.z)));
}
static inline int is_far(spot origin, amount radius) {
    return fabs(as_amount(origin.x)) + fabs(as_amount(origin.y)) + fabs(as_amount(origin.z)) > 8 * radius;
}
static inline bvh_ray ray_from(spot origin, spot direction, real start, real end) {
    return bvh_ray_of(as_number(origin.x), as_number(origin.y), as_number(origin.z), as_number(direction.x),
                      as_number(direction.y), as_number(direction.z), start, end);
}

#endif
