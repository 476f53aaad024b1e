"""Messages: frames and signs, for both families of classes."""

from importlib import import_module

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.geometry import rotation_exp, unit
from djet_ros.core.types import RelativePose, Status
from djet_ros.odometry.messages import (
    camera_frame,
    in_convention,
    Messages,
    mounted_frame,
    stamp_ns,
    twist,
)
from djet_ros.odometry.result import camera_motion, OdometryResult
from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
import ros_messages
from scipy.spatial.transform import Rotation

OPTICAL = OdometryConfig(frame_convention='optical')
STAMP = 1_700_000_000_123_456_789


def ros_message_type(name):
    package, _, cls = name.split('/')
    return getattr(import_module(f'{package}.msg'), cls)


@pytest.fixture(params=['rosbags', pytest.param('rclpy', marks=pytest.mark.ros)])
def family(request):
    """Return the class for a type name, and a function that serialises a message."""
    if request.param == 'rosbags':
        return ros_messages.message_type, ros_messages.serialised
    serialization = pytest.importorskip('rclpy.serialization', reason='rclpy is not installed')
    return ros_message_type, serialization.serialize_message


def covariance(rng, size):
    root = rng.normal(size=(6, 6)) * size
    return root @ root.T


def a_result(seed=0, **changes):
    """Return a result in which all values differ."""
    rng = np.random.default_rng(seed)
    relative = RelativePose(Status.OK, rotation_exp(rng.normal(size=3) * 0.3),
                            unit(rng.normal(size=3)))
    motion = camera_motion(relative, 0.7)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_exp(rng.normal(size=3)), rng.normal(size=3) * 9
    fields = {
        'stamp_ns': STAMP, 'frame_id': 'cam_optical_frame', 'status': Status.OK,
        'previous_stamp_ns': STAMP - 250_000_000,
        'since_ns': STAMP - 250_000_000, 'relative': relative, 'motion': motion,
        'pose': pose, 'motion_covariance': covariance(rng, 0.1),
        'pose_covariance': covariance(rng, 0.2), 'scale': 0.7, 'scale_known': True}
    return OdometryResult(**{**fields, **changes})


