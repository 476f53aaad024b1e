/* The joint optimiser: residuals and steps are those of core/jet.py, those of many starts of
   core/sketch.py. Sums over matches have another order here, and derivatives another form, so both
   round differently. */
#include <string.h>

#include "common.h"

enum { NONE, HUBER, CAUCHY, GEMAN_MCCLURE };

/* Matches computed in parallel; rows are padded with matches without effect. */
enum { LANES = 4 };
typedef double Lanes __attribute__((vector_size(LANES * sizeof(double))));
typedef int64_t Choice __attribute__((vector_size(LANES * sizeof(int64_t))));

/* Rays x and y* (3, m), spread (3, m) and blur (m,) of matches, m a multiple of LANES. */
typedef struct {
    int m;
    const double *x, *y, *spread, *blur;
} Problem;

typedef struct {
    int kind;
    double scale;
} Loss;

/* Rows of m numbers: of the residuals of matches at a pose (J: (5, m)), and of a problem. */
enum { RESIDUAL_ROWS = 9, MATCH_ROWS = 10 };
typedef struct {
    double *r, *sign, *weight, *curvature, *J;
} Residuals;

typedef struct {
    double R[3][3], t[3];
} Pose;

INLINE Lanes load(const double *values)
{
    Lanes lanes;
    memcpy(&lanes, values, sizeof lanes);
    return lanes;
}

INLINE void store(double *values, Lanes lanes)
{
    memcpy(values, &lanes, sizeof lanes);
}

INLINE Lanes chosen(Choice choice, Lanes yes, Lanes no)
{
    return (Lanes)((choice & (Choice)yes) | (~choice & (Choice)no));
}

INLINE Lanes larger(Lanes a, Lanes b)
{
    return chosen(a > b, a, b);
}

INLINE Lanes roots(Lanes values)
{
    double each[LANES];
    store(each, values);
    for (int l = 0; l < LANES; l++)
        each[l] = sqrt(each[l]);
    return load(each);
}

INLINE double sum_of(Lanes values)
{
    return (values[0] + values[1]) + (values[2] + values[3]);
}

static void multiply(const double A[3][3], const double B[3][3], double AB[3][3])
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            AB[i][j] = A[i][0] * B[0][j] + A[i][1] * B[1][j] + A[i][2] * B[2][j];
}

static void cross_matrix(const double v[3], double S[3][3])
{
    const double values[3][3] = {{0, -v[2], v[1]}, {v[2], 0, -v[0]}, {-v[1], v[0], 0}};
    memcpy(S, values, sizeof values);
}

/* geometry.sphere_tangents, as two rows. */
static void sphere_tangents(const double t[3], double tangents[2][3])
{
    const double x = t[0], y = t[1], sign = copysign(1.0, t[2]), a = -1.0 / (sign + t[2]);
    const double b = x * y * a;
    const double values[2][3] = {{1.0 + sign * x * x * a, sign * b, -sign * x},
                                 {b, sign + y * y * a, -y}};
    memcpy(tangents, values, sizeof values);
}

INLINE Lanes dot(const Lanes a[3], const Lanes b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

INLINE void cross(const Lanes a[3], const Lanes b[3], Lanes product[3])
{
    for (int i = 0; i < 3; i++) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        product[i] = a[j] * b[k] - a[k] * b[j];
    }
}

INLINE void in_all_lanes(const double v[3], Lanes all[3])
{
    for (int i = 0; i < 3; i++)
        all[i] = (Lanes){0} + v[i];
}

/* Compute the residuals at a pose, and J on demand, which includes the derivative of the
   variances if `exact`. With m = R x and w the weighted y, w . (t x m) has the derivatives
   m x (w x t) by the rotation and m x w by t. */
