"""Covariance of an integrated pose whose steps have correlated errors."""

from dataclasses import replace

from cards import Cards, pose
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_exp, rotation_log
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.scale import Common, Length
from djet_ros.odometry.uncertainty import (
    _CORRELATED,
    _PERSISTENCE,
    compose,
    inflated_for_chain,
    PathCovariance,
)
from djet_ros.odometry.visual_odometry import VisualOdometry
import numpy as np
import pytest

# A step of a metre with a rotation; the root of its covariance; steps and samples.
STEP = np.eye(4)
STEP[:3, :3], STEP[:3, 3] = rotation_exp(np.array([0.01, 0.08, 0.0])), (0.05, 0.0, 1.0)
ROOT = np.diag([2e-3, 1e-3, 4e-3, 2e-3, 1e-3, 5e-4])
COUNT, SAMPLES = 24, 4000


def sampled(scales, own):
    """
    Return the sample covariance (6, 6) of the last pose of a path of steps with errors.

    scales: (COUNT, SAMPLES) logarithms of the relative errors of lengths; own: (COUNT, SAMPLES, 6)
    further errors, along the axes of the previous camera.
    """
    true, R, p = np.eye(4), np.tile(np.eye(3), (SAMPLES, 1, 1)), np.zeros((SAMPLES, 3))
    for scale, error in zip(scales, own):
        motion = STEP[:3, 3] * np.exp(scale)[:, None] + error[:, :3]
        p = p + np.einsum('nij,nj->ni', R, motion)
        R = R @ rotation_exp(error[:, 3:]) @ STEP[:3, :3]
        true = true @ STEP
    off = np.concatenate([p - true[:3, 3], rotation_log(R @ true[:3, :3].T)], axis=1)
    return off.T @ off / SAMPLES


def integrated(covariance, commons, by_pairs):
    """Return the covariance (6, 6) of the last pose of a path."""
    path, here = PathCovariance(), np.eye(4)
    for common in commons:
        moved = path.moved_by_pair if by_pairs else path.moved
        path, here = moved(here, STEP, covariance, common), here @ STEP
    return path.pose


def same(one, other):
    """Assert that two covariances agree in all directions, within their sampling errors."""
    ratios = np.linalg.eigvals(np.linalg.solve(one, other)).real
    assert ratios == pytest.approx(np.ones(6), abs=0.15)


def test_a_drifting_and_remeasured_scale_has_a_consistent_covariance():
    rng = np.random.default_rng(0)
    factor, share = np.zeros(SAMPLES), rng.normal(0, 0.02, SAMPLES)
    variance, scales, commons = 0.0, [], []
    for number in range(COUNT):
        kept = 0.5 if number % 8 == 7 else 1.0
        noise = rng.normal(0, 0.004, SAMPLES)
        factor, variance = kept * factor + noise, kept**2 * variance + 0.004**2
        scales.append(factor + share)
        commons.append(Common(np.array([variance, 0.02**2]), np.array([kept, 1.0])))
    own = rng.normal(size=(COUNT, SAMPLES, 6)) @ ROOT
    same(integrated(ROOT**2, commons, by_pairs=False), sampled(scales, own))


def test_consecutive_pairs_have_correlated_errors():
    rng = np.random.default_rng(1)
    lasting, own = np.zeros((SAMPLES, 6)), []
    for number in range(COUNT):
        fresh = np.sqrt(_CORRELATED * (1 - _PERSISTENCE**2 * (number > 0)))
        lasting = _PERSISTENCE * lasting + fresh * rng.normal(size=(SAMPLES, 6))
        rest = np.sqrt(1 - _CORRELATED) * rng.normal(size=(SAMPLES, 6))
        own.append((lasting + rest) @ ROOT)
    found = sampled(np.zeros((COUNT, SAMPLES)), np.array(own))
    same(integrated(ROOT**2, [None] * COUNT, by_pairs=True), found)
    alone = integrated(ROOT**2, [None] * COUNT, by_pairs=False)
    assert np.trace(found[3:, 3:]) > 2 * np.trace(alone[3:, 3:])


def test_the_covariance_does_not_depend_on_the_first_camera():
    common = Common(np.array([1e-4, 1e-3]), np.ones(2))
    turned = np.eye(4)
    turned[:3, :3] = rotation_exp(np.array([0.3, -1.2, 2.0]))
    paths = []
    for here in np.eye(4), turned:
        path = PathCovariance()
        for _ in range(5):
            path, here = path.moved_by_pair(here, STEP, ROOT**2, common), here @ STEP
        paths.append(path.pose)
    turn = np.kron(np.eye(2), turned[:3, :3])
    assert paths[1] == pytest.approx(turn @ paths[0] @ turn.T, abs=1e-15)


def test_common_errors_are_in_the_sigma_of_metric_lengths_only():
    common = Common(np.array([0.03**2, 0.04**2]), np.ones(2))
    metric = Length(2.0, 2 * np.sqrt(0.05**2 + 0.01**2), True, common=common)
    assert metric.own.sigma == pytest.approx(0.02)
    assert replace(metric, metric=False).own.sigma == metric.sigma


def test_a_metric_path_has_the_relative_error_of_its_source():
    common = Common(np.array([0.0, 0.05**2]), np.ones(2))
    path, here, motion = PathCovariance(), np.eye(4), np.eye(4)
    motion[2, 3] = 1.0
    for _ in range(100):
        path, here = path.moved_by_pair(here, motion, np.eye(6) * 1e-12, common), here @ motion
    assert np.sqrt(path.pose[2, 2]) == pytest.approx(5, rel=1e-3)
    back = motion.copy()
    back[2, 3] = -1.0
    for _ in range(100):
        path, here = path.moved_by_pair(here, back, np.eye(6) * 1e-12, common), here @ back
    assert np.sqrt(path.pose[2, 2]) < 0.01  # a closed loop, of whatever scale


def test_the_covariance_that_is_published_is_that_of_its_steps():
    cards, here, results = Cards(), np.eye(4), []
    odometry = VisualOdometry(EstimatorConfig(max_features=800))
    path = PathCovariance()
    for number in range(6):
        frame = cards.frame(0.0, here, noise=number)
        before = results[-1].pose if results else np.eye(4)
        result = odometry.process(Frame(frame.gray, frame.K, number * 10**8, 'camera'))
        if number:
            assert result.common is not None
            path = path.moved(before, np.linalg.inv(before) @ result.pose,
                              result.motion_covariance, result.common)
            assert result.pose_covariance == pytest.approx(path.pose)
        results.append(result)
        here = here @ pose(x=0.16, z=0.12)
    wandered = [result.common.variances[0] for result in results[1:]]
    assert all(np.diff(wandered) > 0)


def test_independent_edges_of_a_graph_add_up_to_the_integrated_covariance():
    ahead, covariance = pose(z=1.0), ROOT @ ROOT
    path, chain, here = PathCovariance(), np.zeros((6, 6)), np.eye(4)
    for _ in range(300):
        path = path.moved_by_pair(here, ahead, covariance)
        chain = compose(here, chain, ahead, inflated_for_chain(covariance))
        here = here @ ahead
    assert np.linalg.eigvals(np.linalg.solve(chain, path.pose)).real == pytest.approx(
        np.ones(6), abs=0.1)