def matrix(pose):
    """Return the pose (4, 4) of a message."""
    result = np.eye(4)
    q, p = pose.orientation, pose.position
    result[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    result[:3, 3] = p.x, p.y, p.z
    return result


def test_every_message_fits_the_classes_and_is_serialised(family):
    message_type, serialised = family
    make, result = Messages(message_type, OdometryConfig()), a_result()
    picture = np.zeros((4, 6, 3), np.uint8)
    for message in (
            make.relative_pose(result), make.relative_pose_cov(result), make.odometry(result),
            make.odometry(a_result(since_ns=None)), make.transform(result),
            make.path([make.pose_stamped(result)] * 2),
            make.diagnostics(STAMP, 'vo_node: test', 'WARN', 'summary', {'rate (Hz)': '9.9'}),
            make.picture(STAMP, 'camera', picture)):
        assert len(serialised(message)) > 20


def test_stamps_are_the_images_own_to_the_nanosecond(family):
    make = Messages(family[0], OdometryConfig())
    for message in (make.relative_pose(a_result()), make.odometry(a_result())):
        assert stamp_ns(message.header) == STAMP
    assert make.header(np.int64(5), 'x').stamp.nanosec == 5


def test_a_relative_pose_is_the_current_camera_in_the_previous_one(family):
    result = a_result()
    R, t = result.relative.R, result.relative.t
    message = Messages(family[0], OPTICAL).relative_pose(result)
    assert message.header.frame_id == 'cam_optical_frame'
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = R.T, -0.7 * R.T @ t
    assert np.allclose(matrix(message.pose), expected, atol=1e-15)
    # A static point X in the previous camera is R X + t in the current one.
    before = np.array([1.0, 2, 5, 1])
    now = np.append(R @ before[:3] + 0.7 * t, 1)
    assert np.allclose(matrix(message.pose) @ now, before)


def test_body_axes_are_forward_left_up_at_both_ends_of_a_pose(family):
    forward_and_yaw_right = np.eye(4)
    forward_and_yaw_right[:3, :3] = rotation_exp(np.array([0, 0.1, 0]))
    forward_and_yaw_right[:3, 3] = 0.5, -0.25, 2.0
    result = a_result(motion=forward_and_yaw_right, pose=forward_and_yaw_right,
                      motion_covariance=np.diag([1.0, 2, 3, 4, 5, 6]))
    config = OdometryConfig(frame_convention='body')
    message = Messages(family[0], config).relative_pose_cov(result)
    assert message.header.frame_id == 'cam_frame'
    body = matrix(message.pose.pose)
    assert np.allclose(body[:3, 3], [2.0, -0.5, 0.25])
    assert np.allclose(Rotation.from_matrix(body[:3, :3]).as_rotvec(), [0, 0, -0.1])
    assert np.allclose(np.diag(np.reshape(message.pose.covariance, (6, 6))), [3, 1, 2, 6, 4, 5])


def test_by_default_driving_ahead_is_along_x_and_level(family):
    ahead = np.eye(4)
    # a camera that looks ahead, after 2 m and a turn to the left
    ahead[:3, :3], ahead[:3, 3] = rotation_exp(np.array([0, -0.1, 0])), (0.0, 0.0, 2.0)
    message = Messages(family[0], OdometryConfig()).odometry(a_result(motion=ahead, pose=ahead))
    pose = matrix(message.pose.pose)
    assert np.allclose(pose[:3, 3], [2.0, 0, 0])
    assert np.allclose(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), [0, 0, 0.1])
    assert message.twist.twist.linear.x > 7.9
    assert message.twist.twist.angular.z == pytest.approx(0.4)
    assert (message.header.frame_id, message.child_frame_id) == ('odom', 'cam_frame')


@pytest.mark.parametrize(('config', 'frame', 'ahead'), [
    ({}, 'cam_optical_frame', [0, 0, 1]),
    ({'camera_frame': 'mine'}, 'mine', [1, 0, 0]),
    ({'camera_frame': 'mine', 'frame_convention': 'optical'}, 'mine', [0, 0, 1])])
def test_the_mounting_is_looked_up_for_a_frame_with_its_own_axes(config, frame, ahead):
    name, axes = mounted_frame(OdometryConfig(**config), 'cam_optical_frame')
    assert name == frame
    assert np.allclose(axes[:3, :3] @ [0, 0, 1], ahead)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6))
def test_the_convention_does_not_change_what_poses_say(seed):
    result = a_result(seed)
    turned = in_convention(result, 'body')
    assert in_convention(result, 'optical') is result
    assert np.isclose(np.trace(turned.motion), np.trace(result.motion))
    assert np.isclose(np.linalg.norm(turned.pose[:3, 3]), np.linalg.norm(result.pose[:3, 3]))
    assert np.allclose(np.linalg.eigvalsh(turned.pose_covariance),
                       np.linalg.eigvalsh(result.pose_covariance))
    chained = in_convention(a_result(seed, pose=result.pose @ result.motion), 'body').pose
    assert np.allclose(turned.pose @ turned.motion, chained)


@pytest.mark.parametrize('configured, convention, image_frame, expected', [
    ('', 'optical', 'cam', 'cam'), ('mine', 'optical', 'cam', 'mine'),
    ('mine', 'body', 'cam_optical_frame', 'mine'), ('', 'body', 'cam_optical_frame', 'cam_frame'),
    ('', 'body', 'left_optical', 'left'), ('', 'body', 'cam', 'cam_body'), ('', 'body', '', '')])
def test_the_frame_is_named_after_what_it_is(configured, convention, image_frame, expected):
    config = OdometryConfig(camera_frame=configured, frame_convention=convention)
    assert camera_frame(config, image_frame) == expected


