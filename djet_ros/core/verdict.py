"""The verdict on a pair: sign of t, covariance, status."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.covariance import (
    calibration_covariance,
    CHI2_999,
    pose_covariance,
    pose_difference,
    squared_distance,
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
    line_distances,
    rays,
    rotation_log,
)
from djet_ros.core.hamming import match_distances
from djet_ros.core.jet import epipolar_residuals
from djet_ros.core.pair import Pair
from djet_ros.core.paraboloid import median, quantile
from djet_ros.core.rivals import (
    continues_motion,
    DECIDED,
    false_alarms,
    pose_distance,
    preferences,
)
from djet_ros.core.tracking import Track, TRACK_TUNING
from djet_ros.core.types import Array, Pose, RelativePose, Status
import numpy as np
from scipy.special import ndtr

# Median descriptor distance of the inliers, in bits, above which they are no better than random:
# unrelated places differ by 128 bits, matches by 20 to 40.
_RANDOM_BITS = 112

# Factor by which parallax has to exceed the noise of the matches.
_PARALLAX_OVER_NOISE = 3.0

# chosen: factor on the z-score of a preference, as neighbouring cells have correlated errors too.
_PREFERENCE_FACTOR = 0.5

# rad; limit of the distance of two motions that one covariance can span: the sphere of directions
# is curved, and up to here chord and arc agree to a twentieth.
_MAX_SPANNED = 0.5


def verdict(pair: Pair, track: Track, config: EstimatorConfig) -> RelativePose:
    """
    Determine the sign of t, the covariance, and the status of a pair.

    track: the result of Algorithm 1 on the matches of the pair.
    """
    x, K, R = pair.x, pair.current.K, track.pose.R
    inliers = track.inliers()
    # Chirality: E = [t]_x R does not determine the sign of t; positive depths do.
    seen, minima = (places.compress(inliers, axis=0) for places in (x, track.minima))
    rays_x, rays_y = rays(K, seen), rays(K, minima)
    sign, sign_open = _sign(track.pose, rays_x, rays_y, seen, pair.prior)
    t = sign * track.pose.t

    voting = x.compress(track.voting, axis=0)
    covariances = pose_covariance(track.residuals, track.loss, voting, t, sign < 0)
    if np.isfinite(covariances[0]).all():
        covariances = widened_by_profile(covariances[0], track.problem, Pose(R, t), track.loss,
                                         track.residuals if sign > 0 else None)
    hamming = match_distances(pair.previous.smoothed, x, pair.current.smoothed, track.y_opt,
                              None if pair.bits is None else (pair.y, pair.bits))
    status = Status.OK
    if (inliers.sum() < config.min_matches or not np.isfinite(covariances[0]).all()
            or _random_descriptors(hamming[inliers])):
        status, t = Status.DEGENERATE, np.zeros(3)
    elif _false_alarm(pair, track, int(inliers.sum()), config):
        status = Status.TOO_FEW_INLIERS
    else:
        # If a rotation alone explains the matches, t is not determined.
        R_alone, noise = fit_rotation(rays_x, rays_y), _PARALLAX_OVER_NOISE * track.scale
        parallax = _parallax(K, R_alone, rays_x, minima)
        if parallax < max(config.min_parallax, noise):
            if parallax >= noise:
                # The parallax above the noise is real, and the pure rotation is biased to
                # compensate for it.
                covariances = _widened_by_rotation(covariances[0], Pose(R, t), R_alone)
            status, R, t = Status.NO_PARALLAX, R_alone, np.zeros(3)
        else:
            status, covariances = _compare_with_rivals(Pose(R, t), covariances, track, voting,
                                                       pair.prior, sign_open)
    if config.calibration_sigma and np.isfinite(covariances[0]).all():
        covariances = widened(covariances[0], sign * track.pose.t, calibration_covariance(
            track.problem, K, track.pose, track.residuals, track.loss, config.calibration_sigma))
    lines = epipolar_lines(fundamental(K, R, track.pose.t), x)
    return RelativePose(
        status, R, t, *covariances, x=x, y=pair.y, placed=track.placed.places,
        placed_covariances=track.placed.covariances,
        y_opt=track.y_opt, inliers=inliers, voting=track.voting,
        residuals=line_distances(lines, pair.y),
        hamming=hamming, losses=track.losses, culled=int((~track.voting).sum()),
        indefinite=track.indefinite, iterations=track.iterations, timings=pair.timings,
        sought=pair.sought,
        rivals=(*(rival.pose for rival in track.rivals),
                *([Pose(R, -t)] if sign_open and t.any() else [])))


def as_pure_rotation(relative: RelativePose, K: Array) -> RelativePose:
    """
    Return a pair without parallax as a pure rotation (status NO_PARALLAX).

    The covariance is widened by the change of the rotation.
    """
    agree = relative.inliers
    R = fit_rotation(rays(K, relative.x[agree]), rays(K, relative.placed[agree]))
    covariances = _widened_by_rotation(relative.covariance_5, Pose(relative.R, relative.t), R)
    return replace(relative, status=Status.NO_PARALLAX, R=R, t=np.zeros(3),
                   covariance_5=covariances[0], covariance_6=covariances[1])


def _widened_by_rotation(covariance: Array, pose: Pose, R: Array) -> tuple[Array, Array]:
    """Widen the covariance (5, 5) of a pose by its difference from a pure rotation R (3, 3)."""
    offset = np.append(rotation_log(R @ pose.R.T), [0.0, 0.0])
    return widened_to_span(covariance, pose.t, offset, 1.0)


def _sign(pose: Pose, rays_x: Array, rays_y: Array, places: Array,
          prior: Pose | None) -> tuple[float, bool]:
    """
    Return the sign of t, and whether the opposite sign remains possible.

    rays_x, rays_y: (N, 3) of the inliers; places: (N, 2) their pixels in the previous image. False
    matches along epipolar lines, as on edges in the direction of motion, are as often behind the
    cameras as in front. If the depth signs do not decide by the test of ``preferences``, the
    previous motion does.
    """
    votes = chirality_signs(pose.R, pose.t, rays_x, rays_y)
    sign = 1.0 if votes.sum() >= 0 else -1.0
    if preferences(np.stack([-votes, votes]) * sign, places, 0)[1] >= DECIDED:
        return sign, False
    poses = {one: Pose(pose.R, one * pose.t) for one in (sign, -sign)}
    if prior is not None:
        sign = min(poses, key=lambda one: pose_distance(prior, poses[one]))
    return sign, prior is None or not continues_motion(prior, poses[sign], poses[-sign])


def _false_alarm(pair: Pair, track: Track, agreeing: int, config: EstimatorConfig) -> bool:
    """
    Return whether false matches alone would produce a motion with as many inliers.

    A match uniform in a disc of the search radius r lies within w of a line through its centre
    with a probability of at most 4 w / (pi r). Matches that were removed with a starting pose
    count as tested too.
    """
    radius = min(config.search_radius, 0.5) * max(pair.current.gray.shape)
    chance = 4 * TRACK_TUNING.inlier * track.scale / (np.pi * radius)
    return false_alarms(agreeing, len(track.voting) + pair.outliers, chance) > 0


def _compare_with_rivals(pose: Pose, covariances: tuple[Array, Array], track: Track,
                         places: Array, prior: Pose | None, sign_open: bool
                         ) -> tuple[Status, tuple[Array, Array]]:
    """
    Compare a pose with its rivals: return its status, and its covariances widened to span them.

    places: (M, 2) pixels of the voting matches in the previous image; sign_open: whether -t
    remains possible, which is a rival too. Rivals within the covariance are covered already. Any
    other is the true motion with the probability that the preference is due to noise. Below one in
    a hundred (the level of ``DECIDED``) it is ignored, unless two bodies move: with a motion 60
    degrees away, a probability of six in a thousand turns a standard deviation of a fifth of a
    degree into one of five degrees.
    """
    status = Status.TWO_MOTIONS if track.body_ambiguous else Status.OK
    undecided_rivals: list[Array] = []
    for rival in (*track.rivals, *track.nearby):
        off = pose_difference(pose.R, pose.t, rival.pose)
        if squared_distance(covariances[0], off) < CHI2_999:
            continue
        undecided = rival.preference < DECIDED and not _prior_decides(prior, pose, rival.pose)
        if undecided and np.linalg.norm(off) > _MAX_SPANNED and not track.body_ambiguous:
            status = Status.AMBIGUOUS
        probability = float(ndtr(-_PREFERENCE_FACTOR * rival.preference))
        if track.body_ambiguous or probability > ndtr(-DECIDED):
            covariances = widened_to_span(covariances[0], pose.t, off, probability)
        if undecided:
            undecided_rivals.append(_covariance_of(rival.pose, track, places))
    # Only after all rivals were compared: the uncertainty of one rival must not make another one
    # look covered.
    for own in undecided_rivals:
        covariances = widened(covariances[0], pose.t, own)
    if sign_open:
        status = status if track.body_ambiguous else Status.AMBIGUOUS
        # -t is at chord 2, in no particular tangent direction.
        for off in np.sqrt(2) * np.eye(5)[3:]:
            covariances = widened_to_span(covariances[0], pose.t, off, 0.5)
    return status, covariances


def _covariance_of(pose: Pose, track: Track, places: Array) -> Array:
    """Covariance (6, 6) of a rival, from the residuals at the rival on the same surfaces."""
    residuals = epipolar_residuals(track.problem, pose.R, pose.t)
    return pose_covariance(residuals, track.loss, places, pose.t, flipped=False)[1]


def _prior_decides(prior: Pose | None, pose: Pose, rival: Pose) -> bool:
    """Return whether the previous motion decides for a pose, for either sign of the rival's t."""
    return prior is not None and all(
        continues_motion(prior, pose, Pose(rival.R, sign * rival.t)) for sign in (1, -1))


def _random_descriptors(hamming: Array) -> bool:
    """Return whether descriptor distances (N,) in bits, NaN if unknown, look random."""
    known = hamming[np.isfinite(hamming)]
    return bool(known.size and median(known) > _RANDOM_BITS)


def _parallax(K: Array, R: Array, rays_x: Array, y: Array) -> float:
    """Upper quartile of the distances in pixels of y from the places of x under rotation alone."""
    rotated = rays_x @ (K @ R).T
    return quantile(np.linalg.norm(y - rotated[:, :2] / rotated[:, 2:], axis=1), 0.75)
