/* Corner strength: see core/corners.py. */
#include <stdlib.h>
#include <string.h>

#include "common.h"

/* Rows of blocks summed, and products of gradients along x and y: xx, xy, yy. */
enum { NEAR = 3, PRODUCTS = 3 };

/* Share of a pixel in the mean over a block of three by three pairs of rows and columns. */
static const double PER_BLOCK = 0.25 * (1.0 / 9);

/* Mirror an index at both ends: OpenCV's BORDER_REFLECT_101. */
static int mirrored(int index, int count)
{
    return index < 0 ? -index : index < count ? index : 2 * count - 2 - index;
}

/* Sobel gradients of a row of pixels, along x and y. smoothed, differences: (width + 2,) scratch
   memory, for sums and differences of the rows above and below. */
INLINE void gradients_of_row(const uint8_t *image, int height, int width, int row,
                             int16_t *restrict smoothed, int16_t *restrict differences,
                             int16_t *restrict dx, int16_t *restrict dy)
{
    const uint8_t *centre = image + (int64_t)row * width,
                  *above = image + (int64_t)mirrored(row - 1, height) * width,
                  *below = image + (int64_t)mirrored(row + 1, height) * width;
    for (int x = 0; x < width; x++) {
        smoothed[x + 1] = (int16_t)(above[x] + 2 * centre[x] + below[x]);
        differences[x + 1] = (int16_t)(below[x] - above[x]);
    }
    smoothed[0] = smoothed[2];
    smoothed[width + 1] = smoothed[width - 1];
    differences[0] = differences[2];
    differences[width + 1] = differences[width - 1];
    for (int x = 0; x < width; x++) {
        dx[x] = (int16_t)(smoothed[x + 2] - smoothed[x]);
        dy[x] = (int16_t)(differences[x] + 2 * differences[x + 1] + differences[x + 2]);
    }
}

/* Add products of gradients (2 n,), summed in pairs. */
INLINE void add_pairs(const int16_t *restrict a, const int16_t *restrict b, int n,
                      int32_t *restrict sums)
{
    for (int j = 0; j < n; j++)
        sums[j] += a[2 * j] * b[2 * j] + a[2 * j + 1] * b[2 * j + 1];
}

/* Add three rows, and mirror their ends. sums: (n + 2,). */
INLINE void add_rows(const int32_t *a, const int32_t *b, const int32_t *c, int n,
                     int32_t *restrict sums)
{
    for (int j = 0; j < n; j++)
        sums[j + 1] = a[j] + b[j] + c[j];
    sums[0] = sums[2];
    sums[n + 1] = sums[n - 1];
}

/* Corner strengths and steepness of a row of blocks, by sums (3, n + 2) of products over three rows
   of pairs. */
INLINE void to_slopes(const int32_t *sums, int n, float least_ratio, float unit,
                      float *restrict slopes, float *restrict steepness)
{
    const int32_t *xx = sums, *xy = xx + n + 2, *yy = xy + n + 2;
    for (int j = 0; j < n; j++) {
        const float mean_xx = (float)((xx[j] + xx[j + 1] + xx[j + 2]) * PER_BLOCK),
                    mean_xy = (float)((xy[j] + xy[j + 1] + xy[j + 2]) * PER_BLOCK),
                    mean_yy = (float)((yy[j] + yy[j + 1] + yy[j + 2]) * PER_BLOCK);
        const float trace = mean_xx + mean_yy, difference = mean_xx - mean_yy;
        const float spread = sqrtf(difference * difference + mean_xy * mean_xy * 4);
        const float least = trace - spread, most = (trace + spread) * least_ratio;
        slopes[j] = (least < most ? 0 : least) * unit;
        steepness[j] = (trace + spread) * unit;
    }
}

/* Mean square gradients (height / 2, width / 2) of blocks in their weakest direction, 0 if that
   is less than a share of the strongest one, and in the strongest: core.corners.corner_slopes.
   height, width: even; sums, rows: scratch memory (12, width / 2 + 1) and (4, width + 2). */
WIDE void djet_corner_slopes(const uint8_t *image, int height, int width, float least_ratio,
                             float unit, int32_t *sums, int16_t *rows, float *slopes,
                             float *steepness)
{
    const int n = width / 2, blocks = height / 2;
    int16_t *smoothed = rows, *differences = smoothed + width + 2, *dx = differences + width + 2,
            *dy = dx + width + 2;
    int32_t *of_three = sums + NEAR * PRODUCTS * n;
    for (int row = 0; row <= blocks; row++) {
        if (row < blocks) {
            int32_t *latest = sums + row % NEAR * PRODUCTS * n;
            memset(latest, 0, (size_t)(PRODUCTS * n) * sizeof *latest);
            for (int i = 0; i < 2; i++) {
                gradients_of_row(image, height, width, 2 * row + i, smoothed, differences, dx, dy);
                add_pairs(dx, dx, n, latest);
                add_pairs(dx, dy, n, latest + n);
                add_pairs(dy, dy, n, latest + 2 * n);
            }
        }
        if (row == 0)
            continue;
        /* The rows above and below the previous one are complete now. */
        const int32_t *near[NEAR];
        for (int i = 0; i < NEAR; i++)
            near[i] = sums + mirrored(row - 2 + i, blocks) % NEAR * PRODUCTS * n;
        for (int p = 0; p < PRODUCTS; p++)
            add_rows(near[0] + p * n, near[1] + p * n, near[2] + p * n, n,
                     of_three + p * (n + 2));
        const int64_t first = (int64_t)(row - 1) * n;
        to_slopes(of_three, n, least_ratio, unit, slopes + first, steepness + first);
    }
}

/* Radius of the wider neighbourhood of a maximum. */
enum { AROUND = 3 };

