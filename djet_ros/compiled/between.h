/* Gray levels between pixels, of several places at once. */
#ifndef DJET_BETWEEN_H
#define DJET_BETWEEN_H

#include <string.h>

#include "common.h"

enum { LANES = 8 };

/* So many numbers side by side; sums are those of each lane by itself. */
typedef float Lanes __attribute__((vector_size(LANES * sizeof(float))));
typedef int32_t Whole __attribute__((vector_size(LANES * sizeof(int32_t))));

typedef uint64_t Pairs __attribute__((vector_size(LANES * sizeof(uint64_t))));

/* Numbers that lie so far apart, side by side. Where there are fewer than lanes, the last one stands
   in for those that are lacking. */
INLINE Lanes gathered(const float *values, int apart, int count)
{
    Lanes lanes = {0};
    for (int l = 0; l < LANES; l++)
        lanes[l] = values[(l < count ? l : count - 1) * apart];
    return lanes;
}

INLINE Lanes load(const float *values)
{
    Lanes lanes;
    memcpy(&lanes, values, sizeof lanes);
    return lanes;
}

/* Each lane at least `least` and at most `most`, which what is no number is too. */
INLINE Lanes clipped(Lanes values, float least, float most)
{
    const Whole above = values > least, below = values < most;
    const Lanes lowest = (Lanes){0} + least, highest = (Lanes){0} + most;
    const Whole raised = (above & (Whole)values) | (~above & (Whole)lowest);
    return (Lanes)((below & raised) | (~below & (Whole)highest));
}

/* The first or the second of pairs of numbers. */
INLINE Lanes one_of(Pairs pairs, int number)
{
    const int is_low = (__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__) == (number == 0);
    return (Lanes)__builtin_convertvector(is_low ? pairs : pairs >> 32, Whole);
}

/* Gray levels between pixels; beyond the image its border goes on. */
INLINE Lanes between(const float *image, int height, int width, Lanes x, Lanes y)
{
    x = clipped(x, 0, width - 1);
    y = clipped(y, 0, height - 1);
    const Whole left = __builtin_convertvector(clipped(x, 0, width - 2), Whole);
    const Whole top = __builtin_convertvector(clipped(y, 0, height - 2), Whole);
    const Whole first = top * width + left;
    Pairs pairs[2];
    for (int l = 0; l < LANES; l++)
        for (int row = 0; row < 2; row++) {
            uint64_t pair;
            memcpy(&pair, image + first[l] + row * width, sizeof pair);
            pairs[row][l] = pair;
        }
    x -= __builtin_convertvector(left, Lanes);
    y -= __builtin_convertvector(top, Lanes);
    const Lanes left_above = one_of(pairs[0], 0), left_below = one_of(pairs[1], 0);
    const Lanes above = left_above + x * (one_of(pairs[0], 1) - left_above);
    const Lanes below = left_below + x * (one_of(pairs[1], 1) - left_below);
    return above + y * (below - above);
}

#endif