INLINE void residuals_at(const Problem *problem, const Pose *pose, const double tangents[2][3],
                         int exact, int with_J, Residuals *residuals)
{
    Lanes t[3], directions[2][3];
    in_all_lanes(pose->t, t);
    for (int j = 0; j < 2; j++)
        in_all_lanes(tangents[j], directions[j]);
    const int count = problem->m;
    for (int k = 0; k < count; k += LANES) {
        Lanes x[3], y[3], s[3], m[3], line[3];
        for (int i = 0; i < 3; i++) {
            x[i] = load(problem->x + i * count + k);
            y[i] = load(problem->y + i * count + k);
            s[i] = load(problem->spread + i * count + k);
        }
        for (int i = 0; i < 3; i++)
            m[i] = pose->R[i][0] * x[0] + pose->R[i][1] * x[1] + pose->R[i][2] * x[2];
        cross(t, m, line);
        /* Covariance of the point times the line's normal. */
        const Lanes M[2] = {s[0] * line[0] + s[1] * line[1], s[1] * line[0] + s[2] * line[1]};
        const Lanes variance = line[0] * M[0] + line[1] * M[1], zero = {0};
        const Lanes sign = chosen(variance < 0, zero - 1.0, zero + 1.0);
        const Lanes size = larger(sign * variance + load(problem->blur + k), zero + 1e-24);
        const Lanes of = 1 / roots(size);
        const Lanes r = dot(y, line) * of;
        store(residuals->r + k, r);
        store(residuals->sign + k, sign);
        if (!with_J)
            continue;
        Lanes w[3] = {y[0] * of, y[1] * of, y[2] * of};
        if (exact) {
            const Lanes by_variance = r * sign * of * of;
            w[0] -= by_variance * M[0];
            w[1] -= by_variance * M[1];
        }
        Lanes by_t[3], turned[3], by_rotation[3];
        cross(w, t, turned);
        cross(m, turned, by_rotation);
        cross(m, w, by_t);
        for (int j = 0; j < 3; j++)
            store(residuals->J + j * count + k, by_rotation[j]);
        for (int j = 0; j < 2; j++)
            store(residuals->J + (3 + j) * count + k, dot(directions[j], by_t));
    }
}

/* Sum the loss, and compute each match's weight and curvature: jet.Loss. */
INLINE double cost_of(Loss loss, int m, Residuals *residuals)
{
    const double square = loss.scale * loss.scale, per_square = 1 / square;
    const Lanes zero = {0}, one = zero + 1.0;
    Lanes sum = {0};
    for (int k = 0; k < m; k += LANES) {
        const Lanes r = load(residuals->r + k), u = r * r * per_square;
        Lanes value = r * r, weight = one, curvature = one;
        if (loss.kind == GEMAN_MCCLURE) {
            const Lanes flat = 1 / (1 + u);
            value = r * r * flat;
            weight = flat * flat;
            curvature = (1 - 3 * u) * flat * flat * flat;
        } else if (loss.kind == CAUCHY) {
            for (int l = 0; l < LANES; l++)
                value[l] = square * log1p(u[l]);
            weight = 1 / (1 + u);
            curvature = (1 - u) / ((1 + u) * (1 + u));
        } else if (loss.kind == HUBER) {
            const Lanes root = roots(larger(u, one));
            weight = 1 / root;
            for (int l = 0; l < LANES; l++) {
                value[l] = square * (u[l] <= 1 ? u[l] : 2 * root[l] - 1);
                curvature[l] = u[l] <= 1;
            }
        }
        sum += load(residuals->sign + k) * value;
        store(residuals->weight + k, weight);
        store(residuals->curvature + k, curvature);
    }
    return sum_of(sum);
}

/* Hessian and gradient. The curvature of a match is its weight, or with `by_loss` that of its
   loss, but at least a share of its weight. */
INLINE void sum_up(int m, const Residuals *residuals, int by_loss, double least_curved,
                   double H[5][5], double gradient[5])
{
    Lanes a[15] = {{0}}, b[5] = {{0}};
    for (int k = 0; k < m; k += LANES) {
        const Lanes weight = load(residuals->weight + k);
        const Lanes curved =
            by_loss ? larger(load(residuals->curvature + k), least_curved * weight) : weight;
        const Lanes pull = weight * load(residuals->sign + k) * load(residuals->r + k);
        Lanes J[5];
        for (int i = 0; i < 5; i++)
            J[i] = load(residuals->J + i * m + k);
        for (int i = 0, entry = 0; i < 5; i++) {
            const Lanes weighed = J[i] * curved;
            b[i] += J[i] * pull;
            for (int j = i; j < 5; j++)
                a[entry++] += weighed * J[j];
        }
    }
    for (int i = 0, entry = 0; i < 5; i++) {
        gradient[i] = sum_of(b[i]);
        for (int j = i; j < 5; j++)
            H[i][j] = H[j][i] = sum_of(a[entry++]);
    }
}

