/* Nearest neighbours in the image: see core/prediction.py. */
#include <string.h>

#include "common.h"

/* Square cells that hold about one point each. */
typedef struct {
    double left, top, side;
    int columns, rows;
} Cells;

/* Cells that cover points (n, 2). */
static Cells cells_around(int n, const double (*points)[2])
{
    double least[2] = {INFINITY, INFINITY}, most[2] = {-INFINITY, -INFINITY};
    for (int k = 0; k < n; k++)
        for (int axis = 0; axis < 2; axis++) {
            least[axis] = fmin(least[axis], points[k][axis]);
            most[axis] = fmax(most[axis], points[k][axis]);
        }
    const double width = most[0] - least[0], height = most[1] - least[1];
    /* No more than (n + 1) of them along each axis, and 3 n + 1 in all. */
    double side = fmax(sqrt(width * height / n), fmax(width, height) / n);
    side = side > 0 ? side : 1;
    const double columns = floor(width / side) + 1, rows = floor(height / side) + 1;
    /* All in one cell if numbers have overflowed, or the area has vanished. */
    if (!(columns * rows <= 3.0 * n + 1))
        return (Cells){least[0], least[1], INFINITY, 1, 1};
    return (Cells){least[0], least[1], side, (int)columns, (int)rows};
}

/* The cell of a position in units of cells, the nearest one outside of all `count`. */
static int cell_index(double position, int count)
{
    return position > 0 ? position < count ? (int)position : count - 1 : 0;
}

static int column_of(const Cells *cells, double x)
{
    return cell_index((x - cells->left) / cells->side, cells->columns);
}

static int row_of(const Cells *cells, double y)
{
    return cell_index((y - cells->top) / cells->side, cells->rows);
}

/* Sort points (n, 2) by cells: `order` (n,), in which those of cell c are at [first[c], first[c
   + 1]). */
static void sort_into(const Cells *cells, int n, const double (*points)[2], int32_t *first,
                      int32_t *order)
{
    const int count = cells->columns * cells->rows;
    memset(first, 0, (size_t)(count + 1) * sizeof *first);
    for (int k = 0; k < n; k++)
        first[row_of(cells, points[k][1]) * cells->columns + column_of(cells, points[k][0])]++;
    for (int c = 1; c <= count; c++)
        first[c] += first[c - 1];
    for (int k = n - 1; k >= 0; k--) {
        const int row = row_of(cells, points[k][1]), column = column_of(cells, points[k][0]);
        order[--first[row * cells->columns + column]] = k;
    }
}

/* Indices (m,) of the nearest of points (n, 2), n > 0, to each of queries (m, 2), all finite.
   memory: (4 n + 2,). */
WIDE void djet_nearest(int n, const double (*points)[2], int m, const double (*queries)[2],
                       int32_t *memory, int64_t *nearest)
{
    const Cells cells = cells_around(n, points);
    int32_t *order = memory, *first = memory + n;
    sort_into(&cells, n, points, first, order);
    for (int k = 0; k < m; k++) {
        const double x = queries[k][0], y = queries[k][1];
        const int column = column_of(&cells, x), row = row_of(&cells, y);
        double least = INFINITY;
        nearest[k] = 0;
        /* Search square rings of cells around its own, until all beyond are farther away. */
        for (int ring = 0;; ring++) {
            const int left = column - ring, right = column + ring, top = row - ring,
                      bottom = row + ring;
            for (int j = top > 0 ? top : 0; j <= bottom && j < cells.rows; j++) {
                const int is_edge = j == top || j == bottom;
                for (int i = left; i <= right; i += is_edge || !ring ? 1 : 2 * ring) {
                    if (i < 0 || i >= cells.columns)
                        continue;
                    const int cell = j * cells.columns + i;
                    for (int o = first[cell]; o < first[cell + 1]; o++) {
                        const double *point = points[order[o]];
                        const double dx = point[0] - x, dy = point[1] - y;
                        const double squared = dx * dx + dy * dy;
                        nearest[k] = squared < least ? order[o] : nearest[k];
                        least = squared < least ? squared : least;
                    }
                }
            }
            double margin = INFINITY;
            if (left > 0)
                margin = fmin(margin, x - (cells.left + left * cells.side));
            if (right < cells.columns - 1)
                margin = fmin(margin, cells.left + (right + 1) * cells.side - x);
            if (top > 0)
                margin = fmin(margin, y - (cells.top + top * cells.side));
            if (bottom < cells.rows - 1)
                margin = fmin(margin, cells.top + (bottom + 1) * cells.side - y);
            if (margin == INFINITY || (margin > 0 && least < margin * margin))
                break;
        }
    }
}
