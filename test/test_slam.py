"""Closing loops: keyframes, places, lengths of loops, the optimisation, and the command."""

from dataclasses import replace
import json
import resource
import shutil
import tracemalloc

from cards import Cards, filmed, K, pose
from commands import checked as djet
import cv2
from djet_ros.config.sections import Config, SlamConfig
from djet_ros.core.correction import Correction
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import EstimatorConfig
from djet_ros.core.geometry import rotation_angle, rotation_exp, unit
from djet_ros.core.radial import undistort_image
from djet_ros.core.types import RelativePose, Status
from djet_ros.errors import DjetError
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.scale import Length, Scale
from djet_ros.odometry.uncertainty import compose, inflated_for_chain, UNKNOWN_MOTION
from djet_ros.posegraph.keyframe_images import KeyframeFile, KeyframeImage
from djet_ros.posegraph.loops import EdgeFinder
from djet_ros.posegraph.places import PlaceIndex
from djet_ros.posegraph.pose_graph import Edge, PoseGraph
from djet_ros.posegraph.shared_points import transferred_length
from djet_ros.posegraph.steps import graph_of, Step
from djet_ros.recordings.trajectories import read_tum
from djet_ros.replay.alignment import aligned, position_rmse
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

SIGMAS = np.array([0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3])


def twice_round(frames=60, laps=2):
    """Poses round a circle, and the same as an odometry that turns too much has them."""
    true, drifted = [np.eye(4)], [np.eye(4)]
    for _ in range(frames * laps - 1):
        true.append(true[-1] @ pose(z=1.0, yaw=2 * np.pi / frames))
        drifted.append(drifted[-1] @ pose(z=1.0, yaw=2 * np.pi / frames + 2e-3))
    return np.array(true), np.array(drifted)


def chain(poses, covariance=None):
    """Graph of an odometry that took these poses, a tenth of a second apart."""
    covariance = np.diag(SIGMAS**2) if covariance is None else covariance
    edges = [Edge(i, i + 1, np.linalg.inv(poses[i]) @ poses[i + 1], covariance)
             for i in range(len(poses) - 1)]
    return PoseGraph(10**9 + np.arange(len(poses)) * 10**8, poses, tuple(edges))


def steps(poses):
    """Return the steps of an odometry that took these poses."""
    graph = chain(poses)
    return [Step(10**9, Status.FIRST_FRAME, poses[0])] + [
        Step(int(graph.stamps_ns[edge.target]), Status.OK, poses[edge.target],
             int(graph.stamps_ns[edge.source]), edge.motion, edge.covariance, True)
        for edge in graph.edges]


def loop(true, source, target):
    return Edge(source, target, np.linalg.inv(true[source]) @ true[target],
                np.diag(SIGMAS**2), 'loop')


# Keyframes

@pytest.fixture(scope='module')
def keyframes():
    """Return the map of keyframes, and the pose of each frame; GTSAM must be installed."""
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph.keyframe_map import KeyframeMap

    def grown(steps, **slam):
        kept, offsets = KeyframeMap(Config(slam=SlamConfig(**slam))), []
        for step in steps:
            kept.extend(step, lambda stamp: Frame(np.zeros((64, 64), np.uint8), K, stamp))
            assert not kept.search_loops()
            offsets.append(kept.newest)
        return kept, offsets
    return grown


def test_keyframes_by_distance_and_rotation(keyframes):
    straight = np.array([pose(z=0.5 * i) for i in range(9)])
    turning = np.array([pose(yaw=np.radians(4 * i)) for i in range(9)])
    for poses, expected in ((straight, [0, 4, 8]), (turning, [0, 3, 6])):
        kept, _ = keyframes(steps(poses))
        assert [one.stamp_ns for one in kept.keyframes] == [10**9 + i * 10**8 for i in expected]
        assert [(edge.source, edge.target) for edge in kept.edges] == [(0, 1), (1, 2)]


def test_keyframes_of_the_odometry_are_used_if_it_has_them(keyframes):
    chosen = [replace(step, keyframe=i in {0, 1, 6})
              for i, step in enumerate(steps(np.array([pose(z=0.5 * i) for i in range(9)])))]
    for slam, expected in ({}, [0, 1, 6]), ({'keyframes': 'distance'}, [0, 4, 8]):
        kept, offsets = keyframes(chosen, **slam)
        assert [one.stamp_ns for one in kept.keyframes] == [10**9 + i * 10**8 for i in expected]
        assert [np.searchsorted(expected, i, 'right') - 1 for i in range(9)] == [
            one.keyframe for one in offsets]


def test_next_frame_replaces_a_keyframe_without_image():
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph.keyframe_map import KeyframeMap
    kept, lost = KeyframeMap(Config()), 10**9 + 2 * 10**8
    for i, step in enumerate(steps(np.array([pose(z=0.5 * i) for i in range(6)]))):
        kept.extend(replace(step, keyframe=i in {0, 2}), lambda stamp: None if stamp == lost
                    else Frame(np.zeros((64, 64), np.uint8), K, stamp))
    assert [one.stamp_ns for one in kept.keyframes] == [10**9, lost + 10**8]
    assert kept.without_image == 1


def test_all_frames_have_offsets_from_their_keyframes(keyframes):
    _, poses = twice_round()
    kept, offsets = keyframes(steps(poses), keyframe_distance=3.0)
    assert np.allclose([kept.keyframes[one.keyframe].pose @ one.motion for one in offsets], poses,
                       atol=1e-9)


def test_the_covariance_of_a_keyframe_edge_is_that_of_its_steps(keyframes):
    rng = np.random.default_rng(0)
    motions, samples = [pose(z=1.0, yaw=0.1)] * 3, []
    for _ in range(4000):
        metres = np.eye(4)
        for step in motions:
            noise = rng.normal(size=6) * SIGMAS
            wrong = step.copy()
            wrong[:3, 3] += noise[:3]
            wrong[:3, :3] = rotation_exp(noise[3:]) @ wrong[:3, :3]
            metres = metres @ wrong
        samples.append(metres)
    poses = np.array([np.linalg.matrix_power(motions[0], i) for i in range(4)])
    kept, _ = keyframes(steps(poses), keyframe_distance=2.5, keyframe_turn=90)
    edge, = kept.edges
    off = np.array([[*(metres[:3, 3] - edge.motion[:3, 3]),
                     *cv2.Rodrigues(metres[:3, :3] @ edge.motion[:3, :3].T)[0].ravel()]
                    for metres in samples])
    white = np.linalg.solve(np.linalg.cholesky(edge.covariance), off.T)
    assert np.abs(np.cov(white) - np.eye(6)).max() < 0.1


