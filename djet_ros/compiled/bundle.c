/* Residuals of the sliding window, and its normal equations with landmarks eliminated: see
   core/bundle.py. */
#include <string.h>

#include "common.h"

/* One observation: X/Z, Y/Z; its residuals (2,), and their Jacobians by the steps of both
   poses, and by the landmark's inverse depth and point, all times the root of its weight. */
typedef struct {
    double u[2], e[2], by_frame[2][6], by_anchor[2][6], by_own[2][3];
} Row;

/* A camera matrix (3, 3) and its inverse, and the limits of projections: see core/bundle.py. */
typedef struct {
    const double *K, *K_inverse;
    double nearest, far_out;
} Camera;

/* Parameters of a correction of the camera: see core/correction.py. */
enum { OF_CAMERA = 4 };

INLINE double limited(double value, double most)
{
    return value > most ? most : value < -most ? -most : value;
}

INLINE double depth_of(const Camera *camera, const double place[3])
{
    return place[2] > camera->nearest ? place[2] : camera->nearest;
}

/* The residual (2,) of a point and an observed pixel, whitened by a root (2, 2). */
INLINE void whitened_residual(const Camera *camera, const double place[3], const double pixel[2],
                              const double *root, double *residual)
{
    const double depth = depth_of(camera, place), x = place[0] / depth, y = place[1] / depth;
    double error[2];
    for (int i = 0; i < 2; i++) {
        const double *row = camera->K + 3 * i;
        error[i] = limited(row[0] * x + row[1] * y + row[2], camera->far_out) - pixel[i];
    }
    for (int i = 0; i < 2; i++)
        residual[i] = root[2 * i] * error[0] + root[2 * i + 1] * error[1];
}

/* bundle._by_camera, of one root (2, 2) at u, times a factor. */
INLINE void by_camera(const Camera *camera, const double u[2], const double *root, double factor,
                      double derivatives[2][OF_CAMERA])
{
    const double *K = camera->K, squared = u[0] * u[0] + u[1] * u[1];
    for (int i = 0; i < 2; i++) {
        double *row = derivatives[i];
        row[2] = factor * (root[2 * i] * K[0] + root[2 * i + 1] * K[3]);
        row[3] = factor * (root[2 * i] * K[1] + root[2 * i + 1] * K[4]);
        row[1] = row[2] * u[0] + row[3] * u[1];
        row[0] = row[1] * squared;
    }
}

/* bundle.observe: M observations of N landmarks by F frames. points: (N, 2) in the anchors;
   R_between (F, F, 3, 3) and t_between (F, F, 3) lead from each frame (second index) to each
   other one; minima (N, F, 2), roots (N, F, 2, 2); limits: least depth, and bound of pixels.
   Writes the anchor of each observation, and the fields of a bundle.Observed. */
WIDE void djet_observe(int M, int N, int F, const int64_t *landmark, const int64_t *frame,
                       const int64_t *anchors, const double *R_between, const double *t_between,
                       const double (*points)[2], const double *depths, const double *minima,
                       const double *roots, const double *anchor_roots,
                       const double (*anchor_pixels)[2], const double *K, const double *K_inverse,
                       const double *limits, int64_t *anchor, double (*residuals)[2],
                       double (*anchor_residuals)[2], double (*normalised)[2], double (*R)[9],
                       double (*t)[3], double (*ray)[3], double *rho, double (*place)[3],
                       double (*root)[4])
{
    const Camera camera = {K, K_inverse, limits[0], limits[1]};
    for (int n = 0; n < N; n++) {
        double ray_of_point[3] = {0, 0, 1};
        for (int i = 0; i < 2; i++)
            ray_of_point[i] = normalised[n][i] = points[n][0] * K_inverse[3 * i]
                                                 + points[n][1] * K_inverse[3 * i + 1]
                                                 + K_inverse[3 * i + 2];
        whitened_residual(&camera, ray_of_point, anchor_pixels[n], anchor_roots + 4 * n,
                          anchor_residuals[n]);
    }
    for (int m = 0; m < M; m++) {
        const int64_t n = landmark[m], observation = n * F + frame[m];
        anchor[m] = anchors[n];
        const int64_t motion = frame[m] * F + anchor[m];
        memcpy(R[m], R_between + 9 * motion, sizeof R[m]);
        memcpy(t[m], t_between + 3 * motion, sizeof t[m]);
        memcpy(root[m], roots + 4 * observation, sizeof root[m]);
        rho[m] = depths[n];
        ray[m][0] = normalised[n][0];
        ray[m][1] = normalised[n][1];
        ray[m][2] = 1;
        for (int i = 0; i < 3; i++)
            place[m][i] = R[m][3 * i] * ray[m][0] + R[m][3 * i + 1] * ray[m][1]
                          + R[m][3 * i + 2] + rho[m] * t[m][i];
        whitened_residual(&camera, place[m], minima + 2 * observation, root[m], residuals[m]);
    }
}

