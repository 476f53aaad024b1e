/* Planes through inverse depths in squares of an image: see core/slants.py. */
#include <string.h>

#include "common.h"

/* Sums over a square of weights, and of u, v, uu, uv, vv, r, ur, vr times these. */
enum { SUMS = 9 };

/* Value of a plane at u = v = 0, its slopes along both, and the decrease of the sum of squares
   by these: slants._planes. */
typedef struct {
    double level, along_u, along_v, improvement;
} Plane;

/* Fit the plane to the points of a square, by its sums. prior_slope: see djet_planes. */
static Plane plane_of(const double sums[SUMS], double prior_slope)
{
    const double n = sums[0], u = sums[1], v = sums[2], level = sums[6] / n;
    const double deviation = prior_slope * level, square = deviation * deviation;
    const double prior = 1 / (square > 1e-18 ? square : 1e-18);
    const double uu = sums[3] - u * u / n + prior, uv = sums[4] - u * v / n,
                 vv = sums[5] - v * v / n + prior;
    const double ur = sums[7] - u * level, vr = sums[8] - v * level;
    const double scale = 1 / (uu * vv - uv * uv);
    const double along_u = (vv * ur - uv * vr) * scale, along_v = (uu * vr - uv * ur) * scale;
    const Plane plane = {level - (along_u * u + along_v * v) / n, along_u, along_v,
                         along_u * ur + along_v * vr};
    return plane;
}

/* Square of three standard deviations, within which points are inliers. */
static const double INLIER = 9;

/* Planes (n, 4) around points at u, v >= 0 (n,) of inverse depths r (n,), in squares of side
   two that overlap by half, and the squared residuals (n,) of r times `trusted` (n,). Fitted by
   `rounds` of iteratively reweighted least squares with a Cauchy loss. counts: (n,) numbers of
   inliers in the square of each point. columns, rows: of quarters that hold all points, with
   one more on each side; memory: (14, rows columns). prior_slope: prior standard deviation of the
   slopes, relative to the mean value. */
WIDE void djet_planes(int n, const double *u, const double *v, const double *r,
                      const double *trusted, int columns, int rows, int rounds, double prior_slope,
                      double *memory, double *squared, double (*planes)[4], double *counts)
{
    const int quarters = columns * rows;
    double (*sums)[SUMS] = (double (*)[SUMS])memory;
    Plane *of_squares = (Plane *)(memory + SUMS * quarters);
    double *inliers = memory + (SUMS + 4) * quarters;
    memset(inliers, 0, (size_t)quarters * sizeof *inliers);
    for (int round = 0; round < rounds; round++) {
        memset(sums, 0, (size_t)quarters * sizeof *sums);
        for (int k = 0; k < n; k++) {
            const double weight = round ? trusted[k] / (1 + squared[k] / 4) : trusted[k];
            const double terms[SUMS] = {1, u[k], v[k], u[k] * u[k], u[k] * v[k], v[k] * v[k],
                                        r[k], u[k] * r[k], v[k] * r[k]};
            double *quarter = sums[((int)v[k] + 1) * columns + (int)u[k] + 1];
            for (int i = 0; i < SUMS; i++)
                quarter[i] += weight * terms[i];
        }
        for (int square = 0; square < quarters - columns - 1; square++) {
            double of_square[SUMS];
            for (int i = 0; i < SUMS; i++)
                of_square[i] = (sums[square + columns + 1][i] + sums[square + 1][i])
                               + (sums[square + columns][i] + sums[square][i]);
            of_squares[square] = plane_of(of_square, prior_slope);
        }
        for (int k = 0; k < n; k++) {
            const Plane *plane = of_squares + (int)rint(v[k]) * columns + (int)rint(u[k]);
            const double residual =
                r[k] - plane->level - plane->along_u * u[k] - plane->along_v * v[k];
            squared[k] = residual * residual * trusted[k];
            memcpy(planes[k], plane, sizeof *plane);
        }
    }
    for (int k = 0; k < n; k++)
        inliers[((int)v[k] + 1) * columns + (int)u[k] + 1] += squared[k] < INLIER;
    for (int k = 0; k < n; k++) {
        const double *at = inliers + (int)rint(v[k]) * columns + (int)rint(u[k]);
        counts[k] = at[0] + at[1] + at[columns] + at[columns + 1];
    }
}
