"""Parameters of the two-view estimator and its presets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from djet_ros.core.parameter import check, documented, parameter

METHODS = ('djet', 'pjet', 'rpe', 'five_point')
PRESETS = ('best', 'fast', 'paper')


@documented
@dataclass(frozen=True)
class EstimatorConfig:
    """
    Parameters of the estimation of a pair, from two images to a pose.

    The defaults are the preset ``best`` (everything known to help); ``preset('fast')`` takes about
    0.8 of the time, and ``preset('paper')`` gives the algorithm as printed. Raises ValueError on
    a value outside its described range.
    """

    method: str = parameter(
        'djet', 'residual surface: djet (descriptors), pjet (intensities), rpe (re-projection), '
        'or five_point (the start alone)', choices=METHODS)
    max_features: int = parameter(
        2000, 'features detected per image, approximately; a quarter more if views are far apart',
        minimum=8, maximum=20000)
    detector: str = parameter(
        'corners', 'feature detector: corners (evenly distributed, three sizes, unrotated '
        'descriptors), large_corners (the largest size only, if there are enough), or orb '
        '(OpenCV, rotated descriptors)', choices=('corners', 'large_corners', 'orb'))
    corner_contrast: float = parameter(
        1.0, 'minimum gradient of a corner in its weakest direction, in gray levels per pixel, '
        'raised by image noise; lower it for dim images', minimum=0.01, maximum=100.0)
    fast_threshold: int = parameter(
        20, 'FAST threshold of the detector orb, in gray levels',
        minimum=1, maximum=255)
    search_radius: float = parameter(
        0.15, 'search radius around the place predicted by the rotation of the camera, as a share '
        'of the longer image side, among features of similar size; 1 matches all with all',
        minimum=0.01, maximum=1.0)
    min_matches: int = parameter(
        20, 'fewer matches than this give status TOO_FEW_MATCHES', minimum=8, maximum=10000)
    ransac_threshold: float = parameter(
        1.0, 'inlier threshold of the 5-point RANSAC start, in pixels', minimum=0.05, maximum=20.0)
    starts: str = parameter(
        'several', 'starting poses: five_point (RANSAC inliers only), or several (robust 5-point, '
        'homographies, previous motion, pure forward motion; all matches)',
        choices=('several', 'five_point'))
    window: int = parameter(
        5, 'side of the square in which a residual surface is sampled, in pixels; if the '
        'reference is warped, 3',
        minimum=3, maximum=15, odd=True)
    window_sigma: float = parameter(
        1.0, 'standard deviation of the Gaussian weights of the samples in the quadratic fit, in '
        'pixels; 0 weights all equally',
        minimum=0.0, maximum=15.0)
    grading: float = parameter(
        48.0, 'difference in gray levels at which a binary test of a surface saturates to a bit; '
        'below, it counts in proportion; 0 takes bits, as ORB does', minimum=0.0, maximum=120.0)
    binary_tests: int = parameter(
        96, "number of ORB's 256 binary tests that a surface compares; ORB ranks them by the "
        'information they add', minimum=16, maximum=256)
    patch_scale: float = parameter(
        0.65, "size of the patch that a surface's tests cover, and of its smoothing, as a share "
        "of ORB's 27 pixels; smaller is more accurate, larger copes with blurred images",
        minimum=0.3, maximum=1.0)
    warp_reference: bool = parameter(
        True, 'resample each reference patch with sub-pixel warps by the pose of the previous '
        'round, and leave out matches that would be stretched or shrunk by more than a factor '
        'of 2')
    indefinite: str = parameter(
        'project', 'surfaces without a minimum: project (onto the positive cone), drop (the '
        'match), or keep (as printed)', choices=('project', 'drop', 'keep'))
    cull_outside: bool = parameter(
        True, 'leave out matches whose surface has its minimum farther than half a window from '
        'where it was sampled')
    weigh_by_fit: bool = parameter(
        True, 'weight each match by the residual that remains at the minimum of its surface')
    # chosen: 5, about a window. Closer to the epipole, a match that fits by chance would fix the
    # epipole and make it look far more certain than it is.
    epipole_blur: float = parameter(
        5.0, 'distance from the epipole, in pixels, below which the direction of an epipolar line '
        'is treated as noise; 0 trusts all lines, as printed', minimum=0.0, maximum=100.0)
    join_matches: bool = parameter(
        True, 'combine the surface of each match with its photometric alignment, each weighted by '
        'its observed noise; not for rpe, which uses the matched places alone')
    loss: str = parameter(
        'geman_mcclure', 'robust loss over matches',
        choices=('none', 'huber', 'cauchy', 'geman_mcclure'))
    loss_scale: float = parameter(
        3.0, 'scale of the robust loss, in robust standard deviations of the residuals',
        minimum=0.1, maximum=100.0)
    step: str = parameter(
        'full', 'step of a keypoint towards its optimum per iteration: full, share (of the '
        'distance), or pixel (one pixel at most)', choices=('full', 'share', 'pixel'))
    step_share: float = parameter(
        0.3, "share of the distance that a keypoint moves with step 'share'", minimum=0.01,
        maximum=1.0)
    max_iterations: int = parameter(
        2, 'maximum number of rounds of surfaces and pose (Algorithm 1)', minimum=1, maximum=100)
    epsilon: float = parameter(
        3e-4, 'Algorithm 1 has converged when rotation and direction both move by less, in rad',
        minimum=1e-12, maximum=1.0)
    min_parallax: float = parameter(
        0.5, 'upper quartile of the parallax of the matches, in pixels, below which the '
        'translation direction is not determined (NO_PARALLAX); raised automatically by noise',
        minimum=0.0, maximum=100.0)
    calibration_sigma: float = parameter(
        0.0, 'standard deviation of the focal length and of each coordinate of the principal '
        'point, in pixels, propagated into the covariance of the pose; 0 assumes an exact '
        'calibration', minimum=0.0, maximum=10.0)

    def __post_init__(self) -> None:
        """Reject values outside their described range."""
        check(self)


# The paper does not say how surfaces without a minimum are treated. Kept as they are, their loss
# has no lower bound and makes the pose diverge, so they are dropped.
_PAPER: dict[str, Any] = {
    'detector': 'orb', 'search_radius': 1.0, 'starts': 'five_point',
    'window': 7, 'window_sigma': 0.0,
    'grading': 0.0, 'binary_tests': 256, 'patch_scale': 1.0, 'warp_reference': False,
    'indefinite': 'drop', 'cull_outside': False,
    'weigh_by_fit': False, 'epipole_blur': 0.0, 'join_matches': False, 'loss': 'none',
    'step': 'share', 'step_share': 0.3, 'max_iterations': 20, 'epsilon': 1e-4,
}


# Fewer matches, and fewer samples of each. On rendered streets the error is 1.5 times that of
# best; with 800 corners of all sizes it was 2 times.
_FAST: dict[str, Any] = {
    'detector': 'large_corners', 'max_features': 900, 'window': 3, 'binary_tests': 64}


def preset(name: str, **changes: Any) -> EstimatorConfig:
    """Return the preset 'best', 'fast' or 'paper', with some parameters changed."""
    if name not in PRESETS:
        raise ValueError(f"preset is '{name}'; choose from {', '.join(PRESETS)}")
    values: dict[str, Any] = {'best': {}, 'fast': _FAST, 'paper': _PAPER}[name]
    return replace(EstimatorConfig(), **{**values, **changes})
