/* Which points are next to others: see core/cells.py. */
#include "common.h"

/* Points in square cells: those of cell c are order[first[c]] up to order[first[c + 1]]. */
typedef struct {
    double left, top, side;
    int columns, rows;
    int32_t *first, *order;
} Cells;

static int clamped(double place, int count)
{
    return place < 0 ? 0 : place < count ? (int)place : count - 1;
}

static int column_of(const Cells *cells, const double point[2])
{
    return clamped((point[0] - cells->left) / cells->side, cells->columns);
}

static int row_of(const Cells *cells, const double point[2])
{
    return clamped((point[1] - cells->top) / cells->side, cells->rows);
}

static void fill(const Cells *cells, int m, const double (*sites)[2])
{
    const int count = cells->columns * cells->rows;
    for (int c = 0; c <= count; c++)
        cells->first[c] = 0;
    for (int i = 0; i < m; i++)
        cells->first[row_of(cells, sites[i]) * cells->columns + column_of(cells, sites[i])]++;
    for (int c = 1; c <= count; c++)
        cells->first[c] += cells->first[c - 1];
    /* Backwards, so that the first ones come first. */
    for (int i = m - 1; i >= 0; i--)
        cells->order[--cells->first[row_of(cells, sites[i]) * cells->columns
                                    + column_of(cells, sites[i])]] = i;
}

/* How far a point is from the sides of its cell; 0 outside of it. */
static double to_side(const Cells *cells, int column, int row, const double point[2])
{
    const double x = point[0] - cells->left - column * cells->side,
                 y = point[1] - cells->top - row * cells->side;
    const double near = fmin(fmin(x, cells->side - x), fmin(y, cells->side - y));
    return near > 0 ? near : 0;
}

/* The nearest of a cell, if it is nearer than the best one. */
static void look_in(const Cells *cells, int cell, const double (*sites)[2], const double point[2],
                    double *best, int64_t *nearest)
{
    for (int i = cells->first[cell]; i < cells->first[cell + 1]; i++) {
        const double *site = sites[cells->order[i]];
        const double dx = site[0] - point[0], dy = site[1] - point[1];
        if (dx * dx + dy * dy < *best) {
            *best = dx * dx + dy * dy;
            *nearest = cells->order[i];
        }
    }
}

/* Which of m sites (m, 2), one at least, is next to each of n points (n, 2): cells.nearest. They
   lie in so many columns and rows of cells of a side, from left and top on; memory: room for
   columns rows + 1 + m. Of those as near, any. */
void djet_nearest(int m, const double (*sites)[2], int n, const double (*points)[2], double left,
                  double top, double side, int columns, int rows, int32_t *memory,
                  int64_t *nearest)
{
    const Cells cells = {left, top, side, columns, rows, memory, memory + columns * rows + 1};
    fill(&cells, m, sites);
    for (int k = 0; k < n; k++) {
        const int x = column_of(&cells, points[k]), y = row_of(&cells, points[k]);
        double best = INFINITY;
        nearest[k] = 0;
        const double inside = to_side(&cells, x, y, points[k]);
        for (int away = 0; away < columns + rows; away++) {
            /* Round by round: all that is nearer is known by now. */
            const double known = (away - 1) * side + inside;
            if (away > 0 && best <= known * known)
                break;
            for (int j = y < away ? 0 : y - away; j <= y + away && j < rows; j++) {
                const int at_end = j == y - away || j == y + away;
                const int step = at_end || away == 0 ? 1 : 2 * away;
                for (int i = x - away; i <= x + away; i += step)
                    if (i >= 0 && i < columns)
                        look_in(&cells, j * columns + i, sites, points[k], &best, &nearest[k]);
            }
        }
    }
}
