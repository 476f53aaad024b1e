"""
Joint tracking of a pair: which of the motions that explain its matches is the camera's.

Several basins may fit the matches about equally well, and several bodies may move.
`core.algorithm` optimises one motion; here its results are compared.
"""

from __future__ import annotations

from dataclasses import replace

from djet_ros.core.algorithm import Algorithm, Track
from djet_ros.core.basins import BASIN_TUNING, better_by_parts, likeliest
from djet_ros.core.bodies import continuing_motion
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.fusion import MeasuredRotation
from djet_ros.core.geometry import norms
from djet_ros.core.jet import Loss
from djet_ros.core.pair import Pair
from djet_ros.core.rivals import (
    continues_motion,
    INLIER,
    is_planar,
    motion_without_attached,
    planar_twin,
    preferences,
    PreviousMotion,
    second_motion,
    SecondMotion,
    SIGNIFICANT_PREFERENCE,
    static_by_depth,
    unsigned_distance,
)
from djet_ros.core.surfaces import ResidualSurface
from djet_ros.core.types import Pose, Rival
import numpy as np
from numpy.typing import NDArray

# chosen: area of a body's matches, relative to those of the other motion, below which it is not
# mistaken for the static world.
_SMALL_BODY = 0.3


def track_jointly(pair: Pair, surface: ResidualSurface, starts: list[Pose],
                  config: EstimatorConfig) -> Track | None:
    """
    Optimise the pose and the places of the keypoints on their epipolar lines jointly.

    surface: residual surfaces on the matches of the pair. Without starts, basins are sought around
    the predicted motion of the pair; the keypoints were tracked from its prediction, accurately
    enough for round one to use re-projection errors in place of surfaces. A single start is
    optimised as it is. None if too few matches have a usable surface.
    """
    predicted = None if starts else pair.predicted
    algorithm = Algorithm(pair, surface, config)
    track = algorithm.run(starts, predicted)
    if track is None or len(starts) == 1:
        return track

    # Several basins: those that the matches do not decide between are compared after each has
    # converged. The two motions of a plane remain undecided, unless chirality excludes one.
    track = _best_basin(algorithm, track, predicted)
    track = _limited_by_chirality(algorithm, track)
    noise = track.surface_noise

    # A wrong basin of the camera's motion, or another body, contradicts a measured rotation.
    track = _compatible_with_measured(algorithm, track)

    # Several bodies: what moves with the camera (a bonnet) biases the pose, so the pair has to be
    # estimated again without it. What moves otherwise (a lorry) may be the motion found so far.
    attached = _attached_to_camera(algorithm, track, noise)
    if attached is not None:
        return replace(track, attached=attached)
    track = _with_planar_twin(track, pair)
    return _camera_of_two_motions(algorithm, track, noise)


def _best_basin(algorithm: Algorithm, track: Track, predicted: PreviousMotion | None) -> Track:
    """
    Return the best basin after each has converged, if there may be a better one.

    Matches that do not vote cost as much as outliers. If they still do not decide, the basin
    nearest to the previous motion is taken.
    """
    pair, config = algorithm.pair, algorithm.config
    reruns = (algorithm.rerun(start, predicted) for start in [
        *_undecided_basins(algorithm, track), *_basins_of_parts(algorithm, track)])
    tracks = [track, *(rerun for rerun in reruns if rerun is not None)]
    if len(tracks) == 1:
        return track
    loss = Loss('geman_mcclure', config.loss_scale * min(each.scale for each in tracks))
    losses = np.full((len(tracks), len(pair.y)), loss.scale**2)
    for row, each in zip(losses, tracks):
        row[each.voting] = loss(each.residuals.r**2)[0]
    poses = [each.pose for each in tracks]
    best = likeliest(losses, pair.x, poses, pair.prior)
    rivals = (Rival(pose, float(preference))
              for pose, preference in zip(poses, preferences(losses, pair.x, best))
              if unsigned_distance(poses[best], pose) > BASIN_TUNING.same_basin)
    return replace(tracks[best], rivals=tuple(rivals))


def _undecided_basins(algorithm: Algorithm, track: Track) -> list[Pose]:
    """
    Return the other basins of round one, if the matches do not decide between them.

    After round one keypoints and patch warps follow one pose, which favours it: a wrong pose keeps
    matches that suit it, at three times the noise of the right one. Re-projection errors do not
    depend on the pose that places them, and are compared already.
    """
    first = algorithm.first
    if algorithm.config.method == 'rpe' or all(
            rival.preference >= SIGNIFICANT_PREFERENCE for rival in track.rivals):
        return []
    # The nearest one led to the track.
    return sorted([first.solution.pose, *first.rivals],
                  key=lambda pose: unsigned_distance(track.pose, pose))[1:]


def _basins_of_parts(algorithm: Algorithm, track: Track) -> list[Pose]:
    """
    Return the better basin that a part of the image leads to, if there is one.

    Only without a previous motion: where a body has most of the matches, that tells which motion
    is the camera's.
    """
    pair, config = algorithm.pair, algorithm.config
    if pair.prior is not None or config.loss == 'none':
        return []
    better = better_by_parts(track.problem, pair.x[track.voting], track.pose, config)
    return [] if better is None else [better]