INLINE int64_t larger(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static void cross(const double a[3], const double b[3], double product[3])
{
    product[0] = a[1] * b[2] - a[2] * b[1];
    product[1] = a[2] * b[0] - a[0] * b[2];
    product[2] = a[0] * b[1] - a[1] * b[0];
}

/* bundle.jacobians of one observation, times a factor. */
static void differentiate(const Camera *camera, const double *residuals, const double *R,
                          const double *t, const double *ray, double rho, const double *place,
                          const double *root, double factor, Row *row)
{
    const double *K = camera->K, *K_inverse = camera->K_inverse, depth = depth_of(camera, place);
    row->u[0] = place[0] / depth;
    row->u[1] = place[1] / depth;
    for (int i = 0; i < 2; i++) {
        double by_place[3], by_ray[3];
        for (int j = 0; j < 2; j++)
            by_place[j] =
                factor * (root[2 * i] * K[j] + root[2 * i + 1] * K[3 + j]) / depth;
        by_place[2] = -(by_place[0] * place[0] + by_place[1] * place[1]) / depth;
        for (int j = 0; j < 3; j++)
            by_ray[j] = by_place[0] * R[j] + by_place[1] * R[3 + j] + by_place[2] * R[6 + j];
        cross(place, by_place, row->by_frame[i]);
        cross(by_ray, ray, row->by_anchor[i]);
        for (int j = 0; j < 3; j++) {
            row->by_frame[i][3 + j] = by_place[j] * rho;
            row->by_anchor[i][3 + j] = -by_ray[j] * rho;
        }
        row->by_own[i][0] = by_place[0] * t[0] + by_place[1] * t[1] + by_place[2] * t[2];
        for (int j = 0; j < 2; j++)
            row->by_own[i][1 + j] = by_ray[0] * K_inverse[j] + by_ray[1] * K_inverse[3 + j]
                                    + by_ray[2] * K_inverse[6 + j];
        row->e[i] = factor * residuals[i];
    }
}

/* Add A^T B to a block of a matrix with rows of a given length. A: (2, rows), B: (2, columns). */
INLINE void add_block(double *block, int64_t length, const double *A, int rows, const double *B,
                      int columns)
{
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++)
            block[i * length + j] += A[i] * B[j] + A[rows + i] * B[columns + j];
}

/* Invert a positive definite matrix (3, 3), by L D L^T. */
static void invert(const double *A, double *inverse)
{
    const double d0 = A[0], l10 = A[3] / d0, l20 = A[6] / d0;
    const double d1 = A[4] - l10 * A[3], l21 = (A[7] - l20 * A[3]) / d1;
    const double d2 = A[8] - l20 * A[6] - l21 * l21 * d1;
    /* Rows of L^-1. */
    const double m10 = -l10, m20 = l21 * l10 - l20, m21 = -l21;
    inverse[0] = 1 / d0 + m10 * m10 / d1 + m20 * m20 / d2;
    inverse[1] = inverse[3] = m10 / d1 + m20 * m21 / d2;
    inverse[2] = inverse[6] = m20 / d2;
    inverse[4] = 1 / d1 + m21 * m21 / d2;
    inverse[5] = inverse[7] = m21 / d2;
    inverse[8] = 1 / d2;
}

/* Eliminate a landmark from the equations over camera and poses (Schur complement). C: (3, size)
   couples it with them, and is zero from column `end` on. */
INLINE void eliminate(int64_t size, int64_t end, const double *C, const double *variances,
                      const double *slopes, double *gain, double *H, double *g)
{
    for (int i = 0; i < 3; i++)
        for (int64_t k = 0; k < end; k++)
            gain[i * size + k] = variances[3 * i] * C[k] + variances[3 * i + 1] * C[size + k]
                                 + variances[3 * i + 2] * C[2 * size + k];
    for (int64_t j = 0; j < end; j++) {
        const double a = gain[j], b = gain[size + j], c = gain[2 * size + j];
        if (a == 0 && b == 0 && c == 0)
            continue;
        g[j] -= a * slopes[0] + b * slopes[1] + c * slopes[2];
        for (int64_t k = 0; k < end; k++)
            H[j * size + k] -= a * C[k] + b * C[size + k] + c * C[2 * size + k];
    }
}

