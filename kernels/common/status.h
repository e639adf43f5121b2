// Status flags of a sample: the bits of gpuvision.status.Status (tests/test_house.py compares them).
#ifndef STATUS_H
#define STATUS_H

#define STATUS_OK 0
#define STATUS_LOW_SIGNAL 1
#define STATUS_SATURATED 2
#define STATUS_OUT_OF_RANGE 4
#define STATUS_NOT_FINITE 8
#define STATUS_AMBIGUOUS 16
#define STATUS_HORIZON 32
#define STATUS_NO_DATA 64
#define STATUS_NOT_INVERTIBLE 128
#define STATUS_NOT_CONVERGED 256

// Test of convergence of a fit. The Newton step from the result, d = H^-1 g with the gradient g and the second
// derivatives H of half the sum of squares, is the distance to the solution that the iterations left. It is measured
// in standard deviations of the result: d^T C^-1 d. A result whose square exceeds this limit, a tenth of a standard
// deviation, is NOT_CONVERGED. Up to the limit, the distance adds 0.5 % to the root-mean-square error at most:
// sqrt(1 + 0.1^2).
#define CONVERGED_SQUARE 0.01f

#endif
