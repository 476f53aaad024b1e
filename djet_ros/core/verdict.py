"""What is to be believed of a pair: direction of t, covariance, status."""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.covariance import (
    as_far_as_claimed,
    by_calibration,
    difference,
    pose_covariance,
    spanning,
    squared_distance,
    SURPRISING,
    widened,
)
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import (
    epipolar_lines,
    fit_rotation,
    fundamental,
    line_distances,
    rays,
    rotation_log,
    sides,
)
from djet_ros.core.hamming import match_distances
from djet_ros.core.jet import epipolar_residuals
from djet_ros.core.pair import Pair
from djet_ros.core.paraboloid import median, quantile
from djet_ros.core.rivals import change, DECIDED, false_alarms, goes_on, preferences
from djet_ros.core.tracking import Track, TRACK_TUNING
from djet_ros.core.types import Array, Pose, RelativePose, Status
import numpy as np
from scipy.special import ndtr

# Bits that differ between the descriptors of matches beyond which they are no better than chance:
# 128 differ between places that have nothing to do with one another, and 20 to 40 between matches.
_CHANCE_BITS = 112

# Parallax has to exceed the noise of the matches by this factor to be believed.
_OUT_OF_NOISE = 3.0

# chosen: what a standard deviation of a preference counts, as neighbouring cells err together too.
_TRUSTED = 0.5

# rad; no ellipsoid spans two motions that are further from one another, as the sphere of
# directions is bent: up to here chord and arc agree to a twentieth.
_FAR = 0.5


def verdict(pair: Pair, track: Track, config: EstimatorConfig) -> RelativePose:
    """
    Settle which way t points, how sure the pose is, and whether it is to be believed.

    track: where Algorithm 1 ended, on the matches of the pair.
    """
    x, K, R = pair.x, pair.current.K, track.pose.R
    inliers = track.inliers()
    # Chirality: E = [t]_x R leaves the sign of t open, positive depths decide it.
    seen, minima = (places.compress(inliers, axis=0) for places in (x, track.minima))
    rays_x, rays_y = rays(K, seen), rays(K, minima)
    sign, other_way = _sign(track.pose, rays_x, rays_y, seen, pair.before)
    t = sign * track.pose.t

    voting = x.compress(track.voting, axis=0)
    covariances = pose_covariance(track.residuals, track.loss, voting, t, sign < 0)
    if np.isfinite(covariances[0]).all():
        covariances = as_far_as_claimed(covariances[0], track.problem, Pose(R, t), track.loss,
                                        track.residuals if sign > 0 else None)
    hamming = match_distances(pair.previous.smoothed, x, pair.current.smoothed, track.y_opt,
                              None if pair.bits is None else (pair.y, pair.bits))
    status = Status.OK
    if (inliers.sum() < config.min_matches or not np.isfinite(covariances[0]).all()
            or _by_chance(hamming[inliers])):
        status, t = Status.DEGENERATE, np.zeros(3)
    elif _false_alarm(pair, track, int(inliers.sum()), config):
        status = Status.TOO_FEW_INLIERS
    else:
        # Where a rotation alone explains the matches, any direction of t would do.
        R_alone, noise = fit_rotation(rays_x, rays_y), _OUT_OF_NOISE * track.scale
        parallax = _parallax(K, R_alone, rays_x, minima)
        if parallax < max(config.min_parallax, noise):
            if parallax >= noise:
                # What is out of noise is a way, which the turn by itself makes up for.
                covariances = _bent(covariances[0], Pose(R, t), R_alone)
            status, R, t = Status.NO_PARALLAX, R_alone, np.zeros(3)
        else:
            status, covariances = _judged(Pose(R, t), covariances, track, voting, pair.before,
                                          other_way)
    if config.calibration_sigma and np.isfinite(covariances[0]).all():
        covariances = widened(covariances[0], sign * track.pose.t, by_calibration(
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
                *([Pose(R, -t)] if other_way and t.any() else [])))


def as_turn(relative: RelativePose, K: Array) -> RelativePose:
    """Give a pair whose parallax is none: a rotation alone, and how far its way had bent that."""
    agree = relative.inliers
    R = fit_rotation(rays(K, relative.x[agree]), rays(K, relative.placed[agree]))
    covariances = _bent(relative.covariance_5, Pose(relative.R, relative.t), R)
    return replace(relative, status=Status.NO_PARALLAX, R=R, t=np.zeros(3),
                   covariance_5=covariances[0], covariance_6=covariances[1])


def _bent(covariance: Array, pose: Pose, R: Array) -> tuple[Array, Array]:
    """Widen a pose's covariance (5, 5) by how far it is turned from a rotation alone (3, 3)."""
    return spanning(covariance, pose.t, np.append(rotation_log(R @ pose.R.T), [0.0, 0.0]), 1.0)


