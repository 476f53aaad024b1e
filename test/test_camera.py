"""CameraInfo of raw and of rectified images, and unusable ones."""

import tracemalloc

import cv2
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.odometry.camera import Camera, is_rectified, same_camera
from djet_ros.odometry.images import BadMessage
from djet_ros.odometry.masks import Masks
import numpy as np
import pytest
from ros_messages import camera_info, roi

SIZE = (160, 120)
K = np.array([[130.0, 0, 80.5], [0, 131.0, 58.0], [0, 0, 1]])
P = np.array([[120.0, 0, 79, 0], [0, 120.0, 60, 0], [0, 0, 1, 0]])
DISTORTIONS = {
    'plumb_bob': np.array([-0.28, 0.09, 1e-3, -5e-4, 0.0]),
    'rational_polynomial': np.array([0.4, -0.3, 1e-4, 2e-4, 0.02, 0.7, -0.3, 0.01]),
    'equidistant': np.array([-0.02, 0.01, -0.003, 0.001]),
}
PLACES = np.array([[0.2, 0.1], [-0.3, 0.2], [0.1, -0.25], [0, 0]])


def reason(*args, **changes):
    with pytest.raises(BadMessage) as caught:
        Camera.from_info(camera_info(K, SIZE, **changes), *(args or (False,)))
    return caught.value.reason


@pytest.mark.parametrize('parameter, topic, expected', [
    ('true', '/camera/image_raw', True), ('false', '/camera/image_rect', False),
    ('auto', '/camera/image_rect', True), ('auto', '/camera/image_rect_color', True),
    ('auto', '/camera/image_rect/compressed', True), ('auto', '/camera/image_raw', False),
    ('auto', '/rectory/image_raw', False), ('auto', '/camera/image_unrectified', False),
    ('auto', '', False), ('auto', '/camera/image_direct', False),
    ('auto', '/camera/image_corrected', False), ('auto', '/camera/image_rect/theora', True),
    ('auto', '/camera/image_rect_raw/compressedDepth', True),
    ('auto', '/camera/left_rectified/image/ffmpeg', True), ('auto', '/rgb/rect/image', True),
    ('auto', '/rgb/raw/image', False), ('auto', '/rect/image_raw/foxglove', False),
    ('auto', '/rect/camera/image', False), ('auto', '/compressed', False)])
def test_the_parameter_or_the_topic_says_whether_images_are_rectified(parameter, topic, expected):
    assert is_rectified(parameter, topic) is expected


def test_rectified_images_have_the_camera_p_and_stay_as_they_are():
    camera = Camera.from_info(camera_info(K, SIZE, p=P.ravel(), d=DISTORTIONS['plumb_bob']), True)
    gray = np.zeros(SIZE[::-1], np.uint8)
    assert np.array_equal(camera.K, P[:, :3])
    assert camera.undistort(gray) is gray


def test_rectified_images_without_p_have_the_camera_k():
    assert np.array_equal(Camera.from_info(camera_info(K, SIZE, p=np.zeros(12)), True).K, K)


def test_a_skew_is_taken_but_with_a_distortion_which_opencv_would_undo_without_it():
    skewed = K + np.array([[0, 5.0, 0], [0, 0, 0], [0, 0, 0]])
    assert Camera.from_info(camera_info(skewed, SIZE, p=np.zeros(12)), False).K[0, 1] == 5
    with pytest.raises(BadMessage, match='the skew 5 of images with a distortion'):
        Camera.from_info(camera_info(skewed, SIZE, d=DISTORTIONS['plumb_bob']), False)


def test_raw_images_without_distortion_have_the_camera_k_and_stay_as_they_are():
    camera = Camera.from_info(camera_info(K, SIZE, p=P.ravel()), False)
    gray = np.zeros(SIZE[::-1], np.uint8)
    assert np.array_equal(camera.K, K)
    assert camera.undistort(gray) is gray


