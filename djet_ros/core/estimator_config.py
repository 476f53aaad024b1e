"""Parameters of the two-view estimator and its presets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from djet_ros.core.parameter import check, parameter

METHODS = ('djet', 'pjet', 'rpe', 'five_point')
PRESETS = ('best', 'fast', 'paper')


@dataclass(frozen=True)
class EstimatorConfig:
    """
    Everything that somebody would turn on the way from two images to a pose.

    The defaults are the preset ``best`` (everything known to help); ``preset('fast')`` takes
    about 0.65 of the time, and ``preset('paper')`` gives the algorithm as printed. Raises
    ValueError on a value outside its described range.
    """

    method: str = parameter(
        'djet', 'residual surface: djet (descriptors), pjet (intensities), rpe (re-projection), '
        'or five_point (the start alone)', choices=METHODS)
    max_features: int = parameter(
        2000, 'features detected per image, and an eighth more where views are far apart',
        minimum=8, maximum=20000)
    detector: str = parameter(
        'corners', 'features: corners (well spread, of three sizes, descriptors unrotated), '
        'large_corners (only the largest of them, where there are enough), or orb (as OpenCV '
        'detects them, descriptors rotated)', choices=('corners', 'large_corners', 'orb'))
    corner_contrast: float = parameter(
        1.0, 'slope in its weakest direction that makes a corner, in gray levels per pixel; noise '
        'asks for more by itself; lower it for dim images', minimum=0.01, maximum=100.0)
    fast_threshold: int = parameter(
        20, 'contrast in gray levels that makes a feature of the detector orb',
        minimum=1, maximum=255)
    search_radius: float = parameter(
        0.15, 'how far a feature is sought from where the turn of the camera brings it, as a '
        'share of the longer image side, among those of like size; 1 matches all with all',
        minimum=0.01, maximum=1.0)
    min_matches: int = parameter(
        20, 'fewer matches than this give status TOO_FEW_MATCHES', minimum=8, maximum=10000)
    ransac_threshold: float = parameter(
        1.0, 'inlier threshold of the 5-point RANSAC start, in pixels', minimum=0.05, maximum=20.0)
    starts: str = parameter(
        'several', 'starting poses: five_point (RANSAC inliers only), or several (robust 5-point, '
        'planes, previous motion, pure forward; all matches)', choices=('several', 'five_point'))
    window: int = parameter(
        5, 'side of the square in which a residual surface is sampled, in pixels',
        minimum=3, maximum=15, odd=True)
    window_sigma: float = parameter(
        1.0, 'Gaussian weight of the samples in the quadratic fit, in pixels; 0 weighs all alike',
        minimum=0.0, maximum=15.0)
    grading: float = parameter(
        48.0, 'difference in gray levels from which on a binary test of a surface is decided; '
        'below it counts by degrees; 0 takes bits, as ORB does', minimum=0.0, maximum=120.0)
    binary_tests: int = parameter(
        96, "how many of ORB's 256 binary tests a surface compares; ORB ranks them by how much "
        'they add', minimum=16, maximum=256)
    patch_scale: float = parameter(
        0.65, 'size of the patch that the tests of a surface see, and of its smoothing, as a '
        "share of ORB's 27 pixels; smaller is more exact, larger holds where images are blurred",
        minimum=0.3, maximum=1.0)
    warp_reference: bool = parameter(
        True, 'sample each reference patch anew between pixels, as the pose of the round before '
        'stretches it, and leave out matches that would be stretched or shrunk by more than a '
        'factor of 2')
    indefinite: str = parameter(
        'project', 'surfaces without a minimum: project (onto the positive cone), drop (the '
        'match), or keep (as printed)', choices=('project', 'drop', 'keep'))
    cull_outside: bool = parameter(
        True, 'leave out matches whose surface has its minimum outside the sampled window')
    weigh_by_fit: bool = parameter(
        True, 'take the noise of a match from what is left of its residual at its best place')
    # 5, about a window, was chosen: nearer, a match that fits by chance would hold the epipole and
    # make it look far surer than it is.
    epipole_blur: float = parameter(
        5.0, 'distance from the epipole, in pixels, within which the direction of an epipolar '
        'line is taken for noise; 0 trusts all lines, as printed', minimum=0.0, maximum=100.0)
    join_matches: bool = parameter(
        True, 'count where gray levels have each match beside what its surface tells, each as '
        'exact as it shows itself to be; not for rpe, which is where matches were found alone')
    loss: str = parameter(
        'geman_mcclure', 'robust loss over matches',
        choices=('none', 'huber', 'cauchy', 'geman_mcclure'))
    loss_scale: float = parameter(
        3.0, 'where the loss bends, in robust standard deviations of the residuals',
        minimum=0.1, maximum=100.0)
    step: str = parameter(
        'full', 'how far a keypoint moves towards its optimum per iteration: full, share (of the '
        'way), or pixel (one pixel at most)', choices=('full', 'share', 'pixel'))
    step_share: float = parameter(
        0.3, "share of the way that a keypoint moves with step 'share'", minimum=0.01, maximum=1.0)
    max_iterations: int = parameter(
        2, 'rounds of surfaces and pose (Algorithm 1)', minimum=1, maximum=100)
    epsilon: float = parameter(
        3e-4, 'Algorithm 1 has converged when rotation and direction both move by less, in rad',
        minimum=1e-12, maximum=1.0)
    min_parallax: float = parameter(
        0.5, 'parallax that three quarters of the matches stay below when the direction of '
        'translation is not to be told (NO_PARALLAX), in pixels; noise raises it by itself',
        minimum=0.0, maximum=100.0)
    calibration_sigma: float = parameter(
        0.0, 'standard deviation of the focal length and of either coordinate of the principal '
        'point, in pixels, which the covariance of a pose then holds as well; 0 takes the '
        'calibration to be exact', minimum=0.0, maximum=10.0)

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)


# The paper does not say what becomes of surfaces without a minimum. Kept as they are, their loss
# has no lower bound and tears the pose away, so they are dropped.
_PAPER: dict[str, Any] = {
    'detector': 'orb', 'search_radius': 1.0, 'starts': 'five_point',
    'window': 7, 'window_sigma': 0.0,
    'grading': 0.0, 'binary_tests': 256, 'patch_scale': 1.0, 'warp_reference': False,
    'indefinite': 'drop', 'cull_outside': False,
    'weigh_by_fit': False, 'epipole_blur': 0.0, 'join_matches': False, 'loss': 'none',
    'step': 'share', 'step_share': 0.3, 'max_iterations': 20, 'epsilon': 1e-4,
}


# Fewer matches, and fewer samples of each. On rendered streets 800 corners of all sizes err twice
# as much as best, as many large ones half as much again.
_FAST: dict[str, Any] = {
    'detector': 'large_corners', 'max_features': 900, 'window': 3, 'binary_tests': 64}


def preset(name: str, **changes: Any) -> EstimatorConfig:
    """Give the preset 'best', 'fast' or 'paper', with some parameters changed."""
    if name not in PRESETS:
        raise ValueError(f"preset is '{name}'; choose from {', '.join(PRESETS)}")
    values: dict[str, Any] = {'best': {}, 'fast': _FAST, 'paper': _PAPER}[name]
    return replace(EstimatorConfig(), **{**values, **changes})
