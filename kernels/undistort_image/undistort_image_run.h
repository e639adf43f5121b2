// Runs of 16 output pixels along a row. The last run moves back to end with the row and overlaps the previous run.
#ifndef UNDISTORT_IMAGE_RUN_H
#define UNDISTORT_IMAGE_RUN_H

#define RUN 16
#define RUNS(columns) (((columns) + RUN - 1) / RUN)
#define RUN_START(run, columns) max(min(RUN * (run), (columns) - RUN), 0)

#ifdef VECTOR_VARIANT
// Compute the pixels of a run one by one, at the source positions (column + x, row + y).
static inline void each_pixel(global const CODE *image, global CODE *made, global uchar *status, int column, int row,
                              int lanes, float16 x, float16 y, constant int *size, float fill) {
    float along[RUN], across[RUN];
    vstore16(x, 0, along);
    vstore16(y, 0, across);
    for (int lane = 0; lane < lanes; lane++) {
        const uchar found =
            sample(image, column, row, along[lane], across[lane], size, fill, CHANNELS, made + lane * CHANNELS);
        if (status) status[lane] = found;
    }
}
#endif

#endif
