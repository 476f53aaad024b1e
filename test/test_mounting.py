"""Pose and velocity of a vehicle by those of its camera, and static transforms."""

from djet_ros.core.geometry import rotation_exp
from djet_ros.odometry.mounting import pose_of_base, twist_of_base
from djet_ros.odometry.static_frames import StaticFrames
from djet_ros.recordings.decoding import MAKE
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

# 0.3 m ahead of the base and 1 m above it, looking ahead: z forward, x right, y down.
AHEAD = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 1.0], [0, 0, 0, 1]])


def random_pose(rng, size=1.0):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation_exp(rng.normal(size=3)), rng.normal(size=3) * size
    return result


def test_a_camera_that_moves_ahead_moves_its_vehicle_ahead():
    ahead = np.eye(4)
    ahead[2, 3] = 2.0
    pose, _ = pose_of_base(ahead, np.eye(6), AHEAD)
    assert np.allclose(pose[:3, 3], [2, 0, 0])
    assert np.allclose(pose[:3, :3], np.eye(3))


def test_a_vehicle_that_rotates_in_place_does_not_move():
    turned = np.eye(4)
    turned[:3, :3] = rotation_exp(np.array([0, 0, 0.5]))
    camera = np.linalg.inv(AHEAD) @ turned @ AHEAD
    assert np.linalg.norm(camera[:3, 3]) > 0.1
    pose, _ = pose_of_base(camera, np.eye(6), AHEAD)
    assert np.allclose(pose, turned)
    # the camera moves sideways in a turn, the base does not
    omega = np.array([0, 0, 0.5])
    at_camera = np.concatenate([AHEAD[:3, :3].T @ np.cross(omega, AHEAD[:3, 3]),
                                AHEAD[:3, :3].T @ omega])
    velocity, _ = twist_of_base(at_camera, np.eye(6), AHEAD)
    assert np.allclose(velocity, [0, 0, 0, 0, 0, 0.5])


@pytest.mark.slow
def test_covariances_are_those_of_sampled_poses_and_velocities():
    rng = np.random.default_rng(3)
    T, pose, velocity = random_pose(rng), random_pose(rng, 5.0), rng.normal(size=6)
    root = rng.normal(size=(6, 6)) * 1e-3
    covariance = root @ root.T
    here, pose_covariance = pose_of_base(pose, covariance, T)
    moving, twist_covariance = twist_of_base(velocity, covariance, T)
    off, off_of_twist = [], []
    for error in rng.multivariate_normal(np.zeros(6), covariance, 20_000):
        disturbed = pose.copy()
        disturbed[:3, :3] = rotation_exp(error[3:]) @ pose[:3, :3]
        disturbed[:3, 3] += error[:3]
        there, _ = pose_of_base(disturbed, covariance, T)
        off.append([*(there - here)[:3, 3], *Rotation.from_matrix(
            there[:3, :3] @ here[:3, :3].T).as_rotvec()])
        off_of_twist.append(twist_of_base(velocity + error, covariance, T)[0] - moving)
    for samples, expected in ((off, pose_covariance), (off_of_twist, twist_covariance)):
        assert np.allclose(np.cov(np.transpose(samples)), expected,
                           atol=0.05 * np.diag(expected).max())


def frames_of(*frames):
    """Return the transforms of (parent, child, pose)."""
    known = StaticFrames()
    for parent, child, pose in frames:
        known.add(MAKE.frame(0, parent, child, pose))
    return known


def test_a_frame_is_found_along_the_tree_upwards_and_downwards():
    rng = np.random.default_rng(5)
    mast, head, wheel = (random_pose(rng) for _ in range(3))
    frames = frames_of(('base', 'mast', mast), ('/mast', '/head', head), ('base', 'wheel', wheel))
    assert np.allclose(frames.transform('base', 'head'), mast @ head)
    assert np.allclose(frames.transform('wheel', 'head'), np.linalg.inv(wheel) @ mast @ head)
    assert np.allclose(frames.transform('/head', 'base'), np.linalg.inv(mast @ head))
    assert frames.transform('base', 'antenna') is None
    # a single transform is exactly that of its message
    assert np.array_equal(frames_of(('base', 'cam', AHEAD)).transform('base', 'cam'), AHEAD)


def test_the_last_transform_counts_and_invalid_ones_are_ignored():
    nonsense = MAKE.frame(0, 'base', 'cam', np.eye(4))
    nonsense.transforms[0].transform.rotation.w = 0.0
    frames = frames_of(('base', 'cam', np.eye(4)), ('base', 'cam', AHEAD), ('a', 'b', np.eye(4)),
                       ('b', 'a', np.eye(4)))
    frames.add(nonsense)
    assert np.array_equal(frames.transform('base', 'cam'), AHEAD)
    assert frames.transform('a', 'cam') is None