/* Solve (H + ridge) step = -gradient by elimination with pivoting; returns 0 if H is zero or
   not finite. */
static int damped_step(const double given[5][5], const double gradient[5], double damping,
                       double step[5])
{
    double most = 0, H[5][5];
    memcpy(H, given, sizeof H);
    for (int i = 0; i < 5; i++) {
        for (int j = 0; j < 5; j++)
            if (!isfinite(H[i][j]))
                return 0;
        most = H[i][i] > most ? H[i][i] : most;
    }
    if (most == 0)
        return 0;
    for (int i = 0; i < 5; i++) {
        H[i][i] += damping * H[i][i] + 1e-12 * most;
        step[i] = -gradient[i];
    }
    for (int i = 0; i < 5; i++) {
        int pivot = i;
        for (int j = i + 1; j < 5; j++)
            pivot = fabs(H[j][i]) > fabs(H[pivot][i]) ? j : pivot;
        for (int k = 0; k < 5; k++) {
            const double swapped = H[i][k];
            H[i][k] = H[pivot][k];
            H[pivot][k] = swapped;
        }
        const double swapped = step[i];
        step[i] = step[pivot];
        step[pivot] = swapped;
        for (int j = i + 1; j < 5; j++) {
            const double share = H[j][i] / H[i][i];
            for (int k = i; k < 5; k++)
                H[j][k] -= share * H[i][k];
            step[j] -= share * step[i];
        }
    }
    for (int i = 4; i >= 0; i--) {
        for (int j = i + 1; j < 5; j++)
            step[i] -= H[i][j] * step[j];
        step[i] /= H[i][i];
    }
    return 1;
}

/* jet.retract: rotation from the left, then t along the sphere. */
static void retract(const Pose *pose, const double tangents[2][3], const double step[5],
                    Pose *moved)
{
    double S[3][3], square[3][3], rotation[3][3];
    const double angle = sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2]);
    const double half = angle / 2 > 1e-9 ? angle / 2 : 1e-9, quotient = sin(half) / half;
    cross_matrix(step, S);
    multiply((const double (*)[3])S, (const double (*)[3])S, square);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            rotation[i][j] =
                (i == j) + quotient * cos(half) * S[i][j] + quotient * quotient / 2 * square[i][j];
    multiply((const double (*)[3])rotation, pose->R, moved->R);
    double t[3], length = 0;
    for (int i = 0; i < 3; i++) {
        t[i] = pose->t[i] + tangents[0][i] * step[3] + tangents[1][i] * step[4];
        length += t[i] * t[i];
    }
    length = length > 0 ? sqrt(length) : 1.0;
    for (int i = 0; i < 3; i++)
        moved->t[i] = t[i] / length;
}

/* Pad rows of n. A match of zero rays has no effect. */
static Problem padded(int n, int m, const double *x, const double *y, const double *spread,
                         const double *blur, double *memory)
{
    for (int row = 0; row < MATCH_ROWS; row++) {
        const double *from = row < 3 ? x + row * n : row < 6 ? y + (row - 3) * n
                           : row < 9 ? spread + (row - 6) * n : blur;
        memcpy(memory + row * m, from, (size_t)n * sizeof(double));
        for (int k = n; k < m; k++)
            memory[row * m + k] = row == MATCH_ROWS - 1;
    }
    const Problem problem = {m, memory, memory + 3 * m, memory + 6 * m, memory + 9 * m};
    return problem;
}

static Residuals residuals_in(double *memory, int m)
{
    const Residuals residuals = {memory, memory + m, memory + 2 * m, memory + 3 * m,
                                 memory + 4 * m};
    return residuals;
}

/* A pose with the tangents of its t, its cost, and its residuals. */
typedef struct {
    Pose pose;
    double tangents[2][3], cost;
    Residuals residuals;
} State;

/* Evaluate residuals and cost at the pose of a state. exact, with_J: as in residuals_at. */
INLINE void evaluate(const Problem *problem, Loss loss, int exact, int with_J, State *state)
{
    sphere_tangents(state->pose.t, state->tangents);
    residuals_at(problem, &state->pose, (const double (*)[3])state->tangents, exact, with_J,
                 &state->residuals);
    state->cost = cost_of(loss, problem->m, &state->residuals);
}

static void swap(State *one, State *other)
{
    const State kept = *one;
    *one = *other;
    *other = kept;
}

