"""Paraboloids: the quadratic fit of the paper's Appendix, and minima on epipolar lines."""

from __future__ import annotations

from decimal import Decimal, localcontext

from djet_ros.core.paraboloid import (
    constrained_minimum,
    fit_paraboloids,
    indefinite,
    inverse_2x2,
    Paraboloids,
    project_to_positive,
)
from hypothesis import example, given, strategies as st
import numpy as np
import pytest

SIDES = (3, 5, 7, 9, 11, 13, 15)


def window(side):
    """Places (P^2, 2) of a square's samples, row by row, as (x_1, x_2)."""
    radius = side // 2
    return np.array([(x1, x2) for x2 in range(-radius, radius + 1)
                     for x1 in range(-radius, radius + 1)], float)


def design(places):
    """Matrix D of the Appendix."""
    x1, x2 = np.asarray(places, float).T
    return np.column_stack([x1**2, x2**2, x1 * x2, x1, x2, np.ones_like(x1)])


def symmetric(a11, a22, a12, a1, a2, a0):
    """Matrix A (3, 3) of the Appendix from the vector a."""
    return np.array([[a11, a12 / 2, a1 / 2], [a12 / 2, a22, a2 / 2], [a1 / 2, a2 / 2, a0]])


def as_surface(z):
    """One sampled surface as (P, P, 1)."""
    side = round(np.sqrt(len(z)))
    return np.asarray(z).reshape(side, side, 1)


def bowls(rng, count):
    """Positive definite A' (N, 2, 2) with curvatures from 0.1 to 10 in any direction."""
    angle = rng.uniform(0, np.pi, count)
    axes = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], 1)
    axes = axes.reshape(-1, 2, 2)
    curvatures = 10.0 ** rng.uniform(-1, 1, (count, 1, 2))
    return (axes * curvatures) @ axes.transpose(0, 2, 1)


def lines(rng, count):
    """Lines g . v = h (g (N, 2) of any length, h (N,)) that pass within 5 pixels of the origin."""
    g = rng.normal(size=(count, 2)) * 10.0 ** rng.uniform(-4, 2, (count, 1))
    return g, np.linalg.norm(g, axis=1) * rng.uniform(-5, 5, count)


@pytest.mark.parametrize('sigma', [0.0, 0.7, 2.0])
@pytest.mark.parametrize('side', SIDES)
def test_an_exact_paraboloid_is_recovered_from_its_samples(side, sigma):
    rng = np.random.default_rng(side)
    a = rng.normal(size=(6, 20))
    fitted = fit_paraboloids((design(window(side)) @ a).reshape(side, side, 20),
                             np.zeros((20, 2)), sigma)
    for k in range(20):
        A = symmetric(*a[:, k])
        assert np.allclose(fitted.A[k], A[:2, :2], atol=1e-10)
        assert np.allclose(fitted.b[k], A[:2, 2], atol=1e-10)
        assert fitted.c[k] == pytest.approx(A[2, 2], abs=1e-10)


@pytest.mark.parametrize('sigma', [0.0, 1.0, 3.0])
@pytest.mark.parametrize('side', SIDES)
def test_the_fit_is_the_least_squares_solution_of_the_appendix(side, sigma):
    rng = np.random.default_rng(100 + side)
    z = rng.integers(0, 257, side * side).astype(np.uint16)
    places = window(side)
    weights = np.exp(-(places**2).sum(1) / (2 * sigma**2)) if sigma else np.ones(len(z))
    root = np.sqrt(weights)
    a = np.linalg.lstsq(design(places) * root[:, None], z * root, rcond=None)[0]
    fitted = fit_paraboloids(as_surface(z), np.zeros((1, 2)), sigma)
    A = symmetric(*a)
    assert np.allclose(fitted.A[0], A[:2, :2], atol=1e-8)
    assert np.allclose(fitted.b[0], A[:2, 2], atol=1e-8)
    assert fitted.c[0] == pytest.approx(A[2, 2], abs=1e-8)