def test_an_edge_between_keyframes_with_one_reference_has_the_errors_of_both(keyframes):
    """A frame that both were measured from, as it was kept for parallax."""
    here, sigma = [np.eye(4), pose(x=3.0, yaw=0.2), pose(x=3.5, z=0.5, yaw=0.3)], SIGMAS
    covariance = np.diag(sigma**2)
    taken = [Step(10**9, Status.FIRST_FRAME, here[0])] + [
        Step(10**9 * (i + 1), Status.OK, here[i], 10**9, here[i], covariance, True, keyframe=True)
        for i in (1, 2)]
    edge = keyframes(taken)[0].edges[-1]
    # The errors of the lengths are known better than length_noise; in the axes of the first one.
    R, along = here[1][:3, :3], [unit(one[:3, 3]) for one in here[1:]]
    own = sum(SIGMAS[0]**2 * np.outer(one, one) for one in along)
    assert np.allclose(edge.uncorrelated, R.T @ own @ R)
    rng, offs = np.random.default_rng(0), []
    for _ in range(4000):
        wrong = []
        for true in here[1:]:
            noise, metres = rng.normal(size=6) * sigma, true.copy()
            metres[:3, 3] += noise[:3]
            metres[:3, :3] = rotation_exp(noise[3:]) @ metres[:3, :3]
            wrong.append(metres)
        off = np.linalg.inv(wrong[0]) @ wrong[1]
        offs.append([*(off[:3, 3] - edge.motion[:3, 3]),
                     *cv2.Rodrigues(off[:3, :3] @ edge.motion[:3, :3].T)[0].ravel()])
    white = np.linalg.solve(np.linalg.cholesky(edge.covariance), np.transpose(offs))
    assert np.abs(np.cov(white) - np.eye(6)).max() < 0.1


def test_common_length_error_is_removed_from_single_lengths():
    """A length known to 5 %, of which 1 % is its own error, weighs as one known to 1 %."""
    motion = pose(x=0.3, z=2.0, yaw=0.1)

    def known_to(share):
        length = np.pad(motion[:3, 3], (0, 3))
        return Edge(0, 1, motion, np.diag(SIGMAS**2 * 1e-4) + share**2 * np.outer(length, length))

    firm = replace(known_to(0.05), covariance=known_to(0.05).independent_covariance(0.05, 0.01))
    assert np.allclose(firm.covariance, known_to(0.01).covariance, atol=1e-15)
    firm.information()
    assert np.array_equal(known_to(0.01).independent_covariance(0.01, 0.02),
                          known_to(0.01).covariance)


def test_independent_length_errors_are_not_inflated_for_correlation(keyframes):
    """Three turning steps of 1 m: a noise of 2 % of each is 3 * (2 cm)^2 in all, and no more."""
    taken = steps(np.array([np.linalg.matrix_power(pose(z=1.0, yaw=0.1), i) for i in range(4)]))
    small = np.diag(SIGMAS**2 * 1e-4)
    along = np.outer(np.eye(6)[2], np.eye(6)[2])

    def graph_covariance(sigma, *, metric):
        kept, _ = keyframes([replace(step, covariance=small + sigma**2 * along, metric=metric)
                             for step in taken], keyframe_distance=2.5, keyframe_turn=90,
                            length_noise=0.02)
        edge, = kept.edges
        return edge.inflated().covariance

    def summed(first, each):
        whole, motion = np.zeros((6, 6)), np.eye(4)
        for _ in range(3):
            whole = compose(motion, whole, taken[1].motion, first + each * along)
            motion = motion @ taken[1].motion
        return whole

    # Of 5 %, the default of odometry.scale_uncertainty, the rest is common to all lengths.
    chained = inflated_for_chain(small)
    assert np.allclose(graph_covariance(0.05, metric=True), summed(chained, 0.02**2), rtol=1e-3)
    assert np.allclose(graph_covariance(0.01, metric=True), summed(chained, 0.01**2), rtol=1e-2)
    # Landmarks carry on the errors of relative lengths, which have none in common with a sensor.
    assert np.allclose(graph_covariance(0.04, metric=False),
                       inflated_for_chain(summed(small, 0.04**2)))


def test_unknown_length_has_a_bounded_variance():
    """Its standard deviation is its length; the other directions keep theirs."""
    motion, direction = pose(z=2.0), np.diag([0, 0, 1.0, 0, 0, 0])
    edge = Edge(0, 1, motion, np.diag(SIGMAS**2) + 1e6 * direction, scale_known=False)
    assert np.allclose(edge.independent_covariance(0.05, 0.01),
                       np.diag([*SIGMAS[:2]**2, 2.0**2, *SIGMAS[3:]**2]))


def test_unknown_motion_starts_a_keyframe_with_an_unknown_edge(keyframes):
    trajectory = steps(np.array([pose(z=0.1 * i) for i in range(4)]))
    trajectory[2] = Step(trajectory[2].stamp_ns, Status.TIME_JUMP, trajectory[2].pose)
    kept, offsets = keyframes(trajectory)
    edge, = kept.edges
    assert (edge.kind, edge.scale_known) == ('unknown', False)
    assert [one.keyframe for one in offsets] == [0, 0, 1, 1]


def test_map_keeps_the_rotation_of_the_odometry_over_a_gap(keyframes):
    """A gyro measures the rotation; the odometry's frame and the map stay as they are."""
    before, turned = pose(z=9.0), pose(z=9.0, yaw=np.radians(60))
    trajectory = steps(np.array([pose(), before, turned, turned @ pose(z=4.0)]))
    trajectory[2] = Step(trajectory[2].stamp_ns, Status.TIME_JUMP, turned)
    kept, _ = keyframes(trajectory)
    for _ in range(2):
        assert np.allclose([one.pose for one in kept.keyframes], [one.pose for one in trajectory])
        assert np.allclose(kept.correction, np.eye(4))
        kept.optimise()


