/* Patch alignment through known warps: see core/patches.py. */
#include "between.h"

/* RADIUS is that of core/patches.py; LANES patches are aligned in parallel. */
enum { RADIUS = 5, SIDE = 2 * RADIUS + 1, PIXELS = SIDE * SIDE, ROOM = SIDE + 2, NEXT = SIDE + 1 };

typedef struct {
    Lanes slopes[2][PIXELS], gray[PIXELS], contrast;
    double inverse[LANES][2][2];
} Templates;

typedef struct {
    Lanes around[NEXT * NEXT], products[2][2][2];
    double whole[LANES][2];
} Seen;

INLINE Lanes products(const Lanes *a, const Lanes *b)
{
    Lanes sum = {0};
    for (int p = 0; p < PIXELS; p++)
        sum += a[p] * b[p];
    return sum;
}

INLINE void take_mean_off(Lanes *values)
{
    Lanes sum = {0};
    for (int p = 0; p < PIXELS; p++)
        sum += values[p];
    for (int p = 0; p < PIXELS; p++)
        values[p] -= sum / PIXELS;
}

/* Sample patches (ROOM x ROOM) around points: dy of the other image at x + inverse dy. */
INLINE void sample(Image image, const Lanes points[2], const Lanes inverse[2][2], Lanes *wide)
{
    for (int j = 0; j < ROOM; j++)
        for (int i = 0; i < ROOM; i++) {
            const float x = i - (RADIUS + 1), y = j - (RADIUS + 1);
            wide[j * ROOM + i] = between(image,
                                         inverse[0][0] * x + inverse[0][1] * y + points[0],
                                         inverse[1][0] * x + inverse[1][1] * y + points[1]);
        }
}

INLINE void make_templates(const Lanes *wide, float least_slope, Templates *to)
{
    for (int j = 0; j < SIDE; j++)
        for (int i = 0; i < SIDE; i++) {
            const Lanes *here = wide + (j + 1) * ROOM + i + 1;
            const int p = j * SIDE + i;
            to->gray[p] = here[0];
            to->slopes[0][p] = (here[1] - here[-1]) * 0.5f;
            to->slopes[1][p] = (here[ROOM] - here[-ROOM]) * 0.5f;
        }
    take_mean_off(to->gray);
    to->contrast = products(to->gray, to->gray) + least_slope;
    for (int k = 0; k < 2; k++) {
        const Lanes share = products(to->slopes[k], to->gray) / to->contrast;
        for (int p = 0; p < PIXELS; p++)
            to->slopes[k][p] -= share * to->gray[p];
        take_mean_off(to->slopes[k]);
    }
    const Lanes xx = products(to->slopes[0], to->slopes[0]),
                xy = products(to->slopes[0], to->slopes[1]),
                yy = products(to->slopes[1], to->slopes[1]);
    for (int l = 0; l < LANES; l++) {
        const double a = (double)xx[l] + least_slope, b = xy[l], d = (double)yy[l] + least_slope;
        const double area = a * d - b * b;
        to->inverse[l][0][0] = d / area;
        to->inverse[l][0][1] = to->inverse[l][1][0] = -b / area;
        to->inverse[l][1][1] = a / area;
    }
}

INLINE void gather(const uint8_t *image, int width, const double *place, int l, Seen *seen)
{
    for (int axis = 0; axis < 2; axis++)
        seen->whole[l][axis] = floor(place[axis]);
    const uint8_t *first = image + ((int64_t)seen->whole[l][1] - RADIUS) * width
                           + (int64_t)seen->whole[l][0] - RADIUS;
    for (int j = 0; j < NEXT; j++)
        for (int i = 0; i < NEXT; i++)
            seen->around[j * NEXT + i][l] = first[(int64_t)j * width + i];
}

/* Sum products of gradients and of patches at four pixels. */
INLINE void multiply(const Templates *expected, Seen *seen)
{
    for (int y = 0; y < 2; y++)
        for (int x = 0; x < 2; x++) {
            Lanes sums[2] = {{0}, {0}};
            for (int j = 0; j < SIDE; j++)
                for (int i = 0; i < SIDE; i++)
                    for (int k = 0; k < 2; k++)
                        sums[k] += expected->slopes[k][j * SIDE + i]
                                   * seen->around[(j + y) * NEXT + i + x];
            seen->products[y][x][0] = sums[0];
            seen->products[y][x][1] = sums[1];
        }
}

/* Move patches to new positions; few of them move to other pixels. */
INLINE void follow(const uint8_t *image, int width, const double (*places)[2],
                   const Templates *expected, Seen *seen)
{
    int crossed = 0;
    for (int l = 0; l < LANES; l++)
        if (floor(places[l][0]) != seen->whole[l][0] || floor(places[l][1]) != seen->whole[l][1]) {
            gather(image, width, places[l], l, seen);
            crossed = 1;
        }
    if (crossed)
        multiply(expected, seen);
}

INLINE double interpolated(const Seen *seen, int k, int l, double x, double y)
{
    double rows[2];
    for (int i = 0; i < 2; i++) {
        const double top = seen->products[0][i][k][l];
        rows[i] = top + y * (seen->products[1][i][k][l] - top);
    }
    return rows[0] + x * (rows[1] - rows[0]);
}