def test_a_prime_b_and_c_are_those_that_the_paper_takes_from_the_quadratic_form_in_pixels():
    """Fitted in the image's own coordinates, A_k gives A', b_k and c_k by y_k."""
    z = np.random.default_rng(7).integers(0, 257, 49).astype(np.uint16)
    y = np.array([31.0, -12.0])
    A_k = symmetric(*np.linalg.lstsq(design(window(7) + y), z.astype(float), rcond=None)[0])
    select, y_1 = np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.array([*y, 1.0])
    fitted = fit_paraboloids(as_surface(z), y[None], 0.0)
    assert np.allclose(fitted.A[0], select @ A_k @ select.T, atol=1e-6)
    assert np.allclose(fitted.b[0], select @ A_k @ y_1, atol=1e-6)
    assert fitted.c[0] == pytest.approx(y_1 @ A_k @ y_1, abs=1e-6)
    place = y + np.array([1.25, -2.5])
    assert fitted.values(place[None])[0] == pytest.approx(
        np.array([*place, 1]) @ A_k @ np.array([*place, 1]), abs=1e-6)


def test_windows_are_indexed_by_row_and_then_column():
    places = window(5)
    fitted = fit_paraboloids(as_surface((places[:, 0] - 1)**2 + 3 * (places[:, 1] + 2)**2),
                             np.array([[40.0, 50.0]]), 0.0)
    assert np.allclose(fitted.minima(), [[41, 48]])


def test_the_gradient_vanishes_in_the_minima_and_nothing_near_is_lower():
    rng = np.random.default_rng(8)
    bowl = Paraboloids(rng.uniform(0, 100, (50, 2)), bowls(rng, 50), rng.normal(size=(50, 2)),
                       rng.normal(size=50), np.ones(50, bool))
    lowest = bowl.values(bowl.minima())
    for step in ([1e-3, 0], [-1e-3, 0], [0, 1e-3], [0, -1e-3], [1, 1], [-1, 1]):
        assert (bowl.values(bowl.minima() + step) > lowest).all()


def paper_optimum(A, b, g, h):
    """Evaluate the closed form as the paper prints it, where its b_k is -(b_1, b_2)^T."""
    (a11, a12), (_, a22) = A
    b1, b2 = -b
    g1, g2 = g
    v1 = ((g1 * g2 * b2 - a22 * g1 * h - b1 * g2**2 + a12 * g2 * h)
          / (2 * a12 * g1 * g2 - a22 * g1**2 - a11 * g2**2))
    return np.array([v1, h / g2 - g1 / g2 * v1])


def lagrange_optimum(A, b, g, h):
    """Solve the linear system of the paper's Lagrangian as it stands."""
    system = np.block([[A, g[:, None]], [g[None], np.zeros((1, 1))]])
    return np.linalg.solve(system, [*-b, h])[:2]


def brute_force_optimum(A, b, g, h):
    """
    Find the lowest point of the line by search alone.

    In 40 decimal places: in doubles, a search sees a minimum only to half of their digits.
    """
    with localcontext() as context:
        context.prec = 40
        a11, a12, a22, b1, b2 = (Decimal(float(v)) for v in (*A[0], A[1, 1], *b))
        g1, g2, h = (Decimal(float(v)) for v in (*g, h))
        square = g1 * g1 + g2 * g2

        def point(s):
            return h * g1 / square - s * g2, h * g2 / square + s * g1

        def value(s):
            v1, v2 = point(s)
            return (a11 * v1 + 2 * a12 * v2 + 2 * b1) * v1 + (a22 * v2 + 2 * b2) * v2

        low, high = (Decimal(sign * 1000) / square.sqrt() for sign in (-1, 1))
        for _ in range(100):
            third = (high - low) / 3
            if value(low + third) < value(high - third):
                high -= third
            else:
                low += third
        return np.array([float(v) for v in point((low + high) / 2)])


