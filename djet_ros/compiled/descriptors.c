/* Descriptors and their distances: see core/hamming.py and core/features.py. */
#include "common.h"

/* Number of tests, and of 64-bit words of a descriptor. */
enum { TESTS = 256, WORDS = TESTS / 64 };

/* Offsets of both ends of each test from a pixel, in images of one width. */
typedef struct {
    int32_t first[TESTS], second[TESTS];
} Ends;

INLINE Ends endpoints_of(const int64_t (*tests)[4], int width)
{
    Ends ends;
    for (int t = 0; t < TESTS; t++) {
        ends.first[t] = (int32_t)(tests[t][1] * width + tests[t][0]);
        ends.second[t] = (int32_t)(tests[t][3] * width + tests[t][2]);
    }
    return ends;
}

/* The pixel nearest to a point; null if its descriptor would leave the image. */
INLINE const uint8_t *pixel_at(const uint8_t *gray, int height, int width, const double point[2],
                               int reach)
{
    const double x = rint(point[0]), y = rint(point[1]);
    const int inside = x >= reach && x < width - reach && y >= reach && y < height - reach;
    return inside ? gray + (int64_t)y * width + (int64_t)x : 0;
}

/* Hamming distances (n,) of descriptors at the pixels nearest to x (n, 2) of one image (height,
   width) and y (n, 2) of another; NaN if one of them has none. tests: (TESTS, 4), which reach
   at most `reach` pixels. */
WIDE void djet_match_distances(const uint8_t *previous, const uint8_t *current, int height,
                               int width, int n, const double (*x)[2], const double (*y)[2],
                               const int64_t (*tests)[4], int reach, double *distances)
{
    const Ends ends = endpoints_of(tests, width);
    for (int k = 0; k < n; k++) {
        const uint8_t *a = pixel_at(previous, height, width, x[k], reach),
                      *b = pixel_at(current, height, width, y[k], reach);
        int differing = 0;
        /* Outcomes are the signs of differences. */
        for (int t = 0; a && b && t < TESTS; t++)
            differing += ((a[ends.first[t]] - a[ends.second[t]])
                          ^ (b[ends.first[t]] - b[ends.second[t]])) < 0;
        distances[k] = a && b ? differing : NAN;
    }
}

/* Most similar features of two images. Similarity: 64 less half of the Hamming distance, less
   the squared distance in the image. Only features in the same of `strips` (m, 4) are compared:
   ranges [first, last) in both images. Writes `nearest` and `best_previous` for the one image, -1
   and -infinity if there is none, and `best_current` for the other one. */
WIDE void djet_most_similar(int m, const int64_t (*strips)[4], int n_previous, int n_current,
                            const uint64_t (*previous)[WORDS], const float (*x)[2],
                            const uint64_t (*current)[WORDS], const float (*y)[2],
                            int64_t *nearest, float *best_previous, float *best_current)
{
    for (int i = 0; i < n_previous; i++) {
        nearest[i] = -1;
        best_previous[i] = -INFINITY;
    }
    for (int j = 0; j < n_current; j++)
        best_current[j] = -INFINITY;
    for (int s = 0; s < m; s++)
        for (int64_t i = strips[s][0]; i < strips[s][1]; i++) {
            const uint64_t bits[WORDS] = {previous[i][0], previous[i][1], previous[i][2],
                                          previous[i][3]};
            const float x_i = x[i][0], y_i = x[i][1];
            float best = best_previous[i];
            int64_t index = nearest[i];
            for (int64_t j = strips[s][2]; j < strips[s][3]; j++) {
                int differing = 0;
                for (int word = 0; word < WORDS; word++)
                    differing += __builtin_popcountll(bits[word] ^ current[j][word]);
                const float dx = x_i - y[j][0], dy = y_i - y[j][1];
                const float similarity = 64 - 0.5f * differing - (dx * dx + dy * dy);
                index = similarity > best ? j : index;
                best = similarity > best ? similarity : best;
                best_current[j] = similarity > best_current[j] ? similarity : best_current[j];
            }
            best_previous[i] = best;
            nearest[i] = index;
        }
}

/* Descriptors (n, TESTS / 8) at pixels (n, 2) of an image, which has room for them; the lowest
   bit of each byte first. */
WIDE void djet_describe(const uint8_t *gray, int width, int n, const int64_t (*pixels)[2],
                        const int64_t (*tests)[4], uint8_t (*descriptors)[TESTS / 8])
{
    const Ends ends = endpoints_of(tests, width);
    for (int k = 0; k < n; k++) {
        const uint8_t *centre = gray + pixels[k][1] * width + pixels[k][0];
        for (int byte = 0; byte < TESTS / 8; byte++) {
            int bits = 0;
            for (int bit = 0; bit < 8; bit++)
                bits |= (centre[ends.first[8 * byte + bit]] < centre[ends.second[8 * byte + bit]])
                        << bit;
            descriptors[k][byte] = (uint8_t)bits;
        }
    }
}