/* Return whether a value is the maximum of its wider neighbourhood. */
INLINE int is_highest(const float *value, int width)
{
    int higher = 0;
    for (int j = -AROUND; j <= AROUND && !higher; j++)
        for (int i = -AROUND; i <= AROUND; i++)
            higher |= value[(int64_t)j * width + i] > *value;
    return !higher;
}

/* Local maxima of slopes (height, width) above `least`, from `margin` on in both axes, before a
   last column and row: core.corners._peaks. Returns their number, indices into the flat array,
   and whether they are maxima of the wider neighbourhood. memory: (width,). */
WIDE int djet_peaks(const float *slopes, int width, float least, int margin, int after_column,
                    int after_row, uint8_t *restrict memory, int64_t *restrict places,
                    uint8_t *restrict strongest)
{
    int count = 0;
    for (int row = margin; row < after_row; row++) {
        const float *centre = slopes + (int64_t)row * width, *above = centre - width,
                    *below = centre + width;
        for (int x = margin; x < after_column; x++)
            memory[x] = (centre[x] > least) & (centre[x] >= centre[x - 1])
                        & (centre[x] >= centre[x + 1]) & (centre[x] >= above[x - 1])
                        & (centre[x] >= above[x]) & (centre[x] >= above[x + 1])
                        & (centre[x] >= below[x - 1]) & (centre[x] >= below[x])
                        & (centre[x] >= below[x + 1]);
        const uint8_t *end = memory + after_column, *next = memory + margin;
        while (next < end && (next = memchr(next, 1, (size_t)(end - next)))) {
            const int x = (int)(next++ - memory);
            places[count] = (int64_t)row * width + x;
            strongest[count++] = (uint8_t)is_highest(centre + x, width);
        }
    }
    return count;
}

/* Sub-pixel maxima (n, 2) of parabolas through peaks of slopes, at indices (n,) of the flat
   array, none of them at its border: core.corners._exact_peaks. */
WIDE void djet_exact_peaks(const float *slopes, int width, int n, const int64_t *places,
                           double (*points)[2])
{
    for (int k = 0; k < n; k++) {
        const int64_t pixel[2] = {places[k] % width, places[k] / width}, steps[2] = {1, width};
        for (int axis = 0; axis < 2; axis++) {
            const float *at = slopes + places[k];
            const float value = at[0], before = at[-steps[axis]], after = at[steps[axis]];
            const float curvature = 2 * value - before - after;
            const float offset = (after - before) / (2 * (curvature > 1e-9f ? curvature : 1e-9f));
            /* The centre of two pixels is half a pixel beyond the first. */
            const float limited = offset < -0.5f ? -0.5f : offset > 0.5f ? 0.5f : offset;
            points[k][axis] = 2 * ((double)pixel[axis] + limited) + 0.5;
        }
    }
}

/* Choose at most `most` of n points, the best of each cell before others:
   core.corners.spread_out. points: (n, 2) pixels; by_strength: (n,) their order; first: (n,)
   points preferred to all others; side: of cells, of which there are `columns` in a row and
   `cells` in all. memory: twice as many, and (3, n). Returns how many are chosen, and their
   indices, in order. */
int djet_spread_out(int n, const int64_t (*points)[2], const int64_t *by_strength,
                    const uint8_t *first, int side, int columns, int cells, int most,
                    int32_t *memory, int64_t *chosen)
{
    int32_t *in_cell = memory, *of_rank = in_cell + 2 * cells, *rank = of_rank + 2 * n;
    memset(memory, 0, (size_t)(2 * (cells + n)) * sizeof *memory);
    /* Rank of a point among those of its cell and preference. */
    for (int k = 0; k < n; k++) {
        const int64_t point = by_strength[k];
        const int late = !first[point];
        const int64_t cell = points[point][1] / side * columns + points[point][0] / side;
        rank[point] = late * n + in_cell[2 * cell + late]++;
        of_rank[rank[point]]++;
    }
    /* All are chosen up to some rank, and the strongest of that one. */
    int last = 0, room = most, count = 0;
    while (last < 2 * n && of_rank[last] <= room)
        room -= of_rank[last++];
    for (int k = 0; k < n && room; k++)
        if (rank[by_strength[k]] == last) {
            rank[by_strength[k]] = -1;
            room--;
        }
    for (int k = 0; k < n; k++)
        if (rank[k] < last)
            chosen[count++] = k;
    return count;
}

/* Sums of absolute curvatures in blocks: core.corners._curved_blocks. Blocks are `side` wide
   and high, in `columns` columns; rows of them begin every `spacing` rows of the image (height,
   width), one pixel below. memory: (2, width + 2). */
WIDE void djet_block_curvatures(const uint8_t *image, int width, int rows, int spacing, int side,
                                int columns, int32_t *restrict memory, int32_t *restrict sums)
{
    int32_t *restrict differences = memory + 1, *restrict sizes = memory + width + 2;
    for (int row = 0; row < rows; row++) {
        memset(sizes, 0, (size_t)width * sizeof *sizes);
        for (int j = 0; j < side; j++) {
            const uint8_t *above = image + (int64_t)(row * spacing + j) * width,
                          *centre = above + width, *below = centre + width;
            for (int x = 0; x < width; x++)
                differences[x] = above[x] - 2 * centre[x] + below[x];
            differences[-1] = differences[1];
            differences[width] = differences[width - 2];
            for (int x = 0; x < width; x++)
                sizes[x] += abs(differences[x - 1] - 2 * differences[x] + differences[x + 1]);
        }
        for (int block = 0; block < columns; block++) {
            int32_t sum = 0;
            for (int i = 0; i < side; i++)
                sum += sizes[block * side + i];
            sums[row * columns + block] = sum;
        }
    }
}