@pytest.mark.parametrize('rectified, d', [(True, DISTORTIONS['plumb_bob']), (False, np.zeros(5)),
                                          (False, np.empty(0))])
@pytest.mark.parametrize('k1', [-0.6, 0.05])
def test_images_without_a_distortion_by_their_calibration_have_the_residual_one(rectified, d, k1):
    camera = Camera.from_info(camera_info(K, SIZE, p=P.ravel(), d=d), rectified, k1)
    same = Camera(P[:, :3] if rectified else K, np.array([k1, 0, 0, 0, 0]), SIZE)
    gray = draw_blob(100, 30)
    assert np.array_equal(camera.K, same.K) and camera.k1 == k1
    assert np.array_equal(camera.undistort(gray), same.undistort(gray))
    assert camera.unseen(gray.shape).any()
    assert np.array_equal(camera.unseen(gray.shape), same.unseen(gray.shape))


def test_a_residual_distortion_with_one_of_the_calibration_is_refused():
    info = camera_info(K, SIZE, d=DISTORTIONS['plumb_bob'])
    with pytest.raises(BadMessage, match=r'residual_k1 is 0\.02, but .* -0\.28 0\.09 .* to 0'):
        Camera.from_info(info, False, 0.02)


@pytest.mark.parametrize('k1', [-1000.0, -50.0, 500.0])
def test_a_residual_distortion_that_leaves_hardly_any_image_names_the_parameter(k1):
    camera = Camera.from_info(camera_info(K, SIZE), True, k1)
    with pytest.raises(BadMessage, match=r'leaves \d% .* odometry.residual_k1; .* or to 0'):
        camera.undistort(np.zeros(SIZE[::-1], np.uint8))


@pytest.mark.parametrize('model', DISTORTIONS)
def test_projection_is_the_inverse_of_undistortion(model):
    D = DISTORTIONS[model]
    camera = Camera(K, D, SIZE, model)
    seen, _ = camera.pixels(PLACES, camera.k1)
    undistort = cv2.fisheye.undistortPoints if model == 'equidistant' else cv2.undistortPoints
    assert camera.k1 == D[0]
    assert np.allclose(undistort(seen[:, None], K, D)[:, 0], PLACES, atol=2e-4)
    assert not np.allclose(camera.pixels(PLACES, camera.k1 + 0.1)[0], seen, atol=0.1)


def test_a_fisheye_with_zero_coefficients_is_equidistant():
    camera = Camera.from_info(camera_info(K, SIZE, d=np.zeros(4), distortion_model='equidistant'),
                              False)
    angle = np.radians(20)
    image = camera.undistort(draw_blob(K[0, 2] + K[0, 0] * angle, K[1, 2]))
    x, y = K[0, 2] + K[0, 0] * np.tan(angle), K[1, 2]
    assert np.allclose(blob_near(image, x, y), (x, y), atol=0.15)
    with pytest.raises(BadMessage, match='residual_k1 is 0.01, but .* of its own, 0 0 0 0'):
        Camera.from_info(camera_info(K, SIZE, d=np.zeros(4), distortion_model='equidistant'),
                         False, 0.01)


@pytest.mark.parametrize('model', [*DISTORTIONS, ''])
def test_the_jacobian_of_the_projection_is_its_derivative(model):
    camera = Camera(K, DISTORTIONS.get(model, np.empty(0)), SIZE, model or 'plumb_bob')
    for step in 1e-6 * np.eye(2):
        more, less = (camera.pixels(PLACES + sign * step, 0.05)[0] for sign in (1, -1))
        _, slopes = camera.pixels(PLACES, 0.05)
        assert np.allclose((more - less) / 2e-6, slopes @ step / 1e-6, atol=1e-5)


