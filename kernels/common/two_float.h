// Numbers as the unevaluated sum of two floats, high + low with |low| <= 2^-24 |high|: about 48 bits without doubles.
//
// Kernels use them where single precision would cancel and the device has no doubles, or doubles at a small fraction of
// the float rate. A sum costs 20 operations, a product 8. u = 2^-24; relative errors (M. Joldes, J.-M. Muller and
// V. Popescu, Tight and rigorous error bounds for basic building blocks of double-word arithmetic, ACM TOMS 44:2, 2017):
//
//     two_sum, two_product        exact
//     two_plus_real               2 u^2 = 2^-47
//     two_plus                    3 u^2 + 13 u^3 < 2^-46
//     two_times_real              2 u^2 = 2^-47
//     two_times                   5 u^2 < 2^-45
//     two_dot_plus                2^-43 of the sum of the absolute terms (the low parts are summed in single)
//
// Products are exact where they lie above 2^-102 (the error of a product must be no denormal number, which GPUs may
// replace by zero). An infinite or NaN operand gives a result whose high part is infinite or NaN.
//
// Options: VECTOR_VARIANT (16 numbers side by side). The real type must be float. No option of the compiler changes the
// errors: a product that a sum follows is an explicit fma, so that no pair is left which -cl-mad-enable could contract.
#ifndef TWO_FLOAT_H
#define TWO_FLOAT_H
#include "common/lanes.h"

#ifdef REAL_IS_DOUBLE
#error "two_float.h needs a build in single precision"
#endif

typedef struct {
    reals high, low;
} two_floats;

// a + b; |a| >= |b|, or a is 0. Three operations (Dekker).
INLINE two_floats quick_two_sum(reals a, reals b) {
    const reals sum = a + b;
    return (two_floats){sum, b - (sum - a)};
}

// a + b of any two numbers, in six operations (Knuth).
INLINE two_floats two_sum(reals a, reals b) {
    const reals sum = a + b, part_b = sum - a, part_a = sum - part_b;
    return (two_floats){sum, (a - part_a) + (b - part_b)};
}

// a b. The fma with 0 rounds the product as a multiplication does.
INLINE two_floats two_product(reals a, reals b) {
    const reals product = lane_fma(a, b, (reals)0);
    return (two_floats){product, lane_fma(a, b, -product)};
}

INLINE two_floats two_plus_real(two_floats a, reals b) {
    const two_floats sum = two_sum(a.high, b);
    return quick_two_sum(sum.high, a.low + sum.low);
}

INLINE two_floats two_plus(two_floats a, two_floats b) {
    const two_floats high = two_sum(a.high, b.high), low = two_sum(a.low, b.low);
    const two_floats sum = quick_two_sum(high.high, high.low + low.high);
    return quick_two_sum(sum.high, low.low + sum.low);
}

INLINE two_floats two_times_real(two_floats a, reals b) {
    const two_floats product = two_product(a.high, b);
    return quick_two_sum(product.high, lane_fma(a.low, b, product.low));
}

INLINE two_floats two_times(two_floats a, two_floats b) {
    const two_floats product = two_product(a.high, b.high);
    const reals cross = lane_fma(a.low, b.high, lane_fma(a.high, b.low, (reals)0));
    return quick_two_sum(product.high, product.low + cross);
}

// a b, with its high part exact and all lower parts in one float.
INLINE two_floats loose_product(two_floats a, two_floats b) {
    const two_floats product = two_product(a.high, b.high);
    return (two_floats){product.high, lane_fma(a.low, b.high, lane_fma(a.high, b.low, product.low))};
}

// x a + y b + z c + d, in 43 operations. The high parts are summed exactly, their errors and the low parts in single.
INLINE two_floats two_dot_plus(two_floats x, two_floats a, two_floats y, two_floats b, two_floats z, two_floats c,
                               two_floats d) {
    const two_floats first = loose_product(x, a), second = loose_product(y, b), third = loose_product(z, c);
    const two_floats one = two_sum(first.high, second.high), two = two_sum(third.high, d.high);
    const two_floats all = two_sum(one.high, two.high);
    const reals low = ((first.low + second.low) + (third.low + d.low)) + ((one.low + two.low) + all.low);
    return two_sum(all.high, low);
}

// The same number in all lanes, from memory: high part, low part.
INLINE two_floats two_floats_of(float2 number) { return (two_floats){(reals)number.x, (reals)number.y}; }

#endif