/* bundle.eliminate: M observations of N landmarks by F frames, sorted by landmark. Adds to H
   (S, S), g (S,), coupling (N, 3, S) and slopes (N, 3), with S = OF_CAMERA + 6F; writes
   variances (N, 3, 3); gain: (3, S) scratch memory; limits: see djet_observe. */
WIDE void djet_eliminate(int M, int N, int F, const int64_t *landmark, const int64_t *frame,
                         const int64_t *anchor, const double *residuals,
                         const double *R, const double *t, const double *ray, const double *rho,
                         const double *place, const double *root, const double *weights,
                         const double (*normalised)[2], const double *anchor_roots,
                         const double *anchor_residuals, double weight, const double *K,
                         const double *K_inverse, const double *limits, double depth_information,
                         double *H, double *g, double *coupling, double *variances, double *slopes,
                         double *gain)
{
    const Camera camera = {K, K_inverse, limits[0], limits[1]};
    const int64_t size = OF_CAMERA + 6 * (int64_t)F;
    for (int n = 0, m = 0; n < N; n++) {
        double information[9] = {
            [0] = depth_information, [4] = depth_information, [8] = depth_information};
        double *C = coupling + 3 * size * n, *slope = slopes + 3 * n;
        const double *by_point = anchor_roots + 4 * n, root_of_common = sqrt(weight);
        double own[4], residual[2], moved[2][OF_CAMERA];
        for (int i = 0; i < 4; i++)
            own[i] = root_of_common * by_point[i];
        for (int i = 0; i < 2; i++)
            residual[i] = root_of_common * anchor_residuals[2 * n + i];
        add_block(information + 4, 3, own, 2, own, 2);
        add_block(slope + 1, 1, own, 2, residual, 1);
        by_camera(&camera, normalised[n], by_point, root_of_common, moved);
        add_block(H, size, moved[0], OF_CAMERA, moved[0], OF_CAMERA);
        add_block(g, 1, moved[0], OF_CAMERA, residual, 1);
        add_block(C + size, size, own, 2, moved[0], OF_CAMERA);
        /* Past the columns of the frames that observe the landmark. */
        int64_t end = OF_CAMERA;
        for (; m < M && landmark[m] == n; m++) {
            const double root_of_weight = sqrt(weights[m]);
            Row row;
            differentiate(&camera, residuals + 2 * m, R + 9 * m, t + 3 * m, ray + 3 * m, rho[m],
                          place + 3 * m, root + 4 * m, root_of_weight, &row);
            const int64_t f = OF_CAMERA + 6 * frame[m], a = OF_CAMERA + 6 * anchor[m];
            end = larger(end, larger(f, a) + 6);
            const double *by_frame = row.by_frame[0], *by_anchor = row.by_anchor[0],
                         *by_own = row.by_own[0];
            add_block(H + f * size + f, size, by_frame, 6, by_frame, 6);
            add_block(H + f * size + a, size, by_frame, 6, by_anchor, 6);
            add_block(H + a * size + f, size, by_anchor, 6, by_frame, 6);
            add_block(H + a * size + a, size, by_anchor, 6, by_anchor, 6);
            add_block(g + f, 1, by_frame, 6, row.e, 1);
            add_block(g + a, 1, by_anchor, 6, row.e, 1);
            add_block(C + f, size, by_own, 3, by_frame, 6);
            add_block(C + a, size, by_own, 3, by_anchor, 6);
            add_block(information, 3, by_own, 3, by_own, 3);
            add_block(slope, 1, by_own, 3, row.e, 1);
            by_camera(&camera, row.u, root + 4 * m, root_of_weight, moved);
            add_block(H, size, moved[0], OF_CAMERA, moved[0], OF_CAMERA);
            add_block(H + f, size, moved[0], OF_CAMERA, by_frame, 6);
            add_block(H + a, size, moved[0], OF_CAMERA, by_anchor, 6);
            add_block(H + f * size, size, by_frame, 6, moved[0], OF_CAMERA);
            add_block(H + a * size, size, by_anchor, 6, moved[0], OF_CAMERA);
            add_block(g, 1, moved[0], OF_CAMERA, row.e, 1);
            add_block(C, size, by_own, 3, moved[0], OF_CAMERA);
        }
        invert(information, variances + 9 * n);
        eliminate(size, end, C, variances + 9 * n, slope, gain, H, g);
    }
}
