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

#endif
