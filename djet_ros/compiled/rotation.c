/* The pure rotation between two views: see core/geometry.py, fit_rotation. */
#include <string.h>

#include "common.h"

/* Lower bound of the median squared residual. */
static const double LEAST_MEDIAN = 1e-18;

/* Relative size of an off-diagonal entry that counts as zero. */
static const double NEGLIGIBLE = 1e-20;

/* Most sweeps over a matrix; they converge quadratically, in four or five. */
enum { MOST_SWEEPS = 30 };

/* Diagonalise a symmetric matrix (4, 4) by Jacobi rotations, and apply them to V. */
static void diagonalise(double A[4][4], double V[4][4])
{
    int changed = 1;
    for (int sweep = 0; changed && sweep < MOST_SWEEPS; sweep++) {
        changed = 0;
        for (int p = 0; p < 4; p++)
            for (int q = p + 1; q < 4; q++) {
                if (fabs(A[p][q]) <= NEGLIGIBLE * (fabs(A[p][p]) + fabs(A[q][q])))
                    continue;
                changed = 1;
                const double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
                const double tangent = copysign(1.0, theta)
                                       / (fabs(theta) + sqrt(theta * theta + 1));
                const double c = 1 / sqrt(tangent * tangent + 1), s = tangent * c;
                for (int k = 0; k < 4; k++) {
                    const double a = A[k][p], b = A[k][q], v = V[k][p], w = V[k][q];
                    A[k][p] = c * a - s * b;
                    A[k][q] = s * a + c * b;
                    V[k][p] = c * v - s * w;
                    V[k][q] = s * v + c * w;
                }
                for (int k = 0; k < 4; k++) {
                    const double a = A[p][k], b = A[q][k];
                    A[p][k] = c * a - s * b;
                    A[q][k] = s * a + c * b;
                }
            }
    }
}

/* The rotation nearest to a matrix, by the unit quaternion of Horn (JOSA A 1987). */
static void nearest_rotation(const double M[3][3], double R[3][3])
{
    double A[4][4] = {{M[0][0] + M[1][1] + M[2][2], M[2][1] - M[1][2], M[0][2] - M[2][0],
                       M[1][0] - M[0][1]}};
    for (int i = 0; i < 3; i++) {
        A[i + 1][0] = A[0][i + 1];
        for (int j = 0; j < 3; j++)
            A[i + 1][j + 1] = M[i][j] + M[j][i] - (i == j ? A[0][0] : 0);
    }
    double V[4][4] = {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}, {0, 0, 0, 1}};
    diagonalise(A, V);
    int most = 0;
    for (int k = 1; k < 4; k++)
        most = A[k][k] > A[most][most] ? k : most;
    const double w = V[0][most], x = V[1][most], y = V[2][most], z = V[3][most];
    const double rotation[3][3] = {
        {w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)},
        {2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)},
        {2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z}};
    memcpy(R, rotation, sizeof rotation);
}

/* The value of a given rank, after a partial sort (Hoare's FIND). */
static double selected(double *values, int n, int rank)
{
    for (int first = 0, last = n - 1; first < last;) {
        const double pivot = values[first + (last - first) / 2];
        int i = first, j = last;
        while (i <= j) {
            while (values[i] < pivot)
                i++;
            while (values[j] > pivot)
                j--;
            if (i <= j) {
                const double swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        }
        if (rank <= j)
            last = j;
        else if (rank >= i)
            first = i;
        else
            break;
    }
    return values[rank];
}

/* Unit rays (n, 3), components first. */
INLINE void unit_rays(int n, const double (*rays)[3], double *restrict to)
{
    for (int k = 0; k < n; k++) {
        const double *ray = rays[k];
        const double length = sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]);
        for (int i = 0; i < 3; i++)
            to[i * n + k] = ray[i] / length;
    }
}

/* Fit the rotation R (3, 3) from rays x (n, 3) to rays y by iteratively reweighted least
   squares: geometry.fit_rotation. memory: (9, n). */
WIDE void djet_fit_rotation(int n, const double (*rays_x)[3], const double (*rays_y)[3],
                            int rounds, double R[3][3], double *memory)
{
    double *x = memory, *y = memory + 3 * n, *weights = memory + 6 * n, *squared = memory + 7 * n,
           *ordered = memory + 8 * n;
    unit_rays(n, rays_x, x);
    unit_rays(n, rays_y, y);
    for (int k = 0; k < n; k++)
        weights[k] = 1;
    for (int round = 0; round < rounds; round++) {
        double M[3][3] = {{0}};
        for (int k = 0; k < n; k++)
            for (int i = 0; i < 3; i++)
                for (int j = 0; j < 3; j++)
                    M[i][j] += y[i * n + k] * weights[k] * x[j * n + k];
        nearest_rotation((const double (*)[3])M, R);
        for (int k = 0; k < n; k++) {
            squared[k] = 0;
            for (int i = 0; i < 3; i++) {
                const double residual =
                    y[i * n + k] - (R[i][0] * x[k] + R[i][1] * x[n + k] + R[i][2] * x[2 * n + k]);
                squared[k] += residual * residual;
            }
        }
        /* Scale by the median. */
        memcpy(ordered, squared, (size_t)n * sizeof *ordered);
        const double median = n ? selected(ordered, n, n / 2) : 0;
        for (int k = 0; k < n; k++)
            weights[k] = 1 / (1 + squared[k] / (median > LEAST_MEDIAN ? median : LEAST_MEDIAN));
    }
}
