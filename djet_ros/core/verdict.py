"""The verdict on a pair: sign of t, covariance, status."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from djet_ros.core.algorithm import Track
from djet_ros.core.correction import turn_of_deviating_camera
from djet_ros.core.covariance import (
    calibration_covariance,
    curvature_at,
    is_within,
    lifted_covariance,
    loss_hessian,
    pose_covariance,
    pose_difference,
    UNDETERMINED,
    widened,
    widened_by_profile,
    widened_to_span,
)
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    chirality_signs,
    epipolar_lines,
    fit_rotation,
    fundamental,
    inlier_rays,
    line_distances,
    norms,
    rays,
    rotation_log,
    turn_before_plane,
)
from djet_ros.core.hamming import match_distances
from djet_ros.core.jet import epipolar_residuals
from djet_ros.core.medians import median, quantile
from djet_ros.core.pair import Pair
from djet_ros.core.patches import unaligned
from djet_ros.core.rivals import (
    continues_motion,
    false_alarms,
    INLIER,
    may_stand,
    pose_distance,
    preferences,
    SIGNIFICANT_PREFERENCE,
)
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.types import Array, Pose, RelativePose, Rival, Status
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

# Median descriptor distance of the inliers, in bits, above which they are no better than random:
# unrelated places differ by 128 bits, matches by 20 to 40.
_RANDOM_BITS = 112

# Factor by which parallax has to exceed the noise of the matches.
_PARALLAX_OVER_NOISE = 3.0

# And factor beyond which noise along the epipolar lines, which passes for parallax, may count as
# information about t: its share falls with the square, and is below 5 % of nearly all standard
# deviations in rendered and real scenes.
_FAR_OVER_NOISE = 50.0

# chosen: factor by which preferences overstate the evidence, as neighbouring cells have correlated
# errors too. The probability of a rival takes it into account, the status does not.
_OVERSTATEMENT = 2.0

# Preference (4.66) above which a rival is too improbable to widen the covariance: one in a
# hundred.
_NEGLIGIBLE_PREFERENCE = _OVERSTATEMENT * SIGNIFICANT_PREFERENCE

# Preference, a standard deviation, with which matches cast doubt on what other evidence decided.
_DOUBT = 1.0

# rad; limit of the distance of two motions that one covariance can span: the sphere of directions
# is curved, and up to here arc and sine agree to a twentieth.
_MAX_SPANNED = 0.5


def verdict(pair: Pair, track: Track, config: EstimatorConfig) -> RelativePose:
    """
    Determine the sign of t, the covariance, and the status of a pair.

    track: the result of Algorithm 1 on the matches of the pair.
    """
    K, inliers = pair.current.K, track.inliers()
    x, y = (places.compress(inliers, axis=0) for places in (pair.x, track.minima))
    rays_x, rays_y = rays(K, x), rays(K, y)
    sign, sign_open = _sign(track.pose, rays_x, rays_y, x, pair.prior)
    pose = Pose(track.pose.R, sign * track.pose.t)

    alone, parallax = _rotation_alone(K, rays_x, rays_y, y)
    covariance = _covariance(track, pose, pair.x, sign < 0,
                             parallax < _FAR_OVER_NOISE * track.scale)
    hamming = match_distances(pair.previous.smoothed, pair.x, pair.current.smoothed, track.y_opt,
                              None if pair.bits is None else (pair.y, pair.bits))

    status, R, t, count = Status.OK, pose.R, pose.t, int(inliers.sum())
    own_covariance, rivals = covariance, list[Rival]()
    if (count < config.min_matches or not np.isfinite(covariance).all()
            or _random_descriptors(hamming[inliers])):
        status, t = Status.DEGENERATE, np.zeros(3)
    elif _false_alarm(pair, track, count, config):
        status = Status.TOO_FEW_INLIERS
    elif parallax < max(config.min_parallax, _PARALLAX_OVER_NOISE * track.scale):
        # t is not determined.
        status, t = Status.NO_PARALLAX, np.zeros(3)
        R, other = _without_parallax(pair, track, pose, (rays_x, rays_y), alone, parallax)
        covariance = _of_rotation_alone(covariance, other, R, rays_x, rays_y)
    else:
        status, covariance, rivals = _compare_with_rivals(
            pose, covariance, track, pair.x, pair.prior, sign_open)
        if status is Status.OK and _may_stand(pair, track, pose, config.min_matches):
            status, covariance = Status.TWO_MOTIONS, _of_any_direction(covariance)
    determined = bool(np.isfinite(covariance).all())
    if config.calibration_sigma and determined:
        calibration = calibration_covariance(
            track.problem, K, track.pose, track.residuals, track.loss, config.calibration_sigma,
            flipped=sign < 0)
        covariance, own_covariance = (widened(each, pose.t, calibration)
                                      for each in (covariance, own_covariance))
    covariance_6 = lifted_covariance(covariance, pose.t) if determined else UNDETERMINED[1]

    lines = epipolar_lines(fundamental(K, R, track.pose.t), pair.x)
    if sign_open and t.any():
        rivals.append(Rival(Pose(R, -t), 0.0))
    return RelativePose(
        status, R, t, covariance, covariance_6, x=pair.x, y=pair.y, placed=track.placed.places,
        placed_covariances=track.placed.covariances,
        y_opt=track.y_opt, inliers=inliers, voting=track.voting,
        residuals=line_distances(lines, pair.y),
        hamming=hamming, losses=track.losses, culled=int((~track.voting).sum()),
        indefinite=track.indefinite, iterations=track.iterations, timings=pair.timings,
        sought=pair.sought, rivals=tuple(rivals),
        own_covariance_5=own_covariance, left_out=track.left_out)


def as_decided(relative: RelativePose) -> RelativePose:
    """
    Return a pair as OK and as sure as without its rivals, which other evidence excludes.

    Rivals that its matches prefer are kept for the next pair to consider: the other evidence is
    the pair before, which may be wrong itself.
    """
    own = relative.own_covariance_5
    preferred = tuple(rival for rival in relative.rivals if rival.preference < -_DOUBT)
    return replace(relative, status=Status.OK, rivals=preferred, covariance_5=own,
                   covariance_6=lifted_covariance(own, relative.t))


def with_left_out(relative: RelativePose, pair: Pair, kept: NDArray[np.bool_]) -> RelativePose:
    """
    Return a pair that was estimated from some of its matches with the others as outliers.

    pair: with all matches (N,); kept: (N,) bool, those it was estimated from.
    """
    def all_of(values: NDArray[Any], others: NDArray[Any]) -> NDArray[Any]:
        others = others.copy()
        others[kept] = values
        return others

    unplaced, unknown = unaligned(pair.y), np.full(len(kept), np.nan)
    none = np.zeros(len(kept), bool)
    lines = epipolar_lines(fundamental(pair.current.K, relative.R, relative.t), pair.x)
    return replace(
        relative, x=pair.x, y=pair.y, y_opt=all_of(relative.y_opt, pair.y),
        left_out=all_of(~relative.of_body, ~none),
        inliers=all_of(relative.inliers, none), voting=all_of(relative.voting, none),
        placed=all_of(relative.placed, unplaced.places),
        placed_covariances=all_of(relative.placed_covariances, unplaced.covariances),
        residuals=all_of(relative.residuals, line_distances(lines, pair.y)),
        hamming=all_of(relative.hamming, unknown), losses=all_of(relative.losses, unknown))


def as_undecided(relative: RelativePose, status: Status = Status.AMBIGUOUS) -> RelativePose:
    """Return a pair with another status, its covariance unknown: other evidence contradicts it."""
    return replace(relative, status=status, covariance_5=UNDETERMINED[0],
                   covariance_6=UNDETERMINED[1])


def as_pure_rotation(relative: RelativePose, K: Array) -> RelativePose:
    """
    Return a pair without parallax as a pure rotation (status NO_PARALLAX).

    The covariance is that of `_of_rotation_alone`.
    """
    rays_x, rays_y = inlier_rays(relative, K)
    R = fit_rotation(rays_x, rays_y)
    covariance = _of_rotation_alone(relative.covariance_5, relative.R, R, rays_x, rays_y)
    lines = epipolar_lines(fundamental(K, R, relative.t), relative.x)
    return replace(relative, status=Status.NO_PARALLAX, R=R, t=np.zeros(3),
                   residuals=line_distances(lines, relative.y), covariance_5=covariance,
                   covariance_6=lifted_covariance(covariance, relative.t))


def _of_rotation_alone(covariance: Array, other: Array, R: Array, rays_x: Array, rays_y: Array
                       ) -> Array:
    """
    Return the covariance (5, 5) of a pair without parallax, from that of its pose.

    A rotation absorbs a translation along a surface, the more the narrower the image, as long as
    both look alike to within the noise. So the expected squared error is the mean of those by two
    motions, of which either may be right: one with the other rotation (that of the pose, usually,
    which may be of the wrong basin: without parallax, its t may be any), and the motion in front
    of a plane.

    R, other: (3, 3), see `_without_parallax`; rays_x, rays_y: (N, 3).
    """
    turn, of_turn = turn_before_plane(rays_x @ R.T, rays_y)
    before_plane = covariance.copy()
    before_plane[:3, 3:], before_plane[3:, :3] = 0.0, 0.0
    before_plane[:3, :3] = of_turn + np.outer(turn, turn)
    off = np.append(rotation_log(R @ other.T), [0.0, 0.0])
    return (widened_to_span(covariance, off, 1.0) + before_plane) / 2


def _sign(pose: Pose, rays_x: Array, rays_y: Array, x: Array,
          prior: Pose | None) -> tuple[float, bool]:
    """
    Return the sign of t, and whether the opposite sign remains possible.

    rays_x, rays_y: (N, 3) of the inliers; x: (N, 2) their pixels in the previous image. False
    matches along epipolar lines, as on edges in the direction of motion, are as often behind the
    cameras as in front. If the depth signs do not decide by the test of ``preferences``, the
    previous motion does.
    """
    votes = chirality_signs(pose.R, pose.t, rays_x, rays_y)
    sign = 1.0 if votes.sum() >= 0 else -1.0
    if preferences(np.stack([-votes, votes]) * sign, x, 0)[1] >= SIGNIFICANT_PREFERENCE:
        return sign, False
    poses = {each: Pose(pose.R, each * pose.t) for each in (sign, -sign)}
    if prior is not None:
        sign = min(poses, key=lambda each: pose_distance(prior, poses[each]))
    return sign, prior is None or not continues_motion(prior, poses[sign], poses[-sign])


def _false_alarm(pair: Pair, track: Track, agreeing: int, config: EstimatorConfig) -> bool:
    """
    Return whether false matches alone would produce a motion with as many inliers.

    A match uniform in a disc of the search radius r lies within w of a line through its centre
    with a probability of at most 4 w / (pi r). Matches that were removed with a starting pose
    count as tested too.
    """
    radius = min(config.search_radius, 0.5) * max(pair.current.gray.shape)
    chance = 4 * INLIER * track.scale / (np.pi * radius)
    return false_alarms(agreeing, len(track.voting) + pair.outliers, chance) > 0


def _covariance(track: Track, pose: Pose, x: Array, flipped: bool, near_noise: bool) -> Array:
    """
    Return the covariance (5, 5) of a pose, NaN if the matches do not determine it.

    x: (N, 2) pixels of the matches in the previous image; flipped: whether the pose has the
    opposite t to that of the track; near_noise: whether the parallax is so small that noise along
    the epipolar lines may be a part of it.
    """
    voting, problem, loss = x.compress(track.voting, axis=0), track.problem, track.loss
    residuals = epipolar_residuals(problem, pose.R, pose.t) if flipped else track.residuals
    hessian = loss_hessian(problem, pose, residuals, loss) if near_noise else None
    curved = curvature_at(residuals, loss, hessian)
    if curved is None:
        return UNDETERMINED[0]
    covariance, _ = pose_covariance(residuals, loss, voting, pose.t, False, curved)
    if not np.isfinite(covariance).all():
        return covariance
    return widened_by_profile(covariance, problem, pose, loss, residuals, curved)


def _compare_with_rivals(pose: Pose, covariance: Array, track: Track, x: Array,
                         prior: Pose | None, sign_open: bool
                         ) -> tuple[Status, Array, list[Rival]]:
    """
    Compare a pose with its rivals.

    Returns its status, its covariance (5, 5) that spans them, and the rivals that are possible.
    x: (N, 2) pixels of the matches in the previous image; sign_open: whether -t remains possible,
    which is a rival too. Rivals within the covariance are covered already. Any other is the true
    motion with the probability that the preference is due to noise. If that is negligible, the
    rival is ignored, unless two bodies move: with a motion 60 degrees away, a probability of six
    in a thousand turns a standard deviation of a fifth of a degree into one of five degrees.
    Should a possible rival be true, errors beside the line that spans it are as large as its own
    covariance says, so that is added. The likeliest come first, so that the widening by an
    improbable one does not cover them.
    """
    status = Status.TWO_MOTIONS if track.body_ambiguous else Status.OK
    possible: list[Rival] = []
    for rival in sorted((*track.rivals, *track.nearby), key=lambda rival: rival.preference):
        offset = pose_difference(pose.R, pose.t, rival.pose)
        if is_within(covariance, offset):
            continue
        undecided = (rival.preference < SIGNIFICANT_PREFERENCE
                     and not _prior_decides(prior, pose, rival.pose))
        if undecided and np.linalg.norm(offset) > _MAX_SPANNED and not track.body_ambiguous:
            status = Status.AMBIGUOUS
        if track.body_ambiguous or rival.preference < _NEGLIGIBLE_PREFERENCE:
            probability = float(ndtr(-rival.preference / _OVERSTATEMENT))
            covariance = widened_to_span(covariance, offset, probability)
            possible.append(rival)
    # Only after all rivals were compared: the uncertainty of one rival must not make another one
    # look covered.
    for rival in possible:
        covariance = widened(covariance, pose.t, _covariance_of(rival.pose, track, x, pose.t))
    if sign_open:
        status = status if track.body_ambiguous else Status.AMBIGUOUS
        covariance = _of_any_direction(covariance)
    return status, covariance, possible


def _of_any_direction(covariance: Array) -> Array:
    """Widen a covariance (5, 5) to span the opposite direction, in no particular tangent."""
    for offset in np.pi / np.sqrt(2) * np.eye(5)[3:]:
        covariance = widened_to_span(covariance, offset, 0.5)
    return covariance


def _may_stand(pair: Pair, track: Track, pose: Pose, least: int) -> bool:
    """Return whether the camera of a pair may stand still; see ``rivals.may_stand``."""
    if pair.known.rotation is not None:
        return False
    shift = norms(track.minima - pair.x).compress(track.voting)
    return may_stand(track.problem, shift, pose, float(pair.current.K[0, 0]),
                     track.surface_noise, least, pair.prior)


def _covariance_of(pose: Pose, track: Track, x: Array, t: Array) -> Array:
    """
    Return the covariance (6, 6) of a rival, from its residuals on the track's surfaces.

    t: (3,) direction that it is compared with: of the rival's two signs the nearer one counts.
    """
    residuals = epipolar_residuals(track.problem, pose.R, pose.t)
    flipped = bool(pose.t @ t < 0)
    return pose_covariance(residuals, track.loss, x.compress(track.voting, axis=0),
                           -pose.t if flipped else pose.t, flipped)[1]


def _prior_decides(prior: Pose | None, pose: Pose, rival: Pose) -> bool:
    """Return whether the previous motion decides for a pose, for either sign of the rival's t."""
    return prior is not None and all(
        continues_motion(prior, pose, Pose(rival.R, sign * rival.t)) for sign in (1, -1))