def test_the_optimum_on_the_line_is_the_papers_the_lagrangians_and_the_one_found_by_search():
    rng = np.random.default_rng(9)
    A, b = bowls(rng, 30), rng.normal(size=(30, 2)) * 3
    g, h = lines(rng, 30)
    v = constrained_minimum(A, b, g, h)
    for k in range(30):
        problem = A[k], b[k], g[k], h[k]
        assert np.allclose(v[k], paper_optimum(*problem), rtol=0, atol=1e-9)
        assert np.allclose(v[k], lagrange_optimum(*problem), rtol=0, atol=1e-9)
        assert np.allclose(v[k], brute_force_optimum(*problem), rtol=0, atol=1e-9)


coefficients = st.floats(-4, 4)


@given(angle=st.floats(0, np.pi), size=st.floats(-4, 2), h=st.floats(-5, 5),
       diagonal=st.tuples(st.floats(0.1, 9), st.floats(0.1, 9)), lean=st.floats(-0.9, 0.9),
       b=st.tuples(coefficients, coefficients))
@example(angle=0.0, size=0.0, h=2.0, diagonal=(1.0, 2.0), lean=0.5, b=(1.0, -1.0))
@example(angle=np.pi / 2, size=0.0, h=2.0, diagonal=(1.0, 2.0), lean=0.5, b=(1.0, -1.0))
@example(angle=1e-9, size=-4.0, h=-3.0, diagonal=(0.1, 9.0), lean=-0.9, b=(4.0, 4.0))
def test_on_every_line_the_optimum_is_the_lagrangians(angle, size, h, diagonal, lean, b):
    """Vertical ones, too, where the printed closed form divides by zero."""
    a11, a22 = diagonal
    a12 = lean * np.sqrt(a11 * a22)
    A, b = np.array([[a11, a12], [a12, a22]]), np.array(b)
    normal = np.array([np.cos(angle), np.sin(angle)])
    g, h = 10**size * normal, 10**size * h
    v = constrained_minimum(A[None], b[None], g[None], np.array([h]))[0]
    # the Lagrangian's system with the line's normal scaled to one, for the solver's sake
    assert np.allclose(v, lagrange_optimum(A, b, normal, h / 10**size), rtol=0, atol=1e-9)
    if abs(normal[1]) > 0.05:
        assert np.allclose(v, paper_optimum(A, b, g, h), rtol=0, atol=1e-9)


def test_on_upright_and_level_lines_the_optimum_is_that_of_a_parabola():
    A, b = np.array([[[2.0, 0.5], [0.5, 1.0]]]), np.array([[0.3, -0.7]])
    # v_1 = 4: the parabola v_2^2 + 2 (0.5 * 4 - 0.7) v_2 + ... has its vertex at -1.3
    assert np.allclose(constrained_minimum(A, b, np.array([[1e-3, 0]]), np.array([4e-3])),
                       [[4, -1.3]], atol=1e-12)
    # v_2 = -2: the parabola 2 v_1^2 + 2 (0.5 * -2 + 0.3) v_1 + ... has its vertex at 0.35
    assert np.allclose(constrained_minimum(A, b, np.array([[0, -5.0]]), np.array([10.0])),
                       [[0.35, -2]], atol=1e-12)


def test_on_a_surface_that_is_flat_along_the_line_the_nearest_point_is_taken():
    A, g = np.array([[[3.0, 0], [0, 0]]]), np.array([[2.0, 0]])
    v = constrained_minimum(A, np.array([[1.0, 0]]), g, np.array([3.0]))
    assert np.allclose(v, [[1.5, 0]])


