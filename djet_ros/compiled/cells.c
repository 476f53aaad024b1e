/* Sums of matches over cells of an image: see core/covariance.py. */
#include <string.h>

#include "common.h"

/* Parameters of a pose; terms of a match, the last OF_SIDES of which are summed for cells of
   all sizes; the most sizes. */
enum { POSE = 5, TERMS = 27, OF_SIDES = POSE + 2, MOST_SIDES = 8 };

/* Terms of one match: covariance._match_terms. */
INLINE void terms_of(const double J[POSE], double weight, double r, double terms[TERMS])
{
    double weighed[POSE];
    for (int i = 0; i < POSE; i++)
        weighed[i] = J[i] * weight;
    int entry = 0;
    for (int i = 0; i < POSE; i++)
        for (int j = i; j < POSE; j++)
            terms[entry++] = J[i] * weighed[j];
    for (int i = 0; i < POSE; i++)
        terms[entry++] = weighed[i] * r;
    for (int i = 0; i < POSE; i++)
        terms[entry++] = weighed[i];
    terms[entry++] = weight * r;
    terms[entry] = weight;
}

/* Add the outer products of a cell's sums to those of its size. */
INLINE void add_products(const double sums[OF_SIDES], double pulls[POSE][POSE],
                         double products[2])
{
    for (int i = 0; i < POSE; i++)
        for (int j = 0; j < POSE; j++)
            pulls[i][j] += sums[i] * sums[j];
    for (int i = 0; i < 2; i++)
        products[i] += sums[POSE + i] * sums[POSE + i];
}

/* Sum the terms of n matches over nested cells: covariance.sums_of_cells. J: (5, n); weights,
   r: (n,); order: (n,) of the matches along a space-filling curve, and their codes in that
   order; codes in one cell of size s, from 0 to `sides`, agree in all but the last 2 s bits;
   small: the size whose sums are returned. Returns the number C of its cells, their sums (C,
   27), and the index (C,) of their first match in order; and for each size pulls (sides, 5, 5)
   and products (sides, 2). */
WIDE int djet_sums_of_cells(int n, const double *J, const double *weights, const double *r,
                           const int64_t *order, const uint64_t *codes, int sides, int small,
                           double (*sums)[TERMS], int64_t *first, double (*pulls)[POSE][POSE],
                           double (*products)[2])
{
    int count = 0;
    double open[MOST_SIDES + 1][OF_SIDES] = {{0}};
    memset(pulls, 0, (size_t)sides * sizeof *pulls);
    memset(products, 0, (size_t)sides * sizeof *products);
    for (int k = 0; k <= n; k++) {
        const uint64_t differing = k == 0 ? 0 : k == n ? UINT64_MAX : codes[k] ^ codes[k - 1];
        /* Cells that end here are parts of those of the next size. */
        for (int side = 0; side < sides && differing >> (2 * side); side++) {
            add_products(open[side], pulls[side], products[side]);
            for (int i = 0; i < OF_SIDES; i++)
                open[side + 1][i] += open[side][i];
            memset(open[side], 0, sizeof *open);
        }
        if (k == n)
            break;
        if (k == 0 || differing >> (2 * small)) {
            first[count] = k;
            memset(sums[count++], 0, sizeof *sums);
        }
        const int64_t match = order[k];
        double J_match[POSE], terms[TERMS];
        for (int i = 0; i < POSE; i++)
            J_match[i] = J[i * n + match];
        terms_of(J_match, weights[match], r[match], terms);
        for (int i = 0; i < TERMS; i++)
            sums[count - 1][i] += terms[i];
        for (int i = 0; i < OF_SIDES; i++)
            open[0][i] += terms[TERMS - OF_SIDES + i];
    }
    return count;
}

/* Invert a positive definite matrix by Gauss-Jordan elimination. */
INLINE void invert(double A[POSE][POSE])
{
    for (int pivot = 0; pivot < POSE; pivot++) {
        const double reciprocal = 1 / A[pivot][pivot];
        A[pivot][pivot] = 1;
        for (int j = 0; j < POSE; j++)
            A[pivot][j] *= reciprocal;
        for (int i = 0; i < POSE; i++) {
            const double factor = A[i][pivot];
            if (i == pivot)
                continue;
            A[i][pivot] = 0;
            for (int j = 0; j < POSE; j++)
                A[i][j] -= factor * A[pivot][j];
        }
    }
}

/* Shifts (C, 5) of a pose when each of C cells is left out in turn, and the sum (5, 5) of the
   inverse Hessians without it: covariance.leave_one_out. H: (5, 5) of all matches; cells: (C,
   27) sums. */
WIDE void djet_leave_one_out(int C, const double H[POSE][POSE], const double (*cells)[TERMS],
                             double (*shifts)[POSE], double inverses[POSE][POSE])
{
    memset(inverses, 0, POSE * sizeof *inverses);
    for (int c = 0; c < C; c++) {
        const double *gradient = cells[c] + POSE * (POSE + 1) / 2;
        double left[POSE][POSE];
        for (int i = 0, entry = 0; i < POSE; i++)
            for (int j = i; j < POSE; j++, entry++)
                left[i][j] = left[j][i] = H[i][j] - cells[c][entry];
        invert(left);
        for (int i = 0; i < POSE; i++) {
            double shift = 0;
            for (int j = 0; j < POSE; j++) {
                shift += left[i][j] * gradient[j];
                inverses[i][j] += left[i][j];
            }
            shifts[c][i] = shift;
        }
    }
}
