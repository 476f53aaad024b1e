/* Patch alignment through known warps: see core/patches.py. */
#include "between.h"

/* RADIUS and PARAMETERS (position, brightness and contrast) are those of core/patches.py. A
   template is sampled with a pixel more on each side, for its gradients, and a patch of the
   current image with one more row and column, for interpolation. LANES patches are aligned in
   parallel. */
enum { RADIUS = 5, SIDE = 2 * RADIUS + 1, PIXELS = SIDE * SIDE, PARAMETERS = 4 };
enum { PADDED = SIDE + 2, EXTENDED = SIDE + 1 };

/* core.patches.Templates. */

typedef struct {
    Lanes slopes[2][PIXELS], gray[PIXELS], contrast;
    double inverse[LANES][2][2];
} Templates;

/* Patches of the current image around whole pixels, and products of them, at each of four
   neighbouring pixels, with the gradients of the templates. */
typedef struct {
    Lanes levels[EXTENDED * EXTENDED], products[2][2][2];
    double pixel[LANES][2];
} CurrentPatches;

/* Sums of products over the pixels of patches. */
INLINE Lanes products(const Lanes *a, const Lanes *b)
{
    Lanes sum = {0};
    for (int p = 0; p < PIXELS; p++)
        sum += a[p] * b[p];
    return sum;
}

INLINE void subtract_mean(Lanes *values)
{
    Lanes sum = {0};
    for (int p = 0; p < PIXELS; p++)
        sum += values[p];
    for (int p = 0; p < PIXELS; p++)
        values[p] -= sum / PIXELS;
}

/* Sample patches (PADDED x PADDED) around points: dy of the other image at x + inverse dy. */
INLINE void sample(Image image, const Lanes points[2], const Lanes inverse[2][2], Lanes *wide)
{
    for (int j = 0; j < PADDED; j++)
        for (int i = 0; i < PADDED; i++) {
            const float x = i - (RADIUS + 1), y = j - (RADIUS + 1);
            wide[j * PADDED + i] =
                between(image, inverse[0][0] * x + inverse[0][1] * y + points[0],
                        inverse[1][0] * x + inverse[1][1] * y + points[1]);
        }
}