/* Convergence: least step, least relative gain, largest damping; and the least curvature of a
   match as a share of its weight. */
typedef struct {
    double step, gain, damping, curved;
} Limits;

/* Levenberg-Marquardt from `current`, which is updated; `trial` is for trials. `exact` as in
   residuals_at, also for curvatures by the loss; without it J is not computed at the end. */
INLINE void descend(const Problem *problem, Loss loss, int exact, int most_steps, Limits limits,
                    double damping, State *current, State *trial)
{
    double H[5][5], gradient[5];
    int has_moved = 1;
    evaluate(problem, loss, exact, exact || most_steps > 0, current);
    for (int number = 0; number < most_steps; number++) {
        double step[5], length = 0;
        if (has_moved)
            sum_up(problem->m, &current->residuals, exact, limits.curved, H, gradient);
        if (!damped_step((const double (*)[5])H, gradient, damping, step))
            break;
        for (int i = 0; i < 5; i++)
            length += step[i] * step[i];
        const int is_small = sqrt(length) < limits.step;
        retract(&current->pose, (const double (*)[3])current->tangents, step, &trial->pose);
        evaluate(problem, loss, exact, exact || number + 1 < most_steps, trial);
        has_moved = trial->cost < current->cost;
        if (has_moved) {
            swap(current, trial);
            damping = fmax(damping / 10, 1e-9);
            if (is_small || trial->cost - current->cost < limits.gain * fabs(current->cost))
                break;
        } else {
            damping *= 10;
            if (damping > limits.damping || is_small)
                break;
        }
    }
}

static int padded_size(int n)
{
    return (n + LANES - 1) / LANES * LANES;
}

/* Minimise the summed loss from an initial pose: jet.minimise. R (3, 3) and t (3,) are updated;
   limits: as in Limits; r, sign (n,), J (5, n) and tangents (2, 3): those at the end; memory:
   (28, m) with m = n rounded up to LANES. */
WIDE void djet_minimise(int n, const double *x, const double *y, const double *spread,
                        const double *blur, int kind, double scale, int most_steps,
                        double damping, const double *limits, double *R, double *t, double *r,
                        double *sign, double *J, double *tangents, double *memory)
{
    const int m = padded_size(n);
    const Problem problem = padded(n, m, x, y, spread, blur, memory);
    const Loss loss = {kind, scale};
    const Limits of = {limits[0], limits[1], limits[2], limits[3]};
    State current = {.residuals = residuals_in(memory + MATCH_ROWS * m, m)};
    State trial = {.residuals = residuals_in(memory + (MATCH_ROWS + RESIDUAL_ROWS) * m, m)};
    memcpy(current.pose.R, R, sizeof current.pose.R);
    memcpy(current.pose.t, t, sizeof current.pose.t);
    descend(&problem, loss, 1, most_steps, of, damping, &current, &trial);
    memcpy(R, current.pose.R, sizeof current.pose.R);
    memcpy(t, current.pose.t, sizeof current.pose.t);
    memcpy(tangents, current.tangents, sizeof current.tangents);
    memcpy(r, current.residuals.r, (size_t)n * sizeof(double));
    memcpy(sign, current.residuals.sign, (size_t)n * sizeof(double));
    for (int j = 0; j < 5; j++)
        memcpy(J + j * n, current.residuals.J + j * m, (size_t)n * sizeof(double));
}

/* Refine each of S poses by some steps, with the variances of residuals held fixed in each
   step: sketch.refine_all. R: (S, 3, 3) and t: (S, 3) are updated; costs: (S,); r, sign: (S,
   n); memory: as above. */
WIDE void djet_refine_all(int n, const double *x, const double *y, const double *spread,
                          const double *blur, int kind, double scale, int most_steps,
                          double damping, int S, double *R, double *t, double *costs, double *r,
                          double *sign, double *memory)
{
    const int m = padded_size(n);
    const Problem problem = padded(n, m, x, y, spread, blur, memory);
    const Loss loss = {kind, scale};
    const Limits none = {0, 0, INFINITY, 0};
    for (int start = 0; start < S; start++) {
        State current = {.residuals = residuals_in(memory + MATCH_ROWS * m, m)};
        State trial = {.residuals = residuals_in(memory + (MATCH_ROWS + RESIDUAL_ROWS) * m, m)};
        memcpy(current.pose.R, R + 9 * start, sizeof current.pose.R);
        memcpy(current.pose.t, t + 3 * start, sizeof current.pose.t);
        descend(&problem, loss, 0, most_steps, none, damping, &current, &trial);
        memcpy(R + 9 * start, current.pose.R, sizeof current.pose.R);
        memcpy(t + 3 * start, current.pose.t, sizeof current.pose.t);
        costs[start] = current.cost;
        memcpy(r + start * n, current.residuals.r, (size_t)n * sizeof(double));
        memcpy(sign + start * n, current.residuals.sign, (size_t)n * sizeof(double));
    }
}

