/* Bilinear interpolation of gray levels, at several positions in parallel (SIMD). */
#ifndef DJET_BETWEEN_H
#define DJET_BETWEEN_H

#include <string.h>

#include "common.h"

enum { LANES = 8 };

/* Vectors, each lane of which belongs to another position. */
typedef float Lanes __attribute__((vector_size(LANES * sizeof(float))));
typedef int32_t Integers __attribute__((vector_size(LANES * sizeof(int32_t))));

/* Load numbers at a stride. If there are fewer than lanes, the last one is repeated. */
INLINE Lanes gathered(const float *values, int stride, int count)
{
    Lanes lanes = {0};
    for (int l = 0; l < LANES; l++)
        lanes[l] = values[(l < count ? l : count - 1) * stride];
    return lanes;
}

/* Load contiguous numbers, aligned or not. */
INLINE Lanes load(const float *values)
{
    Lanes lanes;
    memcpy(&lanes, values, sizeof lanes);
    return lanes;
}

/* Clip each lane to [least, most], also NaN. */
INLINE Lanes clipped(Lanes values, float least, float most)
{
    const Integers above = values > least, below = values < most;
    const Lanes lowest = (Lanes){0} + least, highest = (Lanes){0} + most;
    const Integers raised = (above & (Integers)values) | (~above & (Integers)lowest);
    return (Lanes)((below & raised) | (~below & (Integers)highest));
}

/* An image of one unsigned byte or two signed bytes a pixel. */
typedef struct {
    const void *pixels;
    int bytes, height, width;
} Image;

/* The values at pixels and their right neighbours, packed in one second. */
INLINE Integers pairs_at(Image image, Integers pixels)
{
    Integers pairs = {0};
    for (int l = 0; l < LANES; l++)
        if (image.bytes == 1) {
            uint16_t pair;
            memcpy(&pair, (const uint8_t *)image.pixels + pixels[l], sizeof pair);
            pairs[l] = pair;
        } else
            memcpy((int32_t *)&pairs + l, (const int16_t *)image.pixels + pixels[l],
                   sizeof(int32_t));
    return pairs;
}

/* Unpack the first value of pairs, or the second one. */
INLINE Lanes unpacked(Image image, Integers pairs, int second)
{
    const int is_low = (__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__) == !second;
    const Integers one = image.bytes == 1 ? (is_low ? pairs & 255 : pairs >> 8)
                                          : (is_low ? pairs << 16 : pairs) >> 16;
    return __builtin_convertvector(one, Lanes);
}

/* Gray levels at (x, y) by bilinear interpolation; beyond the image, border pixels are
   replicated. The image has at least two rows and columns. */
INLINE Lanes between(Image image, Lanes x, Lanes y)
{
    x = clipped(x, 0, image.width - 1);
    y = clipped(y, 0, image.height - 1);
    const Integers left = __builtin_convertvector(clipped(x, 0, image.width - 2), Integers);
    const Integers top = __builtin_convertvector(clipped(y, 0, image.height - 2), Integers);
    const Integers first = top * image.width + left;
    const Integers of_above = pairs_at(image, first),
                   of_below = pairs_at(image, first + image.width);
    x -= __builtin_convertvector(left, Lanes);
    y -= __builtin_convertvector(top, Lanes);
    const Lanes left_above = unpacked(image, of_above, 0),
                left_below = unpacked(image, of_below, 0);
    const Lanes above = left_above + x * (unpacked(image, of_above, 1) - left_above);
    const Lanes below = left_below + x * (unpacked(image, of_below, 1) - left_below);
    return above + y * (below - above);
}

#endif