@pytest.mark.parametrize('model', DISTORTIONS)
def test_undistorted_points_are_those_of_the_pinhole_camera(model):
    D = DISTORTIONS[model]
    info = camera_info(K, SIZE, p=P.ravel(), d=D, distortion_model=model)
    camera = Camera.from_info(info, False)
    assert np.array_equal(camera.K, P[:, :3])
    rays = np.array([[0.2, 0.1, 1], [-0.3, 0.2, 1], [0.1, -0.25, 1]])
    project = cv2.fisheye.projectPoints if model == 'equidistant' else cv2.projectPoints
    seen = project(rays[:, None], np.zeros(3), np.zeros(3), K, D)[0].reshape(-1, 2)
    raw = np.zeros(SIZE[::-1], np.uint8)
    for x, y in seen:
        raw += draw_blob(x, y)
    pinhole = (rays @ camera.K.T)[:, :2]
    undistorted = camera.undistort(raw)
    for x, y in pinhole:
        assert np.allclose(blob_near(undistorted, x, y), (x, y), atol=0.15)


@pytest.mark.parametrize('model', DISTORTIONS)
@pytest.mark.parametrize('outwards', [1, -1])
def test_undistortion_leaves_no_black_border(model, outwards):
    camera = Camera(K, outwards * DISTORTIONS[model], SIZE, model)
    bright = np.full(SIZE[::-1], 200, np.uint8)
    assert np.array_equal(camera.K, K)
    assert (camera.undistort(bright) == 200).all()


def beyond(camera, shape):
    """Return pixels (H, W) bool that the raw image does not show, or beyond the fold."""
    rows, columns = np.indices(shape)
    rays = np.linalg.inv(camera.K) @ np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)])
    seen, slopes = camera.pixels(rays[:2].T, camera.k1)
    outside = ((seen < -0.5) | (seen > np.array(shape[::-1]) - 0.5)).any(1)
    return (outside | (np.linalg.det(slopes) <= 0)).reshape(shape)


# By model: outside the image, beyond the fold, beyond one bent by tangential coefficients.
BEYOND = [('plumb_bob', [0.4, 0.1, 0, 0, 0], 130.0), ('plumb_bob', [-0.35, 0, 0, 0, 0], 70.0),
          ('plumb_bob', [-0.35, 0, 3e-3, -5e-3, 0], 70.0),
          ('rational_polynomial', [-0.4, 0, 0, 0, 0, 0.02, 0, 0], 70.0),
          ('equidistant', [-0.3, 0, 0, 0], 45.0), ('equidistant', [0.6, 0.4, 0, 0], 130.0)]


@pytest.mark.parametrize('model, D, focal', BEYOND)
def test_pixels_that_the_image_does_not_show_are_unseen(model, D, focal):
    K = np.array([[focal, 0, 80.5], [0, focal, 58.0], [0, 0, 1]])
    camera = Camera(K, np.array(D), SIZE, model)
    unseen, truth = camera.unseen(SIZE[::-1]), beyond(camera, SIZE[::-1])
    assert unseen is not None
    assert truth.mean() > 0.02
    # OpenCV rounds to within a twentieth of a pixel.
    assert (truth & ~unseen).sum() == 0
    assert (unseen & ~truth).mean() < 0.03


def test_nothing_is_unseen_without_distortion_or_within_the_image():
    assert Camera(K, np.empty(0), SIZE).unseen(SIZE[::-1]) is None
    assert Camera(K, np.array([-0.2, 0.06, 0, 0, 0]), SIZE).unseen(SIZE[::-1]) is None


def test_there_is_no_feature_beyond_the_fold_of_the_distortion():
    focal = np.array([[300.0, 0, 319.5], [0, 300, 239.5], [0, 0, 1]])
    camera = Camera(focal, np.array([-0.35, 0, 0, 0, 0]), (640, 480))
    raw = np.random.default_rng(0).integers(0, 256, (480, 640), np.uint8)
    gray, left_out = camera.undistort(raw), Masks().of(0, raw.shape, camera)
    mirrored = beyond(camera, raw.shape)
    assert mirrored.mean() == pytest.approx(0.2, abs=0.02)

    def there(mask):
        """Count features where the image is mirrored."""
        points = TwoViewEstimator().view(gray, focal, left_out=mask).features.points
        assert len(points) > 500
        columns, rows = np.rint(points).astype(int).T
        return mirrored[rows, columns].sum()
    assert there(None) > 50
    assert there(left_out) == 0