/* Make templates of sampled patches (PADDED x PADDED). */
INLINE void make_templates(const Lanes *wide, float least_slope, Templates *to)
{
    for (int j = 0; j < SIDE; j++)
        for (int i = 0; i < SIDE; i++) {
            const Lanes *at = wide + (j + 1) * PADDED + i + 1;
            const int p = j * SIDE + i;
            to->gray[p] = at[0];
            to->slopes[0][p] = (at[1] - at[-1]) * 0.5f;
            to->slopes[1][p] = (at[PADDED] - at[-PADDED]) * 0.5f;
        }
    subtract_mean(to->gray);
    to->contrast = products(to->gray, to->gray) + least_slope;
    for (int k = 0; k < 2; k++) {
        const Lanes share = products(to->slopes[k], to->gray) / to->contrast;
        for (int p = 0; p < PIXELS; p++)
            to->slopes[k][p] -= share * to->gray[p];
        subtract_mean(to->slopes[k]);
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

/* Copy the patch around the pixel of a position (2,) into lane l. */
INLINE void gather(const uint8_t *image, int width, const double *place, int l,
                   CurrentPatches *current)
{
    for (int axis = 0; axis < 2; axis++)
        current->pixel[l][axis] = floor(place[axis]);
    const uint8_t *first = image + ((int64_t)current->pixel[l][1] - RADIUS) * width
                           + (int64_t)current->pixel[l][0] - RADIUS;
    for (int j = 0; j < EXTENDED; j++)
        for (int i = 0; i < EXTENDED; i++)
            current->levels[j * EXTENDED + i][l] = first[(int64_t)j * width + i];
}

/* Sum products of gradients and of patches at four pixels. */
INLINE void multiply(const Templates *expected, CurrentPatches *current)
{
    for (int y = 0; y < 2; y++)
        for (int x = 0; x < 2; x++) {
            Lanes sums[2] = {{0}, {0}};
            for (int j = 0; j < SIDE; j++)
                for (int i = 0; i < SIDE; i++)
                    for (int k = 0; k < 2; k++)
                        sums[k] += expected->slopes[k][j * SIDE + i]
                                   * current->levels[(j + y) * EXTENDED + i + x];
            current->products[y][x][0] = sums[0];
            current->products[y][x][1] = sums[1];
        }
}

/* Move patches to new positions; few of them move to other pixels. */
INLINE void move_patches(const uint8_t *image, int width, const double (*places)[2],
                         const Templates *expected, CurrentPatches *current)
{
    int changed = 0;
    for (int l = 0; l < LANES; l++)
        if (floor(places[l][0]) != current->pixel[l][0]
            || floor(places[l][1]) != current->pixel[l][1]) {
            gather(image, width, places[l], l, current);
            changed = 1;
        }
    if (changed)
        multiply(expected, current);
}

/* Product with gradient k in lane l, at the fraction (x, y) of a pixel. */
INLINE double interpolated(const CurrentPatches *current, int k, int l, double x, double y)
{
    double rows[2];
    for (int i = 0; i < 2; i++) {
        const double top = current->products[0][i][k][l];
        rows[i] = top + y * (current->products[1][i][k][l] - top);
    }
    return rows[0] + x * (rows[1] - rows[0]);
}

/* Sums of squared residuals of patches at positions (LANES, 2), after fitting their brightness
   and contrast. */
INLINE Lanes residual_sums(const Templates *expected, const CurrentPatches *current,
                           const double (*places)[2])
{
    Lanes gray[PIXELS];
    float parts[2][LANES];
    for (int l = 0; l < LANES; l++)
        for (int axis = 0; axis < 2; axis++)
            parts[axis][l] = (float)(places[l][axis] - current->pixel[l][axis]);
    const Lanes x = load(parts[0]), y = load(parts[1]);
    for (int j = 0; j < SIDE; j++)
        for (int i = 0; i < SIDE; i++) {
            const Lanes *level = current->levels + j * EXTENDED + i;
            const Lanes first = level[0] + y * (level[EXTENDED] - level[0]);
            const Lanes second = level[1] + y * (level[EXTENDED + 1] - level[1]);
            gray[j * SIDE + i] = first + x * (second - first);
        }
    subtract_mean(gray);
    const Lanes product = products(gray, expected->gray);
    return products(gray, gray) - product * product / expected->contrast;
}

/* djet_align, for patches [from, to) of one image `gray` (height, width). */
INLINE void align_patches(const uint8_t *gray, int64_t from, int64_t to, int height, int width,
                          const uint8_t *current, int current_width, const float (*points)[2],
                          const float (*inverse)[2][2], const double (*start)[2],
                          const uint8_t *inside, const double *tuning, double (*places)[2],
                          double *variances, double (*inverses)[2][2])
{
    const Image image = {gray, 1, height, width};
    const double least_noise = tuning[1], steps = tuning[2], max_shift = tuning[3];
    for (int64_t first = from; first < to; first += LANES) {
        const int count = to - first < LANES ? (int)(to - first) : LANES;
        double initial[LANES][2], position[LANES][2];
        for (int l = 0; l < LANES; l++)
            for (int axis = 0; axis < 2; axis++)
                position[l][axis] = initial[l][axis] =
                    start[first + (l < count ? l : count - 1)][axis];
        Lanes wide[PADDED * PADDED];
        Templates expected;
        CurrentPatches patches;
        const float *W = inverse[first][0];
        const Lanes points_of[2] = {gathered(points[first], 2, count),
                                    gathered(points[first] + 1, 2, count)};
        const Lanes inverse_of[2][2] = {
            {gathered(W, 4, count), gathered(W + 1, 4, count)},
            {gathered(W + 2, 4, count), gathered(W + 3, 4, count)}};
        sample(image, points_of, inverse_of, wide);
        make_templates(wide, (float)tuning[0], &expected);
        for (int l = 0; l < LANES; l++)
            gather(current, current_width, position[l], l, &patches);
        multiply(&expected, &patches);
        for (int step = 0; step < steps; step++) {
            move_patches(current, current_width, (const double (*)[2])position, &expected,
                         &patches);
            for (int l = 0; l < LANES; l++) {
                const double x = position[l][0] - patches.pixel[l][0],
                             y = position[l][1] - patches.pixel[l][1];
                const double along[2] = {interpolated(&patches, 0, l, x, y),
                                         interpolated(&patches, 1, l, x, y)};
                for (int axis = 0; axis < 2; axis++) {
                    const double moved = position[l][axis]
                                         - (expected.inverse[l][axis][0] * along[0]
                                            + expected.inverse[l][axis][1] * along[1]);
                    position[l][axis] = fmin(fmax(moved, initial[l][axis] - max_shift),
                                             initial[l][axis] + max_shift);
                }
            }
        }
        for (int l = 0; l < count; l++) {
            const int converged = inside[first + l]
                                  && fabs(position[l][0] - initial[l][0]) < max_shift
                                  && fabs(position[l][1] - initial[l][1]) < max_shift;
            for (int axis = 0; axis < 2; axis++)
                places[first + l][axis] = position[l][axis] =
                    converged ? position[l][axis] : initial[l][axis];
        }
        move_patches(current, current_width, (const double (*)[2])position, &expected, &patches);
        const Lanes left = residual_sums(&expected, &patches, (const double (*)[2])position);
        for (int l = 0; l < count; l++) {
            const double variance = (double)left[l] / (PIXELS - PARAMETERS);
            variances[first + l] = variance > least_noise ? variance : least_noise;
            for (int axis = 0; axis < 2; axis++) {
                inverses[first + l][axis][0] = expected.inverse[l][axis][0];
                inverses[first + l][axis][1] = expected.inverse[l][axis][1];
            }
        }
    }
}

/* Align patches of some gray images with another one, starting from `start` (n, 2), where
   there is room for the steps. images: (I,) of one size, with `counts` patches each, in
   order; tuning: regularisation, least noise, number of steps, and largest displacement;
   inside: (n,) those that may move. Writes positions (n, 2), variances (n,) of a pixel, and
   inverse normal matrices (n, 2, 2). */
WIDE void djet_align(int I, const uint8_t *const *images, const int64_t *counts, int height,
                     int width, const uint8_t *current, int current_width,
                     const float (*points)[2], const float (*inverse)[2][2],
                     const double (*start)[2], const uint8_t *inside, const double *tuning,
                     double (*places)[2], double *variances, double (*inverses)[2][2])
{
    for (int64_t i = 0, first = 0; i < I; first += counts[i++])
        align_patches(images[i], first, first + counts[i], height, width, current, current_width,
                      points, inverse, start, inside, tuning, places, variances, inverses);
}
