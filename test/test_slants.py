"""Slants of surfaces: exact planes are estimated, points beyond a depth edge have no effect."""

from __future__ import annotations

from djet_ros.core.geometry import patch_warp, rotation_exp, slant_warp
from djet_ros.core.slants import slopes, slopes_of_all
import numpy as np
import pytest

K = np.array([[700.0, 0, 600], [0, 650, 180], [0, 0, 1]])


def test_the_slant_warp_maps_points_of_a_plane() -> None:
    R, t = rotation_exp(np.array([0.02, -0.05, 0.03])), np.array([0.3, -0.1, -0.8])
    x, rho, lean = np.array([710.0, 260.0]), 0.12, np.array([-2e-4, 6e-4])

    def seen(off: np.ndarray) -> tuple[np.ndarray, float]:
        ray = np.linalg.inv(K) @ [*(x + off), 1.0]
        place = R @ ray + (rho + lean @ off) * t
        return (K @ place)[:2] / place[2], place[2]

    y, z = seen(np.zeros(2))
    y, growth = y[None], np.array([1 / z])
    warp = patch_warp(K, R, y, growth) + slant_warp(K, t, y, growth, lean[None])
    for step in ((0.01, 0), (0, 0.01), (20, -30), (-10, 40)):
        *moved, deeper = warp[0] @ step
        assert y[0] + np.divide(moved, 1 + deeper) == pytest.approx(seen(np.array(step))[0])


def test_the_slant_of_a_road_is_estimated_from_its_points() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform((0, 230), (1200, 370), (600, 2))
    rho = (x[:, 1] - 180) / (650 * 1.65)  # exact, for a camera 1.65 m above it
    sigma = 0.005 * rho
    inner = (np.abs(x - [600, 300]) < [500, 30]).all(1)
    found = slopes(x, rho, sigma, x[inner])
    assert found[:, 0] == pytest.approx(0, abs=3e-4)
    assert found[:, 1] == pytest.approx(1 / (x[inner, 1] - 180), rel=0.05)
    noisy = slopes(x, rho + rng.normal(size=600) * sigma, sigma, x[inner])
    assert np.median(np.abs(noisy - found).max(1)) < 1e-3


def test_points_beyond_a_depth_edge_do_not_bias_the_slant() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 300, (900, 2))
    behind = x[:, 0] > 150
    rho = np.where(behind, 0.05, 0.2)
    before = np.abs(x - [130, 150]) < [5, 120]
    found = slopes(x, rho, 0.01 * rho, x[before.all(1)])
    assert np.median(np.abs(found)) < 1e-3


def test_the_slant_is_estimated_at_all_points_at_once() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform((0, 230), (1200, 370), (1200, 2))
    rho, slope = (x[:, 1] - 180) / (650 * 1.65), 1 / (650 * 1.65)
    sigma = 0.005 * rho
    inner = (np.abs(x - [600, 300]) < [560, 40]).all(1)
    found = slopes_of_all(x, rho, sigma)
    assert found[inner] == pytest.approx(np.tile([0, slope], (inner.sum(), 1)), abs=0.1 * slope)
    noisy = slopes_of_all(x, rho + rng.normal(size=1200) * sigma, sigma)
    assert np.median(np.abs(noisy - found)[inner].max(1)) < 0.1 * slope
    # The sign of t is free, and so is that of all depths.
    assert slopes_of_all(x, -rho, sigma) == pytest.approx(-found)


def test_of_all_points_those_beyond_a_depth_edge_do_not_bias_the_rest() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(0, 300, (900, 2))
    rho = np.where(x[:, 0] > 150, 0.05, 0.2)
    assert np.median(np.abs(slopes_of_all(x, rho, 0.01 * rho)) / rho[:, None]) < 1e-3


@pytest.mark.parametrize('way', [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_what_is_seen_nearly_edge_on_is_fronto_parallel_whichever_way_it_leans(
        way: tuple[int, int]) -> None:
    """A patch of it would be that of other points after any motion."""
    x = np.random.default_rng(6).uniform(100, 116, (300, 2))
    for lean, taken in ((0.01, True), (0.06, False)):
        rho = 0.1 * (1 + lean * (x - 108) @ way)
        for found in (slopes(x, rho, 1e-3 * rho, x), slopes_of_all(x, rho, 1e-3 * rho)):
            assert found.any(1).mean() > 0.9 if taken else not found.any()
        # As depths are while the sign of the translation is not known.
        np.testing.assert_allclose(slopes_of_all(x, -rho, 1e-3 * rho), -found, atol=1e-12)


def test_few_or_scattered_points_are_fronto_parallel() -> None:
    x = np.arange(20.0)[:, None] * [200.0, 0.0]
    assert not slopes_of_all(x, np.ones(20), np.full(20, 0.01)).any()
    for few in (0, 3):
        assert not slopes_of_all(x[:few], np.ones(few), np.ones(few)).any()
    scattered = np.random.default_rng(4).uniform(0, 300, (900, 2))
    depths = np.random.default_rng(5).uniform(0.01, 1, 900)
    lean = slopes_of_all(scattered, depths, 0.001 * depths)
    assert (lean != 0).any(1).mean() < 0.05


def test_points_without_neighbours_are_fronto_parallel() -> None:
    x = np.arange(20.0)[:, None] * [200.0, 0.0]
    assert not slopes(x, np.ones(20), np.full(20, 0.01), x).any()
    assert slopes(x[:3], np.ones(3), np.ones(3), x).shape == (20, 2)
    assert slopes(x, np.ones(20), np.ones(20), x[:0]).shape == (0, 2)


def test_points_of_a_road_are_slanted_and_upright_objects_are_not() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform((0, 230), (1200, 370), (900, 2))
    rho = (x[:, 1] - 180) / (650 * 1.65)
    sigma = 0.005 * rho
    standing = np.arange(900) % 10 == 0
    rho[standing] *= 1.3
    found = slopes_of_all(x, rho, sigma)
    inner = ~standing & (np.abs(x - [600, 300]) < [550, 50]).all(1)
    assert np.mean(np.abs(found[inner, 1] * (650 * 1.65) - 1) < 0.1) > 0.9
    assert not found[standing].any()