def test_a_camera_of_matrices_undistorts_as_that_of_its_camera_info():
    D = DISTORTIONS['plumb_bob']
    raw = draw_blob(100, 30)
    assert np.array_equal(
        Camera(K, D, SIZE).undistort(raw),
        Camera.from_info(camera_info(K, SIZE, d=D), False).undistort(raw))


def draw_blob(x, y):
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return (200 * np.exp(-((columns - x)**2 + (rows - y)**2) / 4.5)).astype(np.uint8)


def blob_near(image, x, y, reach=8):
    left, top = int(x) - reach, int(y) - reach
    patch = image[top:top + 2 * reach, left:left + 2 * reach].astype(float)
    rows, columns = np.mgrid[:2 * reach, :2 * reach]
    return left + (patch * columns).sum() / patch.sum(), top + (patch * rows).sum() / patch.sum()


def test_a_stereo_rectification_does_not_rotate_the_camera():
    turned = cv2.Rodrigues(np.array([0, 0.05, 0]))[0].ravel()
    camera = Camera.from_info(camera_info(K, SIZE, p=P.ravel(), r=turned,
                                          d=DISTORTIONS['plumb_bob']), False)
    assert np.array_equal(camera.K, K)


def test_roi_shifts_and_binning_divides():
    info = camera_info(K, SIZE, roi=roi(20, 10, 100, 80), binning_x=2, binning_y=4)
    camera = Camera.from_info(info, False)
    assert camera.size == (50, 20)
    assert np.allclose(camera.K, [[65, 0, (80.5 - 20) / 2], [0, 131 / 4, (58 - 10) / 4],
                                  [0, 0, 1]])


def test_an_image_of_another_size_is_refused():
    with pytest.raises(BadMessage, match='image is 100x120') as caught:
        Camera.from_info(camera_info(K, SIZE), False).undistort(np.zeros((120, 100), np.uint8))
    assert caught.value.reason == 'size_mismatch'
    assert 'remap camera_info, --info-topic' in str(caught.value)


def test_a_camera_info_without_a_size_takes_any_image():
    camera = Camera.from_info(camera_info(K, (0, 0), d=DISTORTIONS['plumb_bob']), False)
    for shape in ((120, 100), (60, 50)):
        assert camera.undistort(np.zeros(shape, np.uint8)).shape == shape


def with_number(at, value):
    matrix = K.copy()
    matrix[at] = value
    return matrix


# For an image of 160 x 120: a focal length, a principal point, a skew.
NO_LENS = [((0, 0), 1.0), ((0, 0), 1e-300), ((1, 1), 2e5), ((0, 0), 1e300), ((0, 2), 1.8e3),
           ((0, 2), -1e300), ((1, 2), 1e4), ((0, 1), 200.0), ((0, 1), -1e300)]


@pytest.mark.parametrize('at, value', NO_LENS)
def test_an_impossible_camera_matrix_is_refused_in_k_and_p(at, value):
    wrong = with_number(at, value)
    P = np.hstack([wrong, np.zeros((3, 1))]).ravel()
    assert reason(k=wrong.ravel()) == 'bad_calibration'
    assert reason(True, p=P) == 'bad_calibration'
    assert reason(p=P, d=DISTORTIONS['plumb_bob']) == 'bad_calibration'
    # Without a size in the CameraInfo, that of the image counts.
    open_size = Camera.from_info(camera_info(wrong, (0, 0)), False)
    with pytest.raises(BadMessage, match='recalibrate the camera'):
        open_size.undistort(np.zeros(SIZE[::-1], np.uint8))