def _random_descriptors(hamming: Array) -> bool:
    """Return whether descriptor distances (N,) in bits, NaN if unknown, look random."""
    known = hamming[np.isfinite(hamming)]
    return bool(known.size and median(known) > _RANDOM_BITS)


def _rotation_alone(K: Array, rays_x: Array, rays_y: Array, y: Array) -> tuple[Array, float]:
    """
    Return the rotation (3, 3) that fits inliers best, and the parallax that it leaves, in pixels.

    rays_x, rays_y: (N, 3); y: (N, 2) pixels of the latter. Without any the parallax is infinite.
    """
    if not len(y):
        return np.eye(3), np.inf
    R = fit_rotation(rays_x, rays_y)
    rotated = rays_x @ (K @ R).T
    return R, _upper_quartile(norms(y - rotated[:, :2] / rotated[:, 2:]))


def _without_parallax(pair: Pair, track: Track, pose: Pose, rays_of: tuple[Array, Array],
                      alone: Array, parallax: float) -> tuple[Array, Array]:
    """
    Return the rotation (3, 3) of a pair without parallax, and another one that may be right.

    A rotation alone, if it explains the inliers to within their noise. If not, what it leaves may
    be due to an error of the calibration: then it is the rotation with that error, if this
    explains them. The other one is that of the pose. If neither does, there is a parallax, too
    small for a direction to rely on. A rotation alone then absorbs what all parallaxes have in
    common, many times what is left of them in front of a wall; so it is that of the pose, unless
    the pose may be of the wrong basin.

    rays_of: (N, 3) of the inliers in both images; alone, parallax: see `_rotation_alone`.
    """
    K, within = pair.current.K, _PARALLAX_OVER_NOISE * track.scale
    if parallax < within:
        return alone, pose.R
    sigmas = SelfCalibration.unknown(K, pair.current.gray.shape).prior_sigmas
    turn, left = turn_of_deviating_camera(*rays_of, sigmas)
    decided = all(rival.preference >= SIGNIFICANT_PREFERENCE
                  for rival in (*track.rivals, *track.nearby))
    unexplained = _upper_quartile(left) * K[0, 0] >= within
    return (pose.R, turn) if unexplained and decided else (turn, pose.R)


def _upper_quartile(distances: Array) -> float:
    """Return the upper quartile of distances (N,)."""
    return float(quantile(distances, 0.75))