def test_rotation_covariance_without_a_translation_is_that_of_the_odometry(keyframes):
    before, turned = pose(z=9.0, yaw=0.4), pose(z=9.0, yaw=1.4)
    trajectory, known, own = steps(np.array([pose(), before, turned])), np.eye(3) * 0.5, np.diag(
        [1e-8, 4e-8, 9e-8])
    trajectory[1] = replace(trajectory[1], rotation_covariance=known)

    def covariance(turn, status=Status.AMBIGUOUS):
        last = Step(trajectory[2].stamp_ns, status, turned, rotation_covariance=turn)
        edges = [edges[1].covariance for edges in (
            keyframes([*trajectory[:2], last])[0].edges, graph_of([*trajectory[:2], last]).edges)]
        assert np.allclose(*edges)
        return edges[1]

    # Along the axes of the camera before, and as unsure as independent edges are.
    grown = covariance(known + before[:3, :3] @ own @ before[:3, :3].T)
    assert np.allclose(grown[3:, 3:], inflated_for_chain(own), rtol=1e-6)
    assert np.array_equal(grown[:3], UNKNOWN_MOTION[:3])
    for turn, *status in ((None,), (known,), (known - own,), (known + 4 * np.eye(3),),
                          (known + own, Status.FIRST_FRAME)):
        assert np.array_equal(covariance(turn, *status), UNKNOWN_MOTION)


def test_failed_and_stationary_frames_are_not_keyframes(keyframes):
    """The reference of a step may be the frame before the last, with that frame's keyframe."""
    trajectory = steps(np.array([pose(), pose(z=1.5), pose(z=1.5), pose(z=2.5)]))
    trajectory[3] = replace(trajectory[3], previous_stamp_ns=trajectory[1].stamp_ns)
    kept, offsets = keyframes(trajectory)
    edge, = kept.edges
    assert np.allclose(edge.motion, pose(z=2.5))
    assert [one.keyframe for one in offsets] == [0, 0, 0, 1]
    assert np.allclose(edge.covariance, compose(pose(z=1.5), trajectory[1].covariance, pose(z=1.0),
                                                trajectory[3].covariance))


@pytest.mark.parametrize(('name', 'value'), [
    ('keyframe_distance', 0.0), ('links', 0), ('loop_share', 1.5), ('loop_gap', float('nan'))])
def test_parameters_outside_their_range_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        SlamConfig(**{name: value})


# Places

@pytest.fixture(scope='module')
def features():
    """Features of three different worlds, and of the first from another viewpoint."""
    estimator = TwoViewEstimator()
    views = [Cards(seed).gray() for seed in (1, 2, 3)] + [Cards(1).gray(pose(x=0.2), noise=1)]
    return [estimator.features(view) for view in views]


def index(*keyframes):
    places = PlaceIndex()
    for features in keyframes:
        places.add(features)
    return places


def test_revisited_place_gets_most_votes(features):
    votes = index(*features).votes(features[3], 3)
    assert votes.shape == (3,)
    assert votes[0] > 100
    assert votes[0] > 10 * max(votes[1:])


def test_only_earlier_keyframes_get_votes(features):
    places = index(*features)
    assert places.votes(features[3], 0).shape == (0,)
    assert np.array_equal(places.votes(features[3], 1), places.votes(features[3], 3)[:1])


def test_keyframes_without_features_get_no_votes(features):
    nothing = TwoViewEstimator().features(np.zeros((50, 50), np.uint8))
    assert index(nothing, features[0]).votes(nothing, 2).tolist() == [0, 0]
    assert index(nothing).votes(features[0], 1).tolist() == [0]


def test_votes_cover_all_keyframes(features):
    """Also among those added to the tables long ago, until they are removed."""
    places, few = index(), index(*features[:3]).votes(features[3], 3)
    for number in range(150):
        places.add(features[number % 3])
    assert places.votes(features[3], 150).tolist() == [*few] * 50
    assert places.votes(features[3], 100).tolist() == ([*few] * 50)[:100]
    places.forget(70)
    assert places.votes(features[3], 150)[:64].sum() == 0
    assert places.votes(features[3], 150)[64:].tolist() == ([*few] * 50)[64:]