/* Residuals of patches after fitting their brightness and contrast: sums of squares. */
INLINE Lanes left_over(const Templates *expected, const Seen *seen, const double (*places)[2])
{
    Lanes patches[PIXELS];
    float parts[2][LANES];
    for (int l = 0; l < LANES; l++)
        for (int axis = 0; axis < 2; axis++)
            parts[axis][l] = (float)(places[l][axis] - seen->whole[l][axis]);
    const Lanes x = load(parts[0]), y = load(parts[1]);
    for (int j = 0; j < SIDE; j++)
        for (int i = 0; i < SIDE; i++) {
            const Lanes *here = seen->around + j * NEXT + i;
            const Lanes first = here[0] + y * (here[NEXT] - here[0]);
            const Lanes second = here[1] + y * (here[NEXT + 1] - here[1]);
            patches[j * SIDE + i] = first + x * (second - first);
        }
    take_mean_off(patches);
    const Lanes alike = products(patches, expected->gray);
    return products(patches, patches) - alike * alike / expected->contrast;
}

/* djet_place, for patches [from, to) of one image. */
INLINE void place_some(const uint8_t *there, int64_t from, int64_t to, int there_height,
                       int there_width, const uint8_t *here, int here_width,
                       const float (*points)[2], const float (*inverse)[2][2],
                       const double (*began)[2], const uint8_t *inside, const double *tuning,
                       double (*places)[2], double *variances, double (*inverses)[2][2])
{
    const Image image = {there, 1, there_height, there_width};
    const double least_noise = tuning[1], steps = tuning[2], farthest = tuning[3], fitted = 4;
    for (int64_t first = from; first < to; first += LANES) {
        const int count = to - first < LANES ? (int)(to - first) : LANES;
        double at_first[LANES][2], at[LANES][2];
        for (int l = 0; l < LANES; l++)
            for (int axis = 0; axis < 2; axis++)
                at[l][axis] = at_first[l][axis] = began[first + (l < count ? l : count - 1)][axis];
        Lanes wide[ROOM * ROOM];
        Templates expected;
        Seen seen;
        const float *W = inverse[first][0];
        const Lanes points_of[2] = {gathered(points[first], 2, count),
                                    gathered(points[first] + 1, 2, count)};
        const Lanes inverse_of[2][2] = {
            {gathered(W, 4, count), gathered(W + 1, 4, count)},
            {gathered(W + 2, 4, count), gathered(W + 3, 4, count)}};
        sample(image, points_of, inverse_of, wide);
        make_templates(wide, (float)tuning[0], &expected);
        for (int l = 0; l < LANES; l++)
            gather(here, here_width, at[l], l, &seen);
        multiply(&expected, &seen);
        for (int step = 0; step < steps; step++) {
            follow(here, here_width, (const double (*)[2])at, &expected, &seen);
            for (int l = 0; l < LANES; l++) {
                const double x = at[l][0] - seen.whole[l][0], y = at[l][1] - seen.whole[l][1];
                const double along[2] = {interpolated(&seen, 0, l, x, y),
                                         interpolated(&seen, 1, l, x, y)};
                for (int axis = 0; axis < 2; axis++) {
                    const double to = at[l][axis] - (expected.inverse[l][axis][0] * along[0]
                                                     + expected.inverse[l][axis][1] * along[1]);
                    at[l][axis] = fmin(fmax(to, at_first[l][axis] - farthest),
                                       at_first[l][axis] + farthest);
                }
            }
        }
        for (int l = 0; l < count; l++) {
            const int near = inside[first + l] && fabs(at[l][0] - at_first[l][0]) < farthest
                             && fabs(at[l][1] - at_first[l][1]) < farthest;
            for (int axis = 0; axis < 2; axis++)
                places[first + l][axis] = at[l][axis] = near ? at[l][axis] : at_first[l][axis];
        }
        follow(here, here_width, (const double (*)[2])at, &expected, &seen);
        const Lanes left = left_over(&expected, &seen, (const double (*)[2])at);
        for (int l = 0; l < count; l++) {
            const double variance = left[l] / (PIXELS - fitted);
            variances[first + l] = variance > least_noise ? variance : least_noise;
            for (int axis = 0; axis < 2; axis++) {
                inverses[first + l][axis][0] = expected.inverse[l][axis][0];
                inverses[first + l][axis][1] = expected.inverse[l][axis][1];
            }
        }
    }
}

/* Align patches of some gray images `there` with another one, starting from `began` (n, 2),
   where there is room for the steps. there: (I,) of one size, with `counts` patches each, in
   order; tuning: regularisation, least noise, number of steps, and largest displacement;
   inside: (n,) those that may move. Writes positions (n, 2), variances (n,) of a pixel, and
   inverse normal matrices (n, 2, 2). */
WIDE void djet_place(int I, const uint8_t *const *there, const int64_t *counts, int there_height,
                     int there_width, const uint8_t *here, int here_width,
                     const float (*points)[2], const float (*inverse)[2][2],
                     const double (*began)[2], const uint8_t *inside, const double *tuning,
                     double (*places)[2], double *variances, double (*inverses)[2][2])
{
    for (int64_t i = 0, first = 0; i < I; first += counts[i++])
        place_some(there[i], first, first + counts[i], there_height, there_width, here, here_width,
                   points, inverse, began, inside, tuning, places, variances, inverses);
}
