/* Graded descriptors seen through warps, and their distances in windows: see core/graded.py and
   core/hamming.py. */
#include "between.h"

/* Limits: tests, test points, pixels from the centre of a window to the farthest test point,
   and the side of a patch. */
enum {
    MOST_TESTS = 256,
    MOST_ENDS = 2 * MOST_TESTS,
    FARTHEST = 13 + 7,
    MOST_SIDE = 2 * FARTHEST + 1
};

/* Points whose windows are computed in parallel, and the largest window. */
enum { POINTS = 16, MOST_WINDOW = 15 };
typedef int16_t Grades __attribute__((vector_size(POINTS * sizeof(int16_t))));
typedef uint16_t Sums __attribute__((vector_size(POINTS * sizeof(uint16_t))));

/* djet_warped_grades, for patches [from, to) of one image. */
INLINE void grade_patches(const int16_t *pixels, int64_t from, int64_t to, int height, int width,
                          int n, const float *inverse, const float *nearer, float max_depth_ratio,
                          const float *points, const float *contrast, int E,
                          const float (*ends)[2], int T, const int64_t *of_tests, int reach,
                          int16_t *grades)
{
    /* Adding and subtracting it rounds numbers far below it: floats from there on are integers. */
    const float rounding = 3 << 22;
    const Image image = {pixels, sizeof *pixels, height, width};
    for (int64_t first = from; first < to; first += LANES) {
        const int count = to - first < LANES ? (int)(to - first) : LANES;
        const float *W = inverse + 4 * first, *c = nearer + 2 * first, *at = points + 2 * first;
        const Lanes xx = gathered(W, 4, count), xy = gathered(W + 1, 4, count),
                    yx = gathered(W + 2, 4, count), yy = gathered(W + 3, 4, count),
                    by_x = gathered(c, 2, count), by_y = gathered(c + 1, 2, count),
                    x = gathered(at, 2, count), y = gathered(at + 1, 2, count),
                    strength = gathered(contrast + first, 1, count);
        Lanes samples[MOST_ENDS];
        for (int e = 0; e < E; e++) {
            const float dx = ends[e][0], dy = ends[e][1];
            const Lanes depth = clipped(1 - (by_x * dx + by_y * dy), 1 / max_depth_ratio,
                                        max_depth_ratio);
            samples[e] =
                between(image, x + (xx * dx + xy * dy) / depth, y + (yx * dx + yy * dy) / depth);
        }
        for (int t = 0; t < T; t++) {
            const Lanes differences = (samples[of_tests[t]] - samples[of_tests[T + t]]) * strength;
            const Lanes rounded = clipped((differences + rounding) - rounding, -reach, reach);
            for (int l = 0; l < count; l++)
                grades[(int64_t)t * n + first + l] = (int16_t)rounded[l];
        }
    }
}

/* Grades (T, n) of T tests on patches seen through warps: dx = u / (1 - nearer . u), with u =
   inverse dy, for the test points dy. images: (I,) of one size, with `counts` patches each, in
   order; inverse: (n, 2, 2); nearer: (n, 2), 0 if negligible; contrast: (n,); ends: (E, 2)
   distinct test points; of_tests: (2, T) indices of each test. */
WIDE void djet_warped_grades(int I, const int16_t *const *images, const int64_t *counts,
                             int height, int width, int n, const float *inverse,
                             const float *nearer, float max_depth_ratio, const float *points,
                             const float *contrast, int E, const float (*ends)[2], int T,
                             const int64_t *of_tests, int reach, int16_t *grades)
{
    for (int64_t i = 0, first = 0; i < I; first += counts[i++])
        grade_patches(images[i], first, first + counts[i], height, width, n, inverse, nearer,
                      max_depth_ratio, points, contrast, E, ends, T, of_tests, reach, grades);
}

/* Copy the patches of side x side pixels around some centres, points last. */
INLINE void gather(const int16_t *image, int width, const int64_t (*centres)[2], int count,
                   int side, Grades *patches)
{
    const int16_t *from[POINTS];
    for (int l = 0; l < POINTS; l++) {
        const int64_t *centre = centres[l < count ? l : count - 1];
        from[l] = image + (centre[1] - side / 2) * width + centre[0] - side / 2;
    }
    /* Points in the inner loop: writing at strides of a line of the cache takes twice as long. */
    int16_t *to = (int16_t *)patches;
    for (int j = 0; j < side; j++)
        for (int i = 0; i < side; i++)
            for (int l = 0; l < POINTS; l++)
                to[(j * side + i) * POINTS + l] = from[l][(int64_t)j * width + i];
}

/* Add the differences of a test from its reference, at all pixels of windows. */
INLINE void add_test(const Grades *p, const Grades *q, int side, int window, Grades reference,
                     int16_t reach, Sums *sums)
{
    const Grades most = reference * 0 + reach, least = -most;
    for (int j = 0; j < window; j++)
        for (int i = 0; i < window; i++) {
            Grades grade = p[j * side + i] - q[j * side + i];
            grade = ((grade < most) & grade) | (~(grade < most) & most);
            grade = ((grade > least) & grade) | (~(grade > least) & least);
            const Grades difference = grade - reference, sign = difference >> 15;
            sums[j * window + i] += (Sums)((difference ^ sign) - sign);
        }
}

/* Distances (P, P, n) of T graded tests, P = 2 radius + 1, between references (T, n) and all
   pixels of windows around centres (n, 2). tests: (T, 4), which reach at most `far` pixels; all
   test points lie in the image. */
WIDE void djet_graded_surfaces(const int16_t *reference, const int16_t *image, int width, int n,
                               const int64_t (*centres)[2], int radius, int T,
                               const int64_t (*tests)[4], int far, int reach, float *distances)
{
    const int window = 2 * radius + 1, side = 2 * (far + radius) + 1;
    /* As many tests at once as can be summed in 16 bits. */
    const int at_once = UINT16_MAX / (2 * reach);
    Grades patches[MOST_SIDE * MOST_SIDE];
    for (int first = 0; first < n; first += POINTS) {
        const int count = n - first < POINTS ? n - first : POINTS;
        uint32_t total[MOST_WINDOW * MOST_WINDOW][POINTS] = {{0}};
        gather(image, width, centres + first, count, side, patches);
        for (int begin = 0; begin < T; begin += at_once) {
            Sums sums[MOST_WINDOW * MOST_WINDOW] = {{0}};
            for (int t = begin; t < T && t < begin + at_once; t++) {
                const int16_t *from = reference + (int64_t)t * n + first;
                Grades of_test = {0};
                /* Of a constant size, a copy is a single load. */
                if (count == POINTS)
                    memcpy(&of_test, from, sizeof of_test);
                else
                    memcpy(&of_test, from, (size_t)count * sizeof *from);
                const int64_t *ends = tests[t];
                const Grades *p = patches + (ends[1] + far) * side + ends[0] + far;
                const Grades *q = patches + (ends[3] + far) * side + ends[2] + far;
                if (window == 3)
                    add_test(p, q, side, 3, of_test, (int16_t)reach, sums);
                else if (window == 5)
                    add_test(p, q, side, 5, of_test, (int16_t)reach, sums);
                else
                    add_test(p, q, side, window, of_test, (int16_t)reach, sums);
            }
            for (int v = 0; v < window * window; v++)
                for (int l = 0; l < POINTS; l++)
                    total[v][l] += sums[v][l];
        }
        for (int v = 0; v < window * window; v++)
            for (int l = 0; l < count; l++)
                distances[(int64_t)v * n + first + l] = (float)total[v][l] / (float)(2 * reach);
    }
}