def test_the_minimum_on_a_line_is_the_surface_minimum_plus_a_squared_distance():
    """Q(v_opt) = Q(v*) + (y*^T l)^2 / (g^T A'^-1 g): what makes JET a least-squares problem."""
    rng = np.random.default_rng(10)
    count = 200
    A = bowls(rng, count)
    A[::4] *= -1  # it holds for peaks,
    A[1::4, 0, 0] *= -1  # and for saddles
    y = rng.uniform(0, 1000, (count, 2))
    surfaces = Paraboloids(y, A, rng.normal(size=(count, 2)), rng.uniform(0, 50, count),
                           np.ones(count, bool))
    g, h = lines(rng, count)
    l3 = -h - (g * y).sum(1)  # the lines are (g, l3) in pixels of the image, with h = -y^T l
    v_opt = constrained_minimum(A, surfaces.b, g, h)
    y_star = surfaces.minima()
    beside = ((y_star * g).sum(1) + l3)**2 / np.einsum('ni,nij,nj->n', g, np.linalg.inv(A), g)
    total = surfaces.values(y_star) + beside
    assert np.allclose(surfaces.values(y + v_opt), total, rtol=1e-8, atol=1e-8)


def test_surfaces_without_a_minimum_are_those_with_an_eigenvalue_that_is_not_positive():
    rng = np.random.default_rng(11)
    A = rng.normal(size=(500, 2, 2))
    A = A + A.transpose(0, 2, 1)
    A[0], A[1], A[2] = np.zeros((2, 2)), np.diag([1.0, 0]), np.eye(2)
    found = indefinite(Paraboloids(np.zeros((500, 2)), A, np.zeros((500, 2)), np.zeros(500),
                                   np.ones(500, bool)))
    assert np.array_equal(found, np.linalg.eigvalsh(A)[:, 0] <= 0)
    assert found[:3].tolist() == [True, True, False]


def test_projection_gives_every_surface_a_minimum_and_keeps_positive_definite_ones():
    rng = np.random.default_rng(12)
    A = bowls(rng, 60)
    A[:20] *= -1
    A[20:30] = 0
    before = Paraboloids(rng.normal(size=(60, 2)), A, rng.normal(size=(60, 2)),
                         rng.normal(size=60), np.ones(60, bool))
    after = project_to_positive(before)
    assert (np.linalg.eigvalsh(after.A)[:, 0] > 0).all()
    assert not indefinite(after).any()
    assert np.allclose(after.A[30:], A[30:])
    assert np.array_equal(after.b, before.b) and np.array_equal(after.c, before.c)
    # a saddle keeps the direction in which it curves upwards
    saddle = Paraboloids(np.zeros((1, 2)), np.array([[[3.0, 4.0], [4.0, -3.0]]]),
                         np.zeros((1, 2)), np.zeros(1), np.ones(1, bool))
    up = np.array([2.0, 1.0]) / np.sqrt(5)
    assert np.allclose(project_to_positive(saddle).A[0] @ up, 5 * up)


def test_unusable_surfaces_do_not_affect_the_projection():
    """Such as are out of the image, or hidden."""
    rng = np.random.default_rng(14)
    A = np.append(1e3 * bowls(rng, 20), np.tile(np.eye(2), (40, 1, 1)), 0)
    A[:5] *= -1
    before = Paraboloids(np.zeros((60, 2)), A, rng.normal(size=(60, 2)), np.zeros(60),
                         np.arange(60) < 20)
    seen = np.flatnonzero(before.usable)
    assert np.array_equal(project_to_positive(before).A[seen],
                          project_to_positive(before.of(seen)).A)


def test_inverses_of_two_by_two_matrices_are_exact_and_those_of_singular_ones_finite():
    rng = np.random.default_rng(13)
    A = bowls(rng, 100)
    assert np.allclose(inverse_2x2(A), np.linalg.inv(A), rtol=1e-10)
    singular = inverse_2x2(np.array([
        [[1.0, 1.0], [1.0, 1.0]], [[0, 0], [0, 4.0]], [[-1.0, 1.0], [1.0, -1.0]], [[0, 0], [0, 0]],
        [[1e-6, 0], [0, -1e-6]], [[-1e-6, 0], [0, -1e-6]]]))
    assert np.isfinite(singular).all()
    assert (np.abs(singular).max((1, 2)) > 1e5).all()