def _sign(pose: Pose, rays_x: Array, rays_y: Array, places: Array,
          before: Pose | None) -> tuple[float, bool]:
    """
    Tell the sign of t, and whether the other one may be right as well.

    rays_x, rays_y: (N, 3) of the matches that agree, places: (N, 2) their pixels in the previous
    image. False ones along epipolar lines, as edges on the way have them, are behind the cameras
    as often as before them: where points before and behind do not decide, by the test of
    ``preferences``, the motion before does.
    """
    votes = sides(pose.R, pose.t, rays_x, rays_y)
    sign = 1.0 if votes.sum() >= 0 else -1.0
    if preferences(np.stack([-votes, votes]) * sign, places, 0)[1] >= DECIDED:
        return sign, False
    ways = {way: Pose(pose.R, way * pose.t) for way in (sign, -sign)}
    if before is not None:
        sign = min(ways, key=lambda way: change(before, ways[way]))
    return sign, before is None or not goes_on(before, ways[sign], ways[-sign])


def _false_alarm(pair: Pair, track: Track, agreeing: int, config: EstimatorConfig) -> bool:
    """
    Tell whether false matches would bring about a motion that as many agree with.

    One that may be anywhere in a disc of the search radius r lies within w of a line through
    its middle with a probability of at most 4 w / (pi r). Those that a starting pose had left out
    were tried as well.
    """
    radius = min(config.search_radius, 0.5) * max(pair.current.gray.shape)
    chance = 4 * TRACK_TUNING.inlier * track.scale / (np.pi * radius)
    return false_alarms(agreeing, len(track.voting) + pair.outliers, chance) > 0


def _judged(pose: Pose, covariances: tuple[Array, Array], track: Track, places: Array,
            before: Pose | None, other_way: bool) -> tuple[Status, tuple[Array, Array]]:
    """
    Tell whether rivals leave a pose unsure, and widen its covariances to span them.

    places: (M, 2) pixels of the matches that voted, in the previous image; other_way: whether t
    may have the other sign as well, which is a rival too. Those that the covariance allows of are
    spanned by it already. Any other is the true motion with the probability that the preference
    comes from noise. Where that is less than the one of a hundred at which matches decide, it is
    left out, unless two bodies move: of a motion 60 degrees off, a probability of six in a
    thousand makes a standard deviation of five degrees out of a fifth of one.
    """
    status = Status.TWO_MOTIONS if track.guess else Status.OK
    unsure: list[Array] = []
    for rival in (*track.rivals, *track.beside):
        off = difference(pose.R, pose.t, rival.pose)
        if squared_distance(covariances[0], off) < SURPRISING:
            continue
        undecided = rival.preference < DECIDED and not _goes_on(before, pose, rival.pose)
        if undecided and np.linalg.norm(off) > _FAR and not track.guess:
            status = Status.AMBIGUOUS
        probability = float(ndtr(-_TRUSTED * rival.preference))
        if track.guess or probability > ndtr(-DECIDED):
            covariances = spanning(covariances[0], pose.t, off, probability)
        if undecided:
            unsure.append(_covariance_of(rival.pose, track, places))
    # Not before all are held against it: what is not known of one is no reason to allow of others.
    for own in unsure:
        covariances = widened(covariances[0], pose.t, own)
    if other_way:
        status = status if track.guess else Status.AMBIGUOUS
        # It lies 2 away by its chord, to no side more than to another.
        for off in np.sqrt(2) * np.eye(5)[3:]:
            covariances = spanning(covariances[0], pose.t, off, 0.5)
    return status, covariances


def _covariance_of(pose: Pose, track: Track, places: Array) -> Array:
    """Covariance (6, 6) of a rival, by the matches as they lie for the pose that was taken."""
    residuals = epipolar_residuals(track.problem, pose.R, pose.t)
    return pose_covariance(residuals, track.loss, places, pose.t, flipped=False)[1]


def _goes_on(before: Pose | None, pose: Pose, rival: Pose) -> bool:
    """Tell whether the motion before decides for a pose, whichever sign a rival's t may have."""
    return before is not None and all(
        goes_on(before, pose, Pose(rival.R, sign * rival.t)) for sign in (1, -1))


def _by_chance(hamming: Array) -> bool:
    """Tell of descriptor distances (N,), NaN where there is none, whether chance explains them."""
    known = hamming[np.isfinite(hamming)]
    return bool(known.size and median(known) > _CHANCE_BITS)


def _parallax(K: Array, R: Array, rays_x: Array, y: Array) -> float:
    """Upper quartile of the distances in pixels of y from where rotation alone would bring x."""
    rotated = rays_x @ (K @ R).T
    return quantile(np.linalg.norm(y - rotated[:, :2] / rotated[:, 2:], axis=1), 0.75)
