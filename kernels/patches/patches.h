// Form factor of a differential diffuse receiver and a triangle: Lambert's sum over the edges, exact, after the triangle is
// clipped at the receiver's plane. Vectors are relative to the receiver.
#ifndef PATCHES_H
#define PATCHES_H
#include "line_irradiance/line_irradiance.h"

typedef struct {
    reals x, y, z;
} vector;

INLINE vector patch_sum(vector a, vector b) { return (vector){a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE vector patch_times(reals s, vector a) { return (vector){s * a.x, s * a.y, s * a.z}; }
INLINE reals patch_dot(vector a, vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE vector patch_cross(vector a, vector b) {
    return (vector){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
INLINE vector patch_choose(masks which, vector a, vector b) {
    return (vector){which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z};
}

// Corners and the edges that leave them. Edges are stored: differences of far corners would lose digits.
typedef struct {
    vector corner[4], edge[4];
    int is_whole; // not clipped: the third edge is zero
} polygon;

// Clip a triangle at the receiver's plane, keeping its orientation; `height`: heights of the corners above the plane.
INLINE polygon patch_cut(const vector *corner, const vector *edge, const reals *height) {
    const masks in0 = mask_of(height[0] > (reals)0), in1 = mask_of(height[1] > (reals)0);
    const masks in2 = mask_of(height[2] > (reals)0), all = in0 & in1 & in2;
    const vector none = {(reals)0, (reals)0, (reals)0};
    const polygon whole = {{corner[0], corner[1], corner[2], corner[2]}, {edge[0], edge[1], none, edge[2]}, 1};
    if (!any_lane(~all)) return whole;
    // Rotate the corners so that the single corner on one side of the plane is the first.
    const masks second = (in0 ^ in1) & ~(in0 ^ in2), third = (in0 ^ in2) & ~(in0 ^ in1);
    const vector a = patch_choose(second, corner[1], patch_choose(third, corner[2], corner[0]));
    const vector b = patch_choose(second, corner[2], patch_choose(third, corner[0], corner[1]));
    const vector c = patch_choose(second, corner[0], patch_choose(third, corner[1], corner[2]));
    const vector ab = patch_choose(second, edge[1], patch_choose(third, edge[2], edge[0]));
    const vector bc = patch_choose(second, edge[2], patch_choose(third, edge[0], edge[1]));
    const vector ca = patch_choose(second, edge[0], patch_choose(third, edge[1], edge[2]));
    const reals of_a = second ? height[1] : third ? height[2] : height[0];
    const reals of_b = second ? height[2] : third ? height[0] : height[1];
    const reals of_c = second ? height[0] : third ? height[1] : height[2];
    const masks lone = mask_of(of_a > (reals)0);
    const reals to_b = of_a / (of_a - of_b), to_c = of_a / (of_a - of_c);
    const reals from_b = of_b / (of_b - of_a), from_c = of_c / (of_c - of_a);
    const vector step_b = patch_times(to_b, ab), step_c = patch_times(to_c, ca);
    const vector on_ab = patch_sum(a, step_b), on_ca = patch_sum(a, patch_times((reals)-1, step_c));
    const vector across = patch_sum(step_b, step_c);
    polygon cut;
    cut.is_whole = 0;
    // a, ab, ca where a is the only corner above; else ab, b, c, ca.
    cut.corner[0] = patch_choose(lone, a, on_ab);
    cut.corner[1] = patch_choose(lone, on_ab, b);
    cut.corner[2] = patch_choose(lone, on_ca, c);
    cut.corner[3] = on_ca;
    cut.edge[0] = patch_choose(lone, step_b, patch_times(from_b, ab));
    cut.edge[1] = patch_choose(lone, patch_times((reals)-1, across), bc);
    cut.edge[2] = patch_choose(lone, none, patch_times(from_c, ca));
    cut.edge[3] = patch_choose(lone, step_c, across);
    for (int n = 0; n < 4; n++) {
        cut.corner[n] = patch_choose(all, whole.corner[n], cut.corner[n]);
        cut.edge[n] = patch_choose(all, whole.edge[n], cut.edge[n]);
    }
    return cut;
}

// Form factor of a polygon above the plane of a receiver with this unit normal; counter-clockwise in the view from the
// receiver.
INLINE reals patch_factor(const polygon *shape, vector normal) {
    reals size[4], weight[4], excess[4];
    masks near_by = (masks)0;
#pragma unroll
    for (int n = 0; n < 4; n++) size[n] = sqrt(patch_dot(shape->corner[n], shape->corner[n]));
    reals sum = (reals)0;
#pragma unroll
    for (int n = 0; n < 4; n++) {
        if (n == 2 && shape->is_whole) {
            weight[n] = excess[n] = (reals)0;
            continue;
        }
        const vector turn = patch_cross(shape->edge[n], shape->corner[n]);
        const reals cosine = size[n] * size[n] + patch_dot(shape->corner[n], shape->edge[n]);
        const reals sine = sqrt(patch_dot(turn, turn)), positive = fabs(cosine);
        const masks steep = mask_of(sine > positive);
        const reals ratio = (steep ? positive : sine) / (steep ? sine : positive), square = ratio * ratio;
        const reals rest = LANED(arc_rest)(square), low = ratio - ratio * square * rest;
        const reals acute = steep ? (reals)(real)1.57079632679489661923 - low : low;
        const reals angle = cosine < (reals)0 ? (reals)(real)3.14159265358979323846 - acute : acute;
        weight[n] = patch_dot(normal, turn);
        // An edge contributes 0 to a receiver on its line (0 / 0).
        sum += zero_where(~mask_of(sine > (reals)0), weight[n] * angle / sine);
        near_by |= steep | ~mask_of(cosine > (reals)0);
        // angle / sin(angle) - 1, for angles up to 45 degrees.
        const reals secant = sqrt((reals)1 + square);
        excess[n] = square * ((real)1 / ((real)1 + secant) - rest * secant);
    }
    if (any_lane(~near_by)) {
        // Small polygons: the factors of all edges are nearly equal and their sum cancels. Sum instead the first factor
        // times all edges (the area), and the differences between neighbouring factors, which follow from their common
        // corner without cancellation.
        const vector one = shape->edge[0], two = patch_sum(one, shape->edge[1]);
        const vector area = patch_sum(patch_cross(shape->edge[1], one), patch_cross(shape->edge[2], two));
        reals per[4], rest_of = weight[1] + weight[2] + weight[3];
#pragma unroll
        for (int n = 0; n < 4; n++) per[n] = (reals)1 / (size[n] * size[(n + 1) & 3]);
        reals small = ((reals)1 + excess[0]) * per[0] * patch_dot(normal, area);
#pragma unroll
        for (int n = 1; n < 4; n++) {
            const int next = (n + 1) & 3;
            const vector chord = patch_sum(shape->edge[n - 1], shape->edge[n]);
            const vector both = patch_sum(shape->corner[n - 1], shape->corner[next]);
            const reals shorter = -patch_dot(chord, both) / (size[n - 1] + size[next]);
            const reals change = size[n] * shorter * per[n] * per[n - 1];
            small += (change + excess[n] * per[n] - excess[n - 1] * per[n - 1]) * rest_of;
            rest_of -= weight[n];
        }
        sum = near_by ? sum : small;
    }
    return max(sum, (reals)0) * (reals)(real)0.15915494309189533577;
}

#endif
