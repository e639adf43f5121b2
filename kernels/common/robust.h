// Loss functions of M-estimators (Huber, 1981) and medians, for residuals in units of their scale.
//
// Options: LOSS_HUBER, LOSS_TUKEY (biweight) or LOSS_CUT (truncated squares); without any: least squares.
// TUNING_CONSTANT: residual at which the loss departs from least squares.
#ifndef ROBUST_H
#define ROBUST_H

#include "common/lanes.h"

#if defined(LOSS_HUBER) || defined(LOSS_TUKEY) || defined(LOSS_CUT)
#define ROBUST
// Iteration before which the scale is estimated again.
#define RESCALED_AT(step) ((step) == 2)
#else
#define RESCALED_AT(step) 0
#endif
#ifdef TUNING_CONSTANT
#define TUNING ((real)(TUNING_CONSTANT))
#endif
#define FABS(x) as_reals(as_masks(x) & (masks)(~SIGN_BIT))
#ifdef REAL_IS_DOUBLE
#define SIGN_BIT (bits)0x8000000000000000L
#define BITS_BELOW_SIGN 63
#define BITS_TO_ONE_PERCENT 45 // the exponent and seven bits of the fraction stay
#else
#define SIGN_BIT (bits)0x80000000
#define BITS_BELOW_SIGN 31
#define BITS_TO_ONE_PERCENT 16
#endif
#define MAD_TO_SIGMA (real)1.4826022185056018
// Small-sample correction of the scale from the median, 1 + c / (n - p): c = 5 where the fit is the best of many trials
// through p points (Rousseeuw and Leroy, 1987), c = 1 where all points took part.
#define FEW_TRIED (real)5
#define FEW_FITTED (real)1

// Value of one lane.
#ifdef VECTOR_VARIANT
#define LANE(values, lane) (((private real *)&(values))[lane])
#define LANE_BITS(values, lane) (((private const bits *)&(values))[lane])
#else
#define LANE(values, lane) (values)
#define LANE_BITS(values, lane) (values)
#endif

static inline reals kept_where(masks mask, reals value) { return as_reals(as_masks(value) & mask); }

// Weight of a residual in iteratively reweighted least squares: psi(z) / z.
static inline reals loss_weight(reals z) {
#if defined(LOSS_HUBER)
    const reals size = FABS(z);
    return size <= (reals)TUNING ? (reals)1 : (reals)TUNING / size;
#elif defined(LOSS_TUKEY)
    const reals left = (reals)1 - z * z * (reals)(1 / (TUNING * TUNING));
    return left > (reals)0 ? left * left : (reals)0;
#elif defined(LOSS_CUT)
    return FABS(z) <= (reals)TUNING ? (reals)1 : (reals)0;
#else
    return (reals)1;
#endif
}

// Derivative psi'(z): the sensitivity of the estimate to a residual.
static inline reals loss_slope(reals z) {
#if defined(LOSS_HUBER) || defined(LOSS_CUT)
    return FABS(z) <= (reals)TUNING ? (reals)1 : (reals)0;
#elif defined(LOSS_TUKEY)
    const reals part = z * z * (reals)(1 / (TUNING * TUNING));
    return part < (reals)1 ? ((reals)1 - part) * ((reals)1 - (reals)5 * part) : (reals)0;
#else
    return (reals)1;
#endif
}

static inline reals loss_of(reals z) {
    const reals square = z * z;
#if defined(LOSS_HUBER)
    const reals size = FABS(z);
    return size <= (reals)TUNING ? square * (reals)0.5 : (reals)TUNING * (size - (reals)(TUNING / 2));
#elif defined(LOSS_TUKEY)
    const reals left = (reals)1 - square * (reals)(1 / (TUNING * TUNING));
    return (reals)(TUNING * TUNING / 6) * (left > (reals)0 ? (reals)1 - left * left * left : (reals)1);
#elif defined(LOSS_CUT)
    return (square <= (reals)(TUNING * TUNING) ? square : (reals)(TUNING * TUNING)) * (reals)0.5;
#else
    return square * (reals)0.5;
#endif
}

// Order statistic of each lane: the smallest value with at least `rank` values at or below it; infinity if no such
// value exists.
//
// Built bit by bit from the top: the bit patterns of non-negative reals have the order of the reals, so counting the values
// below a pattern decides each bit. The `lowest` bits stay zero, which rounds the result down.
static inline reals ranked_of(private const reals *values, int count, masks rank, int lowest) {
    masks found = 0;
    for (int bit = BITS_BELOW_SIGN - 1; bit >= lowest; bit--) {
        const masks next = found | (masks)((bits)1 << bit);
        masks below = 0;
        for (int i = 0; i < count; i++) below -= mask_of(as_masks(values[i]) < next);
        found = below >= rank ? found : next;
    }
    return as_reals(found);
}

#endif