def test_odometry_has_the_pose_in_the_odom_frame_and_the_twist_in_the_camera(family):
    result = a_result()
    config = OdometryConfig(odom_frame='world', frame_convention='optical')
    message = Messages(family[0], config).odometry(result)
    assert (message.header.frame_id, message.child_frame_id) == ('world', 'cam_optical_frame')
    assert np.allclose(matrix(message.pose.pose), result.pose)
    assert np.allclose(np.reshape(message.pose.covariance, (6, 6)), result.pose_covariance)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    seconds = 0.25
    R = result.motion[:3, :3]
    assert np.allclose([linear.x, linear.y, linear.z], R.T @ result.motion[:3, 3] / seconds)
    assert np.allclose(rotation_exp(np.array([angular.x, angular.y, angular.z]) * seconds), R)


def test_the_covariance_of_a_twist_is_that_of_motions_with_errors():
    """Also of a motion whose rotation and position err together, after an uncertain standstill."""
    rng, since, own = np.random.default_rng(4), *(covariance(np.random.default_rng(seed), 0.003)
                                                  for seed in (1, 2))
    result = a_result(since_covariance=since, motion_covariance=own)
    velocities = []
    for errors in rng.multivariate_normal(np.zeros(12), np.block([
            [since, np.zeros((6, 6))], [np.zeros((6, 6)), own]]), 20_000):
        rest, motion = np.eye(4), result.motion.copy()
        rest[:3, 3], rest[:3, :3] = errors[:3], rotation_exp(errors[3:6])
        motion[:3, 3] += errors[6:9]
        motion[:3, :3] = rotation_exp(errors[9:]) @ motion[:3, :3]
        whole = rest @ motion
        # Along the axes of the camera as it is estimated, to first order.
        turned = Rotation.from_matrix(result.motion[:3, :3].T @ whole[:3, :3]).as_rotvec()
        velocities.append(np.append(whole[:3, :3].T @ whole[:3, 3], turned) / 0.25)
    white = np.linalg.solve(np.linalg.cholesky(twist(result)[1]), np.transpose(velocities))
    assert np.abs(np.cov(white) - np.eye(6)).max() < 0.05


def test_all_covariances_of_a_twist_turn_with_its_axes():
    result = a_result(since_covariance=covariance(np.random.default_rng(1), 0.1))
    optical, body = (twist(in_convention(result, name)) for name in ('optical', 'body'))
    turn = np.kron(np.eye(2), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert np.allclose(body[0], turn @ optical[0])
    assert np.allclose(body[1], turn @ optical[1] @ turn.T)


def test_no_covariance_is_zero_infinite_or_absurd(family):
    first = a_result(since_ns=None, pose_covariance=np.zeros((6, 6)))
    message = Messages(family[0], OdometryConfig()).odometry(first)
    for values in (message.pose.covariance, message.twist.covariance):
        diagonal = np.diag(np.reshape(values, (6, 6)))
        assert (diagonal > 0).all()
        assert (diagonal < 1e12).all()
    assert np.array_equal(twist(first)[0], np.zeros(6))
    assert twist(first)[1][0, 0] >= 1e6


@pytest.mark.parametrize('level', ['OK', 'WARN', 'ERROR'])
def test_diagnostics_levels_are_the_classes_own(family, level):
    message = Messages(family[0], OdometryConfig()).diagnostics(
        STAMP, 'vo_node: test', level, 'tracking', {'a': 'b'})
    status = message.status[0]
    assert status.level == getattr(type(status), level)
    assert (status.message, status.values[0].key, status.values[0].value) == ('tracking', 'a', 'b')


def test_a_picture_keeps_its_pixels(family):
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    message = Messages(family[0], OdometryConfig()).picture(STAMP, 'camera', pixels[:, ::-1])
    assert (message.height, message.width, message.step) == (4, 6, 18)
    assert np.array_equal(np.frombuffer(message.data, np.uint8).reshape(4, 6, 3), pixels[:, ::-1])
