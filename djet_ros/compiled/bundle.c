/* Normal equations of a window, its landmarks eliminated: see core/bundle.py. */
#include <string.h>

#include "common.h"

/* Of one observation: its residuals (2,), and how they change with the steps of both poses, and
   with the landmark's inverse depth and point, all of them by the root of its weight. */
typedef struct {
    double e[2], by_frame[2][6], by_anchor[2][6], by_own[2][3];
} Row;

INLINE int64_t least(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

INLINE int64_t most(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static void cross(const double a[3], const double b[3], double product[3])
{
    product[0] = a[1] * b[2] - a[2] * b[1];
    product[1] = a[2] * b[0] - a[0] * b[2];
    product[2] = a[0] * b[1] - a[1] * b[0];
}

/* bundle.jacobians. */
static void differentiate(const double *K, const double *K_inverse, double nearest,
                          const double *residuals, const double *R, const double *t,
                          const double *ray, double rho, const double *place, const double *root,
                          double by, Row *row)
{
    const double depth = place[2] > nearest ? place[2] : nearest;
    for (int i = 0; i < 2; i++) {
        double by_place[3], by_turned[3];
        for (int j = 0; j < 2; j++)
            by_place[j] = by * (root[2 * i] * K[j] + root[2 * i + 1] * K[3 + j]) / depth;
        by_place[2] = -(by_place[0] * place[0] + by_place[1] * place[1]) / depth;
        for (int j = 0; j < 3; j++)
            by_turned[j] = by_place[0] * R[j] + by_place[1] * R[3 + j] + by_place[2] * R[6 + j];
        cross(place, by_place, row->by_frame[i]);
        cross(by_turned, ray, row->by_anchor[i]);
        for (int j = 0; j < 3; j++) {
            row->by_frame[i][3 + j] = by_place[j] * rho;
            row->by_anchor[i][3 + j] = -by_turned[j] * rho;
        }
        row->by_own[i][0] = by_place[0] * t[0] + by_place[1] * t[1] + by_place[2] * t[2];
        for (int j = 0; j < 2; j++)
            row->by_own[i][1 + j] = by_turned[0] * K_inverse[j] + by_turned[1] * K_inverse[3 + j]
                                    + by_turned[2] * K_inverse[6 + j];
        row->e[i] = by * residuals[i];
    }
}

/* Add A^T B to a block that begins somewhere in rows of a length. A: (2, rows), B: (2, columns). */
INLINE void add_block(double *block, int64_t length, const double *A, int rows, const double *B,
                      int columns)
{
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++)
            block[i * length + j] += A[i] * B[j] + A[rows + i] * B[columns + j];
}

/* The inverse of a positive definite matrix (3, 3), by L D L^T. */
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

/* Take a landmark out of the equations over the poses: it is coupled with these by C (3, size),
   between two columns alone. */
INLINE void eliminate(int64_t size, int64_t from, int64_t to, const double *C,
                      const double *variances, const double *slopes, double *gain, double *H,
                      double *g)
{
    for (int i = 0; i < 3; i++)
        for (int64_t k = from; k < to; k++)
            gain[i * size + k] = variances[3 * i] * C[k] + variances[3 * i + 1] * C[size + k]
                                 + variances[3 * i + 2] * C[2 * size + k];
    for (int64_t j = from; j < to; j++) {
        const double a = gain[j], b = gain[size + j], c = gain[2 * size + j];
        if (a == 0 && b == 0 && c == 0)
            continue;
        g[j] -= a * slopes[0] + b * slopes[1] + c * slopes[2];
        for (int64_t k = from; k < to; k++)
            H[j * size + k] -= a * C[k] + b * C[size + k] + c * C[2 * size + k];
    }
}

/* bundle.eliminate: M observations of N landmarks by F frames, sorted by landmark.
   Adds to H (S, S), g (S,), coupling (N, 3, S) and slopes (N, 3), with S = 6F for the poses, and
   one before them where k1 is asked for, by_k1 and held_by_k1 given; gives variances (N, 3, 3);
   gain: (3, S) of memory. */
WIDE void djet_eliminate(int M, int N, int F, const int64_t *landmark, const int64_t *frame,
                         const int64_t *anchor, const double *residuals, const double *R,
                         const double *t, const double *ray, const double *rho,
                         const double *place, const double *root, const double *weights,
                         const double *held, const double *off, double weight,
                         const double *by_k1, const double *held_by_k1, const double *K,
                         const double *K_inverse, double nearest, double trace, double *H,
                         double *g, double *coupling, double *variances, double *slopes,
                         double *gain)
{
    const int64_t lens = by_k1 != NULL, size = lens + 6 * (int64_t)F;
    for (int n = 0, m = 0; n < N; n++) {
        double information[9] = {trace, 0, 0, 0, trace, 0, 0, 0, trace};
        double *C = coupling + 3 * size * n, *slope = slopes + 3 * n;
        const double *gone = off + 2 * n, *by = lens ? held_by_k1 + 2 * n : NULL;
        /* All frames that see a landmark lie between two of them. */
        int64_t from = lens ? 0 : size, to = lens;
        if (lens) {
            H[0] += weight * (by[0] * by[0] + by[1] * by[1]);
            g[0] += weight * (by[0] * gone[0] + by[1] * gone[1]);
        }
        for (int i = 0; i < 2; i++) {
            const double *column = held + 4 * n + i;
            for (int j = 0; j < 2; j++)
                information[3 * (i + 1) + j + 1] +=
                    weight * (column[0] * held[4 * n + j] + column[2] * held[4 * n + 2 + j]);
            slope[i + 1] += weight * (column[0] * gone[0] + column[2] * gone[1]);
            if (lens)
                C[(i + 1) * size] += weight * (column[0] * by[0] + column[2] * by[1]);
        }
        for (; m < M && landmark[m] == n; m++) {
            const double root_of_weight = sqrt(weights[m]);
            Row row;
            differentiate(K, K_inverse, nearest, residuals + 2 * m, R + 9 * m, t + 3 * m,
                          ray + 3 * m, rho[m], place + 3 * m, root + 4 * m, root_of_weight, &row);
            const int64_t f = lens + 6 * frame[m], a = lens + 6 * anchor[m];
            from = least(from, least(f, a));
            to = most(to, most(f, a) + 6);
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
            if (lens) {
                const double k1[2] = {root_of_weight * by_k1[2 * m],
                                      root_of_weight * by_k1[2 * m + 1]};
                add_block(H, size, k1, 1, k1, 1);
                add_block(H + f, size, k1, 1, by_frame, 6);
                add_block(H + a, size, k1, 1, by_anchor, 6);
                add_block(H + f * size, size, by_frame, 6, k1, 1);
                add_block(H + a * size, size, by_anchor, 6, k1, 1);
                add_block(g, 1, k1, 1, row.e, 1);
                add_block(C, size, by_own, 3, k1, 1);
            }
        }
        invert(information, variances + 9 * n);
        eliminate(size, from, to, C, variances + 9 * n, slope, gain, H, g);
    }
}