def test_a_pattern_that_repeats_itself_takes_little_memory():
    """Then nearly all descriptors share their buckets: 500 for each of 30,000."""
    rows, columns = np.mgrid[:376, :1241]
    checks = ((rows // 20 + columns // 20) % 2 * 200 + 20).astype(np.uint8)
    pattern = TwoViewEstimator().features(checks)
    places = index(*[pattern] * 60)
    tracemalloc.start()
    votes = places.votes(pattern, 60)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert votes.tolist() == [500] * 60
    assert peak < 100e6


# Where keyframes are kept

def test_keyframe_file_round_trip():
    cards, estimator = Cards(), TwoViewEstimator()
    frames = [cards.frame(0.1 * i, pose(x=0.2 * i)) for i in range(4)]
    seen = [KeyframeImage(frame, estimator.features(frame.gray)) for frame in frames]
    with KeyframeFile() as file:
        file.update(enumerate(seen))
        del file[1]
        assert [*file] == [0, 2, 3]
        for number in (3, 0, 2):
            frame, features = file[number].frame, file[number].features
            assert (frame.stamp_ns, frame.frame_id) == (
                frames[number].stamp_ns, frames[number].frame_id)
            assert np.array_equal(frame.gray, frames[number].gray)
            assert np.array_equal(frame.K, K)
            for name in ('points', 'octaves', 'angles', 'responses', 'descriptors'):
                kept = getattr(seen[number].features, name)
                assert np.array_equal(getattr(features, name), kept), name


def test_keyframes_in_a_file_take_no_memory():
    gray = np.random.default_rng(0).integers(0, 256, (400, 1000), np.uint8)
    seen = KeyframeImage(Frame(gray, K, 1), TwoViewEstimator().features(gray))
    tracemalloc.start()
    with KeyframeFile() as file:
        for number in range(50):
            file[number] = seen
        kept, _ = tracemalloc.get_traced_memory()
        assert kept < 50 * 2000
        assert np.array_equal(file[49].frame.gray, gray)
    tracemalloc.stop()


def test_full_disk_is_reported(tmp_path):
    with pytest.raises(DjetError, match='nowhere'):
        KeyframeFile(tmp_path / 'nowhere')
    frame = Cards().frame(0.1)
    image = KeyframeImage(frame, TwoViewEstimator().features(frame.gray))
    with KeyframeFile(tmp_path) as file:
        file[0] = image
        size = file._file.seek(0, 2)
    # as long as a file may be, as on a full disk; also if only the last bytes do not fit
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for most in 10_000, size - 1:
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
            with pytest.raises(DjetError, match='free disk space'), KeyframeFile(tmp_path) as file:
                file[0] = image
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_loops_do_not_depend_on_the_keyframe_storage():
    cards = Cards()
    poses = [pose(x=0.5 * i) for i in (*range(4), *range(2, -1, -1))]
    graph = chain(np.array(poses))
    found = []
    with KeyframeFile() as file:
        for kept in (None, file):
            finder = EdgeFinder(EstimatorConfig(), SlamConfig(loop_gap=0.25), kept)
            edges = []
            for i, (here, before) in enumerate(zip(poses, (None, *graph.edges))):
                finder.add(cards.frame(1 + 0.1 * i, here, noise=i), before)
                edges += finder.loops(i)
            found.append(edges)
    assert len(found[0]) >= 3
    for edge, other in zip(*found, strict=True):
        assert (edge.source, edge.target) == (other.source, other.target)
        assert np.array_equal(edge.motion, other.motion)
        assert np.array_equal(edge.covariance, other.covariance)


def test_loops_are_found_over_a_step_back_in_time():
    """After a clock was set back, earlier keyframes do not count as later ones."""
    cards, finder, found = Cards(), EdgeFinder(EstimatorConfig(), SlamConfig(loop_gap=0.25)), []
    poses = [pose(x=0.5 * i) for i in (*range(4), *range(3, -1, -1))]
    edges = chain(np.array(poses)).edges
    for i, here in enumerate(poses):
        stamp = 1000 + 0.1 * i if i < 4 else 5 + 0.1 * i
        finder.add(cards.frame(stamp, here, noise=i), edges[i - 1] if i else None)
        found += [(edge.source, edge.target) for edge in finder.loops(i)]
    assert {(6, 1), (7, 0)} <= set(found)
    # The step back itself takes no time, and neighbours of it are no loop.
    assert (4, 3) not in found


def test_loop_uses_the_newest_distortion_of_the_odometry():
    """The distortion found by landmarks at the end was not known at the beginning."""
    cards, k1 = Cards(), 0.06
    poses = [pose(x=0.5 * i, yaw=0.03 * i) for i in (*range(4), *range(2, -1, -1))]
    poses = [here @ pose(z=0.2 * (i > 3)) for i, here in enumerate(poses)]
    edges = chain(np.array(poses)).edges

    def off(bends, known):
        """Degrees and metres that loops of the way back are off, in the root mean square."""
        finder, errors = EdgeFinder(EstimatorConfig(), SlamConfig(loop_gap=0.25)), []
        for i, here in enumerate(poses):
            frame = cards.frame(1 + 0.1 * i, here, noise=i)
            seen = undistort_image(frame.gray, K, 0.0, before=(K, k1))[0] if bends else frame.gray
            finder.add(replace(frame, gray=seen), edges[i - 1] if i else None,
                       Correction(k1 if known and i > 3 else 0.0))
            for loop in finder.loops(i) if i > 3 else ():
                true = np.linalg.inv(poses[i]) @ poses[loop.target]
                assert loop.scale_known
                errors.append([np.degrees(rotation_angle(loop.motion[:3, :3], true[:3, :3])),
                               np.linalg.norm(loop.motion[:3, 3] - true[:3, 3])])
        assert len(errors) > 3
        return np.sqrt(np.mean(np.square(errors), axis=0))

    straight, unknown, known = off(False, False), off(True, False), off(True, True)
    assert (known < 2 * straight).all()
    assert (known < unknown / 10).all()


def test_images_of_different_sizes_form_no_loop():
    cards, finder = Cards(), EdgeFinder(EstimatorConfig(), SlamConfig(loop_gap=0.25, loop_votes=1))
    frames = [cards.frame(1 + i, pose(), noise=i) for i in range(2)]
    for frame in (*frames, replace(frames[0], stamp_ns=5 * 10**9, gray=frames[0].gray[:-6, :-10])):
        finder.add(frame, None)
    assert any(edge.kind == 'loop' for edge in finder.loops(1))
    assert not any(edge.kind == 'loop' for edge in finder.loops(2))


def test_keyframes_of_two_calibrations_form_no_links():
    """A new calibration ends the correction of the one before, with the same camera matrix."""
    cards, finder, found = Cards(), EdgeFinder(EstimatorConfig(), SlamConfig(links=2)), []
    poses = np.array([pose(x=0.5 * i) for i in range(6)])
    edges = chain(poses).edges
    for i, here in enumerate(poses):
        finder.add(cards.frame(1 + 0.1 * i, here, noise=i), edges[i - 1] if i else None,
                   Correction(0.01, 0.01) if i < 3 else Correction())
        found += [(edge.source, edge.target) for edge in finder.links(i)]
        list(finder.loops(i, units=True))
    assert found == [(0, 2), (3, 5)]


def bonneted(frame, mask):
    """Return the frame of a car whose bonnet hides the lower third, and its mask or None."""
    gray = frame.gray.copy()
    bonnet = np.random.default_rng(0).integers(0, 256, gray.shape, np.uint8)
    gray[160:] = cv2.GaussianBlur(bonnet, (0, 0), 1.5)[160:]
    return replace(frame, gray=gray, left_out=mask)


def test_masked_bonnet_has_no_features_or_matches():
    """At one place, at another, and at the first again, a little aside."""
    here, there = Cards(0), Cards(1)
    frames = [here.frame(1.0, pose()), there.frame(1.1, pose(x=5.0)),
              here.frame(1.2, pose(x=0.4), noise=1)]
    mask = np.zeros(frames[0].gray.shape, bool)
    mask[160:] = True
    found, lowest = [], []
    with KeyframeFile() as file:
        for given, kept in ((mask, {}), (mask, file), (None, {})):
            finder = EdgeFinder(EstimatorConfig(), SlamConfig(loop_gap=0.05), kept)
            edges = []
            for i, frame in enumerate(frames):
                finder.add(bonneted(frame, given))
                edges += finder.loops(i)
            found.append(edges)
            lowest.append(max(one.features.points[:, 1].max() for one in kept.values()))
            assert all((one.frame.left_out is None) == (given is None) for one in kept.values())
    assert max(lowest[:2]) < 160 - 12 and lowest[2] > 160
    (edge,), (again,) = found[:2]
    assert (edge.source, edge.target) == (2, 0)
    assert np.allclose(unit(edge.motion[:3, 3]), [-1, 0, 0], atol=0.05)
    assert np.array_equal(edge.motion, again.motion)


# Lengths of loops

def seen(points, motion, noise=0.0, seed=0):
    """Exact pair of views of points (N, 3), motion the second camera in the first."""
    R, t = motion[:3, :3].T, -motion[:3, :3].T @ motion[:3, 3]

    def pixels(X):
        x = X @ K.T
        return x[:, :2] / x[:, 2:]

    y = pixels(points @ R.T + t)
    y += noise * np.random.default_rng(seed).normal(size=y.shape)
    return RelativePose(Status.OK, R, unit(t), x=pixels(points), y=y, y_opt=y,
                        inliers=np.ones(len(points), bool))


@pytest.fixture
def points():
    rng = np.random.default_rng(4)
    return np.column_stack([rng.uniform(-3, 3, (80, 2)), rng.uniform(4, 20, 80)])


@pytest.mark.parametrize('motion', [pose(z=-0.4), pose(x=0.3, z=1.2, yaw=0.05), pose(x=-2.0)])
def test_loop_length_comes_from_the_depths_of_a_step(points, motion):
    step, known = pose(z=-1.0, yaw=0.02), Length(1.0, 0.05, True)
    true = np.linalg.norm(motion[:3, 3])
    exact = transferred_length(seen(points, step), seen(points, motion), known, K)
    assert exact.known
    assert exact.value == pytest.approx(true, rel=1e-6)
    assert exact.sigma == pytest.approx(0.05 * true, rel=1e-3)
    noisy = transferred_length(seen(points, step, 0.3, 1), seen(points, motion, 0.3, 2), known, K)
    assert abs(noisy.value - true) < 2 * noisy.sigma
    assert exact.sigma < noisy.sigma < true


def test_loop_lengths_are_consistent_with_their_sigma(points):
    step, motion = pose(z=-1.0, yaw=0.02), pose(x=0.3, z=1.2, yaw=0.05)
    true, errors = np.linalg.norm(motion[:3, 3]), []
    for seed in range(100):
        length = transferred_length(seen(points, step, 0.3, 2 * seed),
                                    seen(points, motion, 0.3, 2 * seed + 1),
                                    Length(1.0, 1e-6, True), K)
        errors.append((length.value - true) / length.sigma)
    # Points here err independently, which those of images do not; and near ones less than far.
    assert 0.1 < np.sqrt(np.mean(np.square(errors))) < 1


def test_length_is_unknown_with_too_few_shared_points(points):
    step, other = seen(points[:40], pose(z=-1.0)), seen(points[30:], pose(x=1.0))
    assert not transferred_length(step, other, Length(1.0, 0.05, True), K).known
    # far points have no parallax, and so no depth
    far = points * 1e4
    assert not transferred_length(seen(far, pose(z=-1.0)), seen(far, pose(x=1.0)),
                                  Length(1.0, 0.05, True), K).known


def test_loop_without_parallax_has_a_known_short_length():
    """The first view once more: no parallax, so no direction, but no farther than a step."""
    cards = Cards()
    poses = np.array([pose(x=0.5 * i) for i in range(3)] + [pose()])
    graph = chain(poses)
    finder = EdgeFinder(EstimatorConfig(), SlamConfig(loop_gap=0.25))
    for i, (here, before) in enumerate(zip(poses, (None, *graph.edges))):
        finder.add(cards.frame(1 + 0.1 * i, here, noise=i), before)
    edge, = finder.loops(3)
    assert (edge.source, edge.target, edge.scale_known) == (3, 0, True)
    assert np.linalg.norm(edge.motion[:3, 3]) < 0.1
    step = np.linalg.norm(graph.edges[-1].motion[:3, 3])
    assert np.sqrt(np.linalg.eigvalsh(edge.covariance)[-1]) == pytest.approx(step, rel=0.1)


# Optimisation

@pytest.fixture
def optimise():
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph.backend import optimise
    return optimise


def test_consistent_graph_is_not_changed(optimise):
    true, _ = twice_round()
    graph = chain(true)
    graph = replace(graph, edges=(*graph.edges, loop(true, 60, 0), loop(true, 119, 59)))
    solution = optimise(graph)
    assert np.allclose(solution.graph.poses, true, atol=1e-6)
    assert (solution.trust > 0.99).all()


def test_loops_remove_drift(optimise):
    true, drifted = twice_round()
    graph = chain(drifted)
    loops = tuple(loop(true, 60 + i, i) for i in range(0, 60, 5))
    after = optimise(replace(graph, edges=(*graph.edges, *loops))).graph.poses

    def error(poses):
        return position_rmse(aligned(poses[:, :3, 3], true[:, :3, 3]), true[:, :3, 3])

    assert error(drifted) > 0.5
    assert error(after) < error(drifted) / 5


def test_outlier_loops_are_rejected(optimise):
    true, drifted = twice_round()
    graph = chain(drifted)
    good = tuple(loop(true, 60 + i, i) for i in range(0, 60, 5))
    rng = np.random.default_rng(1)
    wrong = tuple(replace(loop(true, 60 + i, i), source=int(rng.integers(40, 50)))
                  for i in range(15, 23))
    clean = optimise(replace(graph, edges=(*graph.edges, *good)))
    solution = optimise(replace(graph, edges=(*graph.edges, *good, *wrong)))
    assert (solution.trust[-len(wrong):] < 0.1).all()
    assert (solution.trust[:-len(wrong)] > 0.5).all()
    assert np.allclose(solution.graph.poses, clean.graph.poses, atol=0.05)


@pytest.mark.parametrize('share', [0.03, 0.1])
def test_wrong_loops_that_agree_do_not_outweigh_the_odometry(optimise, share):
    """Past equal houses, each loop says that no house was passed; so did a map before."""
    true, before = (np.array([pose(z=by * i) for i in range(60)]) for by in (1.0, 0.1))
    graph = chain(true, np.diag([share, share, share, *SIGMAS[3:]])**2)
    wrong = tuple(replace(loop(true, i, i - 10), motion=pose(z=-0.3)) for i in range(10, 60, 2))
    right = loop(true, 55, 50)
    solution = optimise(replace(graph, poses=before, edges=(*graph.edges, *wrong, right)))
    assert solution.rejected('loop') == len(wrong)
    assert solution.trust[-1] > 0.9
    assert (solution.trust[:len(graph.edges)] == 1).all()
    assert np.allclose(solution.graph.poses, true, atol=share)


def test_many_loops_outvote_a_wrong_step_of_the_odometry(optimise):
    """It is 28 standard deviations off, and a hundred loops agree with the rest."""
    true, _ = twice_round(10)
    graph = chain(true)
    off = replace(graph.edges[4], motion=graph.edges[4].motion @ pose(x=28 * SIGMAS[0]))
    loops = [loop(true, 10 + i, (i + j) % 10) for i in range(10) for j in range(10)]
    solution = optimise(replace(graph, edges=(*graph.edges[:4], off, *graph.edges[5:], *loops)))
    assert solution.rejected('loop') == 0
    assert np.allclose(solution.graph.poses, true, atol=0.1)


@pytest.mark.parametrize(('square', 'rejected'), [(12.0, 0), (15.0, 0), (19.0, 1), (40.0, 1)])
def test_loop_is_rejected_beyond_its_99_percent_bound(optimise, square, rejected):
    """Of chi-squared with six degrees of freedom it is 16.8; the odometry is exact."""
    true, _ = twice_round()
    wrong = loop(true, 80, 20)
    wrong.motion[:3, 3] += SIGMAS[:3] * np.sqrt(square / 3)
    graph = chain(true, np.diag(SIGMAS**2) * 1e-6)
    found = optimise(replace(graph, edges=(*graph.edges, wrong)))
    assert found.rejected('loop') == rejected
    assert len(found.accepted.edges) == len(graph.edges) + 1 - rejected


def test_loop_of_unknown_length_constrains_directions(optimise):
    true, drifted = twice_round()
    graph = chain(drifted)
    loops = []
    for i in range(0, 60, 5):
        edge = loop(true, 60 + i, (i + 1) % 60)
        direction = unit(edge.motion[:3, 3])
        motion = edge.motion.copy()
        motion[:3, 3] *= 3.0
        loops.append(replace(edge, motion=motion, scale_known=False,
                             covariance=edge.covariance + 1e6 * np.pad(
                                 np.outer(direction, direction), (0, 3))))
    after = optimise(replace(graph, edges=(*graph.edges, *loops))).graph.poses
    assert position_rmse(after[:, :3, 3], true[:, :3, 3]) < position_rmse(
        drifted[:, :3, 3], true[:, :3, 3]) / 5


def test_singular_covariance_of_an_edge_is_refused_by_name(optimise):
    true, _ = twice_round()
    graph = chain(true)
    bad = replace(loop(true, 60, 0), covariance=np.ones((6, 6)))
    with pytest.raises(DjetError, match=r'loop edge 60 -> 0 .* is singular'):
        optimise(replace(graph, edges=(*graph.edges, bad)))


# Alignment

def test_the_plot_of_a_straight_path_has_room_beside_it(optimise, tmp_path):
    from djet_ros.lab.slam_report import write_report
    from djet_ros.posegraph.keyframe_map import KeyframeOffset
    from djet_ros.posegraph.offline import Slam
    graph = chain(np.array([pose(z=float(i)) for i in range(60)]))
    write_report(tmp_path, Slam(graph, [KeyframeOffset(keyframe=i) for i in range(60)],
                                optimise(graph), Scale.METRIC),
                 np.full((60, 4, 4), np.nan), 'drive', Config())
    dark = cv2.imread(str(tmp_path / 'slam.png'), cv2.IMREAD_GRAYSCALE) < 64
    # the two lines of the axes
    assert dark.sum(0).max() > 0.7 * len(dark)
    assert dark.sum(1).max() > 0.7 * len(dark[0])


def test_alignment_undoes_any_motion_and_scale():
    rng = np.random.default_rng(2)
    truth = rng.normal(size=(20, 3))
    R = rotation_exp(rng.normal(size=3))
    moved = truth @ R.T + [1, 2, 3]
    assert np.allclose(aligned(moved, truth), truth)
    assert np.allclose(aligned(0.2 * moved, truth, metric=False), truth)
    assert position_rmse(aligned(0.2 * moved, truth), truth) > 0.5
    holes = truth.copy()
    holes[3:6] = np.nan
    assert np.allclose(aligned(moved, holes), truth)
    assert position_rmse(truth + np.array([3, 0, 4]), holes) == pytest.approx(5)


@pytest.mark.parametrize('flat', [1.0, 1e-3])
def test_alignment_of_a_noisy_or_mirrored_path_is_the_best_rotation(flat):
    """Chirality is not undone: a camera that turns left instead of right has an error."""
    rng = np.random.default_rng(3)
    truth = rng.normal(size=(20, 3)) * [1.0, flat, 2.0] + [7, 8, 9]
    noisy = truth @ rotation_exp(rng.normal(size=3)).T + 0.1 * rng.normal(size=truth.shape)
    for estimate in noisy, noisy * [-1, 1, 1]:
        path, goal = estimate - estimate.mean(0), truth - truth.mean(0)
        R, left = Rotation.align_vectors(goal, path)
        assert position_rmse(aligned(estimate, truth), truth) * np.sqrt(20) == pytest.approx(left)
        scale = float((goal * R.apply(path)).sum() / (path**2).sum())
        assert np.allclose(aligned(estimate, truth, metric=False) - truth.mean(0),
                           scale * R.apply(path))


# The command

@pytest.fixture(scope='module', autouse=True)
def without_evo():
    """Do without evo, whose six processes take most of the time of a run: see test_loop.py."""
    def absent(*_):
        raise DjetError('evo is left out of these tests')

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('djet_ros.lab.slam_report.trajectory_metrics', absent)
        yield


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    """Return a KITTI sequence of a path to the right and back, past cards."""
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    positions = [0.25 * i for i in (*range(8), *range(8, -1, -1))]
    return filmed(tmp_path_factory.mktemp('dataset') / 'sequences' / '00',
                  [pose(x=metres, z=0.3 * metres**2) for metres in positions], noise=True)


FLAGS = ('--keyframes', 'distance', '--keyframe-distance', 0.5, '--loop-gap', 0.5)
# the same without a search for loops, which takes most of the time
NO_LOOPS = (*FLAGS[:-1], 1000)


@pytest.fixture(scope='module')
def closed(drive, tmp_path_factory):
    """Folder of a run on the recording."""
    out = tmp_path_factory.mktemp('run') / 'slam'
    done = djet('slam', drive, '--output', out, '--scale', 'ground_truth', *FLAGS)
    assert 'edges: loop' in done.stdout
    return out


@pytest.mark.slow
def test_slam_command_closes_loops_of_a_recording(closed):
    report = json.loads((closed / 'slam.json').read_text())
    assert (report['scale'], report['scale_kind'], report['scale_uncertainty']) == (
        'ground_truth', 'metric', 0.05)
    assert report['frames'] == 17
    assert report['keyframes'] == report['edges']['odometry'] + 1 >= 7
    assert report['edges']['loop'] >= 3
    assert report['errors']['after']['ape_m'] < 0.05
    stamps, poses = read_tum(closed / 'after_tum.txt')
    _, truth = read_tum(closed / 'truth_tum.txt')
    assert len(stamps) == 17
    assert position_rmse(aligned(poses[:, :3, 3], truth[:, :3, 3]),
                         truth[:, :3, 3]) == pytest.approx(report['errors']['after']['ape_m'])
    size = cv2.imread(str(closed / 'slam.png')).shape
    assert min(size[:2]) > 400


def test_loop_errors_are_consistent_with_their_covariance(closed):
    rows = [row.split(',') for row in (closed / 'pose_graph.csv').read_text().splitlines()]
    stamps, truth = read_tum(closed / 'truth_tum.txt')
    at = dict(zip(stamps.tolist(), truth))
    loops = [row for row in rows if row[2] == 'loop']
    surprises = []
    for row in loops:
        true = np.linalg.inv(at[int(row[0])]) @ at[int(row[1])]
        numbers = np.array(row[4:], float)
        covariance = np.zeros((6, 6))
        covariance[np.triu_indices(6)] = numbers[7:]
        covariance = covariance + np.triu(covariance, 1).T
        off = true[:3, 3] - numbers[:3]
        surprises.append(off @ np.linalg.solve(covariance[:3, :3], off))
    # of three degrees of freedom; single pairs may be off, as the kernel expects of loops
    assert np.median(surprises) < 8


@pytest.mark.slow
def test_slam_command_accepts_results_and_a_moved_recording(
        closed, drive, tmp_path):
    results = closed / 'replay'
    djet('slam', results, '--output', tmp_path / 'again', *FLAGS)
    for name in ('pose_graph.g2o', 'after_tum.txt'):
        assert (tmp_path / 'again' / name).read_bytes() == (closed / name).read_bytes()
    summary = json.loads((results / 'summary.json').read_text())
    moved = tmp_path / 'results'
    moved.mkdir()
    for name in ('frames.csv', 'trajectory_tum.txt', 'config.yaml', 'bag'):
        (moved / name).symlink_to(results / name)
    (moved / 'summary.json').write_text(json.dumps({**summary, 'source': '/gone'}))
    refused = djet('slam', moved, '--output', tmp_path / 'moved', *FLAGS, expect=2)
    assert '--source' in refused.stderr
    # Whatever a killed replay of an earlier version may say of its recording.
    (moved / 'summary.json').write_text('{}')
    refused = djet('slam', moved, '--output', tmp_path / 'moved', *FLAGS, expect=2)
    assert 'name it with --source' in refused.stderr
    djet('slam', moved, '--output', tmp_path / 'moved', '--source', drive, *FLAGS[:2],
         '--keyframe-distance', 1.0, *FLAGS[4:])
    report = json.loads((tmp_path / 'moved' / 'slam.json').read_text())
    assert report['edges']['loop'] > 0


@pytest.mark.slow
def test_keyframes_agree_between_messages_and_results(closed, tmp_path):
    from djet_ros.posegraph.step_messages import StepMessages
    from djet_ros.recordings.bags import Bag
    from djet_ros.replay.graph_of_results import read_steps
    results, parts = read_steps(closed / 'replay'), StepMessages('optical')
    take = {'relative_pose_cov': parts.relative_pose, 'relative_pose_status': parts.status,
            'odometry': parts.odometry}
    with Bag(closed / 'replay' / 'bag') as bag:
        received = [step for topic, _, message in bag.messages(
            {f'/vo_node/{name}' for name in take})
            for step in take[topic.rpartition('/')[2]](message)]
    assert [(step.stamp_ns, step.keyframe) for step in received] == [
        (step.stamp_ns, step.keyframe) for step in results]
    chosen = [step.stamp_ns for step in results if step.keyframe]
    assert 3 <= len(chosen) < len(results)
    djet('slam', closed / 'replay', '--output', tmp_path / 'slam', '--keyframes', 'odometry',
         *NO_LOOPS[2:])
    report = json.loads((tmp_path / 'slam' / 'slam.json').read_text())
    assert report['keyframes'] == len(chosen)


@pytest.mark.slow
def test_slam_command_keeps_earlier_results_and_parameters(closed, tmp_path):
    refused = djet('slam', closed / 'replay', '--output', closed, *FLAGS, expect=2)
    assert '--overwrite' in refused.stderr
    refused = djet('slam', closed / 'replay', '--output', tmp_path / 'x', '--links', 0, expect=2)
    assert 'links is 0' in refused.stderr
    refused = djet('slam', closed / 'replay', '--output', tmp_path / 'x', '--scale', 'constant',
                   expect=2)
    assert 'whose parameters cannot be changed' in refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize(('text', 'said'), [
    ('slam: {links: 2, loop_gap: 1000.0, image_buffer: 9}', None),
    ('/pose_graph_node: {ros__parameters: {slam: {links: 2, loop_gap: 1000.0}}}', None),
    ('{odometry: {scale: ground_truth}, slam: {links: 2, loop_gap: 1000.0}}', None),
    ('{odometry: {max_gap: 3.0}, slam: {links: 2}}', 'odometry.max_gap was 1.0, and is 3.0 now'),
    ('preset: fast', "preset was 'best', and is 'fast' now"),
])
def test_a_file_may_change_the_loops_of_results_and_not_their_replay(closed, tmp_path, text, said):
    (tmp_path / 'some.yaml').write_text(text)
    done = djet('slam', closed / 'replay', '--output', tmp_path / 'slam', *FLAGS[:4], '--config',
                tmp_path / 'some.yaml', expect=2 if said else 0)
    if said:
        assert said in done.stderr
        assert not (tmp_path / 'slam').exists()
        return
    parameters = json.loads((tmp_path / 'slam' / 'slam.json').read_text())['parameters']
    assert (parameters['links'], parameters['loop_gap']) == (2, 1000.0)
    assert parameters['keyframe_distance'] == FLAGS[3]


@pytest.mark.slow
def test_a_mistake_in_the_command_costs_no_earlier_results(closed, drive, tmp_path):
    shutil.copytree(closed, tmp_path / 'slam')
    before = {path: path.read_bytes() for path in (tmp_path / 'slam').rglob('*') if path.is_file()}
    results = tmp_path / 'slam' / 'replay'
    for mistake, report in (((tmp_path / 'absent',), 'does not exist'),
                            ((drive, '--mask-file', tmp_path / 'absent.png'), 'absent.png'),
                            ((drive, '--loop-gap', '-1'), 'loop_gap is -1'),
                            ((results, '--source', tmp_path / 'absent'), 'absent'),
                            ((results, '--mask-topic', '/mask'), 'does not use it'),
                            ((results, '--imu-topic', '/imu'), 'does not use it')):
        refused = djet('slam', *mistake, '--output', tmp_path / 'slam', '--overwrite', expect=2)
        assert report in refused.stderr
        assert {path: path.read_bytes() for path in (tmp_path / 'slam').rglob('*')
                if path.is_file()} == before


@pytest.mark.slow
def test_a_recording_without_a_usable_image_costs_no_earlier_results(closed, drive, tmp_path):
    shutil.copytree(closed, tmp_path / 'slam')
    before = {path: path.read_bytes() for path in (tmp_path / 'slam').rglob('*') if path.is_file()}
    shutil.copytree(drive, tmp_path / '00')
    for path in (tmp_path / '00' / 'image_0').iterdir():
        path.write_bytes(path.read_bytes()[:500])
    refused = djet('slam', tmp_path / '00', '--output', tmp_path / 'slam', '--overwrite', expect=2)
    assert 'none of 17 images could be used' in refused.stderr
    assert {path: path.read_bytes() for path in (tmp_path / 'slam').rglob('*')
            if path.is_file()} == before
    # Of a replay that begins, the graph of the earlier one is none.
    shutil.copy(drive / 'image_0' / '000003.png', tmp_path / '00' / 'image_0')
    djet('slam', tmp_path / '00', '--output', tmp_path / 'slam', '--overwrite', expect=2)
    assert [path.name for path in (tmp_path / 'slam').iterdir()] == ['replay']


@pytest.mark.slow
def test_a_recording_is_used_up_to_its_damage(drive, tmp_path):
    """As after a battery that was empty."""
    djet('kitti-to-bag', drive, tmp_path / 'bag')
    file, = (tmp_path / 'bag').glob('*.mcap')
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    printed = djet('slam', tmp_path / 'bag', '--output', tmp_path / 'slam', *NO_LOOPS).stderr
    assert f'djet: warning: {file}: the chunk at byte' in printed
    assert 'everything before that was read' in printed
    assert 5 < json.loads((tmp_path / 'slam' / 'slam.json').read_text())['frames'] < 12


@pytest.mark.slow
def test_overwriting_run_removes_all_earlier_results(closed, drive, tmp_path):
    out = tmp_path / 'slam'
    shutil.copytree(closed, out)
    (out / 'notes.txt').write_text('mine')
    djet('slam', out / 'replay', '--output', out, '--overwrite', '--links', 2, *NO_LOOPS)
    assert json.loads((out / 'slam.json').read_text())['parameters']['links'] == 2
    djet('slam', drive, '--output', out, '--overwrite', *NO_LOOPS)
    assert json.loads((out / 'slam.json').read_text())['parameters']['links'] != 2
    assert (out / 'notes.txt').read_text() == 'mine'


@pytest.mark.slow
def test_links_to_more_keyframes_are_edges_of_unknown_length(closed, tmp_path):
    djet('slam', closed / 'replay', '--output', tmp_path / 'slam', '--links', 2, *NO_LOOPS)
    rows = [row.split(',') for row in (tmp_path / 'slam' / 'pose_graph.csv').read_text(
        ).splitlines()]
    links = [row for row in rows if row[2] == 'link']
    assert len(links) >= 4
    assert all(row[3] == '0' for row in links)


def test_gtsam_built_for_another_numpy_is_refused_before_it_crashes(tmp_path, monkeypatch, capsys):
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros import libraries
    from djet_ros.cli.main import main
    versions = {'gtsam': '4.2.2', 'numpy': '2.4.6'}
    monkeypatch.setattr(libraries, 'version', versions.__getitem__)
    assert main(['slam', str(tmp_path), '--output', str(tmp_path / 'slam')]) == 2
    assert 'gtsam 4.2.2 does not work' in capsys.readouterr().err
    assert libraries.problem_of('gtsam').startswith(
        'gtsam 4.2.2 does not work with NumPy 2.4.6: ')
    for versions['gtsam'], versions['numpy'] in (('4.2.2', '1.26.4'), ('4.3.0', '2.4.6')):
        assert libraries.problem_of('gtsam') == ''


@pytest.mark.slow
def test_warnings_of_the_replay_are_those_of_slam_too(drive, tmp_path):
    """Ground truth with another clock gives no errors, and somebody has to say so."""
    truth = tmp_path / 'truth.txt'
    truth.write_text(''.join(f'{5000 + 0.1 * i} {0.25 * i} 0 0 0 0 0 1\n' for i in range(17)))
    printed = djet('slam', drive, '--output', tmp_path / 'slam', '--poses', truth, *NO_LOOPS)
    assert 'errors' not in json.loads((tmp_path / 'slam' / 'slam.json').read_text())
    assert f'djet: warning: no errors were computed: the stamps of {truth} are' in printed.stderr
    assert printed.stderr.count('djet: warning: ') == 1


@pytest.mark.slow
def test_the_odometry_is_recommended_if_no_loop_was_closed(drive, tmp_path):
    printed = djet('slam', drive, '--output', tmp_path / 'slam', '--scale', 'ground_truth',
                   *NO_LOOPS).stdout
    assert 'no loop was closed: prefer before_tum.txt' in printed