/* Loss of a squared residual: jet.Loss. */
INLINE double value_of(int kind, double square, double squared)
{
    const double u = squared / square;
    return kind == GEMAN_MCCLURE ? squared / (1 + u) : kind == CAUCHY ? square * log1p(u)
           : kind == HUBER && u > 1 ? square * (2 * sqrt(u) - 1) : squared;
}

/* Losses (n,) with the cost of distances behind a camera, for one sign of t, see below; returns
   their sum. */
INLINE double losses_of_sign(int n, int kind, double square, const double *restrict squared,
                             const double *restrict offset, const double *restrict curvature_signs,
                             double t_sign, double *restrict losses)
{
    for (int k = 0; k < n; k++) {
        const double back = t_sign * offset[k] < 0 ? offset[k] : 0;
        losses[k] = curvature_signs[k] * value_of(kind, square, squared[k] + back * back);
    }
    double sum = 0;
    for (int k = 0; k < n; k++)
        sum += losses[k];
    return sum;
}

/* Signed distance of each match along its epipolar line from the point at infinity, and its
   squared residual. */
INLINE void along_lines(int n, const double *restrict x, const double *restrict y,
                        const double *restrict spread, const double *restrict blur,
                        const double *restrict R, const double *restrict t,
                        const double *restrict r, double *restrict offset,
                        double *restrict squared)
{
    for (int k = 0; k < n; k++) {
        const double x1 = x[k], x2 = x[n + k], x3 = x[2 * n + k];
        const double depth = R[6] * x1 + R[7] * x2 + R[8] * x3;
        const double by = 1 / (depth > 0 ? depth : 1.0);
        const double i1 = (R[0] * x1 + R[1] * x2 + R[2] * x3) * by,
                     i2 = (R[3] * x1 + R[4] * x2 + R[5] * x3) * by;
        const double a1 = t[0] - i1 * t[2], a2 = t[1] - i2 * t[2];
        const double variance = fabs(spread[k] * a1 * a1 + 2 * spread[n + k] * a1 * a2
                                     + spread[2 * n + k] * a2 * a2) + blur[k];
        const double along = (y[k] - i1) * a1 + (y[n + k] - i2) * a2;
        const double units = along / sqrt(variance > 1e-24 ? variance : 1e-24);
        offset[k] = depth > 0 ? units : 0;
        squared[k] = r[k] * r[k];
    }
}

/* Losses (S, n) at S poses with chirality: points also have to lie in front of both cameras,
   for the sign of t, among some, of least cost: sketch.losses_in_front. r, curvature_signs: (S, n)
   residuals, and their signs of curvature; memory: (3, n). */
WIDE void djet_losses_in_front(int n, const double *x, const double *y, const double *spread,
                               const double *blur, int kind, double scale, int S, const double *R,
                               const double *t, const double *r, const double *curvature_signs,
                               int signs, const double *t_signs, double *losses, double *memory)
{
    const double square = scale * scale;
    double *offset = memory, *squared = memory + n, *other = memory + 2 * n;
    for (int s = 0; s < S; s++, R += 9, t += 3, r += n, curvature_signs += n, losses += n) {
        along_lines(n, x, y, spread, blur, R, t, r, offset, squared);
        double least = INFINITY;
        for (int i = 0; i < signs; i++) {
            double *to = i == 0 ? losses : other;
            double cost = 0;
            if (kind == GEMAN_MCCLURE)
                cost = losses_of_sign(n, GEMAN_MCCLURE, square, squared, offset, curvature_signs,
                                      t_signs[i], to);
            else
                cost = losses_of_sign(n, kind, square, squared, offset, curvature_signs,
                                      t_signs[i], to);
            if (i > 0 && cost < least)
                memcpy(losses, other, (size_t)n * sizeof *losses);
            least = cost < least ? cost : least;
        }
    }
}