def test_a_telephoto_lens_and_a_small_part_of_a_large_sensor_are_cameras():
    telephoto = with_number((0, 0), 5e4)
    assert Camera.from_info(camera_info(telephoto, SIZE), False).K[0, 0] == 5e4
    sensor = np.array([[4000.0, 0, 2000], [0, 4000, 1500], [0, 0, 1]])
    corner = camera_info(sensor, (4000, 3000), roi=roi(3900, 2900, 64, 48))
    camera = Camera.from_info(corner, False)
    assert camera.undistort(np.zeros((48, 64), np.uint8)).shape == (48, 64)


@pytest.mark.parametrize('model, first', [
    ('plumb_bob', 1e300), ('plumb_bob', 500.0), ('plumb_bob', -1e4), ('plumb_bob', -50.0),
    ('equidistant', 1e300), ('equidistant', -1e4)])
def test_a_distortion_that_leaves_hardly_any_image_is_refused(model, first):
    D = np.zeros(len(DISTORTIONS[model]))
    D[0] = first
    camera = Camera(K, D, SIZE, model)
    with pytest.raises(BadMessage, match=r'leaves \d+% of an image of 160x120') as caught:
        camera.undistort(np.zeros(SIZE[::-1], np.uint8))
    assert caught.value.reason == 'bad_calibration'


def test_a_long_lens_may_have_large_coefficients():
    long = K * [[10], [10], [1]] - [[0, 0, 9 * K[0, 2]], [0, 0, 9 * K[1, 2]], [0, 0, 0]]
    D = np.array([-0.3, 60.0, 0, 0, -5e4])
    bright = np.full(SIZE[::-1], 200, np.uint8)
    assert (Camera(long, D, SIZE).undistort(bright) == 200).all()


@pytest.mark.parametrize('changes, expected', [
    ({'k': np.zeros(9), 'p': np.zeros(12)}, 'uncalibrated'),
    ({'k': np.zeros(9)}, 'uncalibrated'),
    ({'k': np.full(9, np.nan)}, 'bad_calibration'),
    ({'k': -K.ravel()}, 'bad_calibration'),
    ({'p': np.full(12, np.inf)}, 'bad_calibration'),
    ({'d': np.array([np.nan])}, 'bad_calibration'),
    ({'k': np.ones(4)}, 'bad_calibration'),
    ({'d': np.ones(3)}, 'unknown_distortion'),
    ({'d': np.ones(5), 'distortion_model': 'thin_prism'}, 'unknown_distortion'),
    ({'d': np.ones(5), 'distortion_model': 'equidistant'}, 'unknown_distortion'),
    ({'width': 2**31, 'height': 2**31}, 'too_large'),
])
def test_a_broken_calibration_has_a_reason(changes, expected):
    assert reason(**changes) == expected


def test_an_all_zero_camera_info_is_uncalibrated_also_for_rectified_images():
    assert reason(True, k=np.zeros(9), p=np.zeros(12), r=np.zeros(9)) == 'uncalibrated'


def test_two_camera_infos_are_the_same_whatever_their_headers():
    assert same_camera(camera_info(K, SIZE, 1), camera_info(K, SIZE, 2))
    assert not same_camera(camera_info(K, SIZE), camera_info(K * [[1.1], [1], [1]], SIZE))
    assert not same_camera(camera_info(K, SIZE), camera_info(K, SIZE, binning_x=2))


def test_undistortion_takes_memory_of_a_few_images_of_floats():
    """Maps take 14 bytes per pixel, the fold another 24."""
    width, height = 2000, 1500
    camera = Camera(np.array([[1400.0, 0, 1000], [0, 1400, 750], [0, 0, 1]]),
                    DISTORTIONS['plumb_bob'], (width, height))
    gray = np.zeros((height, width), np.uint8)
    tracemalloc.start()
    camera.undistort(gray)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 40 * width * height
