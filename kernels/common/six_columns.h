// Transposed load: six numbers each of 16 samples (of one in the work-item variant) as six columns.
//
// The includer defines the type COLUMN_TYPE of a column and CONVERT_COLUMN, the conversion to it from INPUT vectors.
// Shuffles of whole vectors serve where the compiler has them: from single elements compilers generate gathers, which
// cost several times as much.
#ifndef SIX_COLUMNS_H
#define SIX_COLUMNS_H

#if defined(VECTOR_VARIANT) && __has_builtin(__builtin_shufflevector)
typedef INPUT inputs __attribute__((ext_vector_type(16)));
typedef inputs inputs_at __attribute__((aligned(sizeof(INPUT))));
// Every other element of two vectors, from `first` on.
#define PART(a, b, first)                                                                                              \
    __builtin_shufflevector(a, b, first, first + 2, first + 4, first + 6, first + 8, first + 10, first + 12,           \
                            first + 14, first + 16, first + 18, first + 20, first + 22, first + 24, first + 26,        \
                            first + 28, first + 30)
// Every third element of three vectors, from `first` on.
INLINE COLUMN_TYPE third(inputs a, inputs b, inputs c, int first) {
    if (first == 0) {
        const inputs two = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
        return CONVERT_COLUMN(
            __builtin_shufflevector(two, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29));
    }
    if (first == 1) {
        const inputs two = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
        return CONVERT_COLUMN(
            __builtin_shufflevector(two, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30));
    }
    const inputs two = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
    return CONVERT_COLUMN(__builtin_shufflevector(two, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31));
}
static inline void load_columns(global const INPUT *at, COLUMN_TYPE *columns) {
    global const inputs_at *from = (global const inputs_at *)at;
    const inputs a = from[0], b = from[1], c = from[2], d = from[3], e = from[4], f = from[5];
#pragma unroll
    for (int parity = 0; parity < 2; parity++) {
        const inputs one = parity ? PART(a, b, 1) : PART(a, b, 0);
        const inputs two = parity ? PART(c, d, 1) : PART(c, d, 0);
        const inputs three = parity ? PART(e, f, 1) : PART(e, f, 0);
#pragma unroll
        for (int n = 0; n < 3; n++) columns[2 * n + parity] = third(one, two, three, n);
    }
}
#elif defined(VECTOR_VARIANT)
static inline void load_columns(global const INPUT *from, COLUMN_TYPE *columns) {
    for (int n = 0; n < 6; n++) {
        global const INPUT *at = from + n;
        columns[n] = (COLUMN_TYPE)(at[0], at[6], at[12], at[18], at[24], at[30], at[36], at[42],
                              at[48], at[54], at[60], at[66], at[72], at[78], at[84], at[90]);
    }
}
#else
static inline void load_columns(global const INPUT *from, COLUMN_TYPE *columns) {
    for (int n = 0; n < 6; n++) columns[n] = from[n];
}
#endif

#endif