def _limited_by_chirality(algorithm: Algorithm, track: Track) -> Track:
    """
    Limit the preferences over rivals to what chirality decides, if the scene is one plane.

    Two motions explain all matches of one plane (Longuet-Higgins, Proc. R. Soc. B 1986), and which
    fits better is noise; only points behind a camera can exclude one. That is tested in round one,
    where both motions are evaluated at the same places: in later rounds keypoints and warps follow
    the current pose, which favours itself.
    """
    first, agree = algorithm.first, track.inliers()
    if (not first.rivals or all(rival.preference < SIGNIFICANT_PREFERENCE
                                for rival in track.rivals)
            or not is_planar(algorithm.pair.x[agree], track.minima[agree], track.scale)):
        return track
    basin = first.nearest(track.pose)
    preferred = preferences(first.chirality_losses(), first.x, basin)
    # A rival that was in the same basin in round one is not compared by it.
    preferred[basin] = np.inf
    return replace(track, rivals=tuple(replace(rival, preference=min(
        rival.preference, float(preferred[first.nearest(rival.pose)])))
        for rival in track.rivals))


def _compatible_with_measured(algorithm: Algorithm, track: Track) -> Track:
    """Return a rival from round one, optimised, if the measured rotation excludes the track."""
    measured = algorithm.pair.known.rotation
    if measured is None or measured.compatible_with(track.pose.R):
        return track
    for rival in algorithm.first.rivals:
        rerun = algorithm.rerun(rival)
        if rerun is not None and measured.prefers(rerun.pose.R, track.pose.R):
            track = rerun
    return track


def _attached_to_camera(algorithm: Algorithm, track: Track, noise: float
                        ) -> NDArray[np.bool_] | None:
    """Return the matches (N,) on what moves with the camera, None if there are none."""
    pair, first, measured = algorithm.pair, algorithm.first, algorithm.pair.known.rotation
    if pair.known.stood:
        return None
    fixed = norms(pair.y - pair.x) < INLIER * noise
    world = motion_without_attached(first.problem, fixed[first.voting], track.pose, noise,
                                    algorithm.config.min_matches, pair.prior)
    if world is None or (measured is not None and measured.prefers(track.pose.R, world.R)):
        return None
    return np.asarray(fixed)


def _with_planar_twin(track: Track, pair: Pair) -> Track:
    """
    Add the second motion of a plane to the nearby minima, if no start led close to it.

    If the camera moves nearly along the normal of the plane, both are in one basin, and all starts
    may end at the same one.
    """
    agree = track.inliers()
    twin = planar_twin(track.pose, pair.current.K, pair.x[agree],
                       track.minima[agree], track.scale) if agree.any() else None
    if twin is None:
        return track
    near = unsigned_distance(track.pose, twin.pose) / 2
    if any(unsigned_distance(rival.pose, twin.pose) < near
           for rival in (*track.rivals, *track.nearby)):
        return track
    return replace(track, nearby=(*track.nearby, twin))


def _camera_of_two_motions(algorithm: Algorithm, track: Track, noise: float) -> Track:
    """
    Return the camera's motion if two bodies move.

    If nothing decides, the more spread-out one is taken, as the static world surrounds what moves
    in it, and the other one is the rival.
    """
    continuing = _continuing_track(algorithm, track, noise)
    if continuing is not None:
        return continuing
    pair, first = algorithm.pair, algorithm.first
    second = second_motion(first.problem, first.x, track.pose, noise,
                           algorithm.config.min_matches)
    if second is None:
        return track
    decided = _decide_camera(second, pair.prior, pair.known.rotation)
    camera = int(second.width > 1) if decided is None else decided
    if camera == 1:
        members = np.zeros(len(pair.y), bool)
        members[first.voting] = second.members
        track = algorithm.rerun(second.motions[1], alive=members) or track
    if decided is None:
        other = second.motions[1 - camera]
        return replace(track, rivals=(Rival(other, 0.0),), body_ambiguous=True)
    return track


def _continuing_track(algorithm: Algorithm, track: Track, noise: float) -> Track | None:
    """Return the track of the body followed so far, if another one has displaced it."""
    pair, first = algorithm.pair, algorithm.first
    found = None if pair.prior is None else continuing_motion(
        first.problem, first.x, pair.prior, track.pose, noise)
    if found is None:
        return None
    left_out = np.zeros(len(pair.y), bool)
    left_out[first.voting] = found.other
    alone = algorithm.rerun(found.pose, alive=~left_out)
    return None if alone is None else replace(alone, left_out=left_out)


def _decide_camera(second: SecondMotion, prior: Pose | None,
                   measured: MeasuredRotation | None) -> int | None:
    """
    Return which of two motions, 0 or 1, is the camera's; None if undecided.

    It is the one with the measured rotation, or that continues the previous motion; the one with
    matches over a much larger area; or the one whose points span near to far depths while those of
    the other do not.
    """
    motions, orders = second.motions, ((0, 1), (1, 0))
    for one, other in orders:
        if measured is not None and measured.prefers(motions[one].R, motions[other].R):
            return one
    for one, other in orders:
        if prior is not None and continues_motion(prior, motions[one], motions[other]):
            return one
    if second.width < _SMALL_BODY:
        return 0
    return static_by_depth(second.flatness)
