"""Drift of the unit of lengths: loops measure it, and circles that are too large are corrected."""

from dataclasses import replace

from djet_ros.config.sections import Config
from djet_ros.core.geometry import rotation_exp, unit
from djet_ros.core.types import RelativePose, Status
from djet_ros.odometry.frame import Frame
from djet_ros.odometry.scale import Length
from djet_ros.posegraph.pose_graph import Edge, PoseGraph
from djet_ros.posegraph.shared_points import log_scale_ratio, transferred_length
from djet_ros.posegraph.steps import Step
from djet_ros.posegraph.units import log_units, rescaled_edge, to_common_unit
import numpy as np
import pytest

N = 60
SIGMAS = np.array([0.01, 0.01, 0.01, 0.001, 0.001, 0.001])


def circles():
    """Poses (N, 4, 4) twice round a circle of thirty steps."""
    poses = np.tile(np.eye(4), (N, 1, 1))
    for i in range(N):
        angle = 2 * np.pi * i / (N / 2)
        poses[i, :3, :3] = rotation_exp(np.array([0.0, angle, 0.0]))
        poses[i, :3, 3] = 10 * np.array(
            [1 - np.cos(angle), 0.0, np.sin(angle)])
    return poses


def drifting(poses, drift=0.003, wrong=()):
    """Edges of an odometry whose unit grows with each step, and loops from lap to lap."""
    units = drift * np.arange(N)
    edges = []
    for i in range(N - 1):
        motion = np.linalg.inv(poses[i]) @ poses[i + 1]
        motion[:3, 3] *= np.exp(-units[i])
        edges.append(Edge(i, i + 1, motion, np.diag(SIGMAS**2)))
    for i in range(30, N, 5):
        motion = np.linalg.inv(poses[i]) @ poses[i - 30]
        motion[:3, 3] *= np.exp(-units[i])
        stretch = units[i - 30] - units[i] + (1.0 if i in wrong else 0.0)
        edges.append(Edge(i, i - 30, motion, np.diag(SIGMAS**2), 'loop', True, (stretch, 0.005)))
    return edges, units


def integrated(edges):
    poses = [np.eye(4)]
    for edge in edges[:N - 1]:
        poses.append(poses[-1] @ edge.motion)
    return np.array(poses)


def test_units_follow_the_scale_ratios_of_loops():
    edges, units = drifting(circles())
    found = log_units(N, edges)
    assert found[0] == 0
    assert found[30::5] - found[:30:5] == pytest.approx(0.09, abs=0.01)
    # How it came about within the lap is not seen by loops that all span one.
    assert found == pytest.approx(units, abs=0.04)


@pytest.mark.parametrize('gap', [
    {'kind': 'unknown', 'scale_known': False}, {'scale_known': False}, {'motion': np.eye(4)}])
def test_the_unit_changes_where_no_length_carries_it_on(gap):
    """Tracking is lost and begins again, or the length of a step is unknown or zero."""
    edges, _ = drifting(circles(), drift=0.0)
    edges[44] = replace(edges[44], **gap)
    jumped = np.where(np.arange(N) > 44, np.log(2), 0.0)
    edges[N - 1:] = [replace(edge, log_scale_ratio=(
        jumped[edge.target] - jumped[edge.source], 0.005)) for edge in edges[N - 1:]]
    assert log_units(N, edges) == pytest.approx(jumped, abs=0.01)


def test_the_unit_drifts_where_lengths_are_least_known():
    """Known to 12 % once and to 4 % everywhere else, however long."""
    edges, _ = drifting(circles(), drift=0.0)
    way = np.linalg.norm(edges[0].motion[:3, 3])

    def known_to(edge, share, length):
        along = length * unit(edge.motion[:3, 3])
        motion = edge.motion.copy()
        motion[:3, 3] = along
        return replace(edge, motion=motion, covariance=np.diag(SIGMAS**2 * 1e-6) + np.pad(
            share**2 * np.outer(along, along), (0, 3)))

    chain = [known_to(edge, 0.12 if i == 44 else 0.04, way if i % 2 else way / 10)
             for i, edge in enumerate(edges[:N - 1])]
    found = log_units(N, [*chain, replace(edges[-1], source=N - 1, target=0,
                                          log_scale_ratio=(-0.3, 1e-4))])
    variances = np.full(N - 1, 0.04**2)
    variances[44] = 0.12**2
    assert np.diff(found) == pytest.approx(0.3 * variances / variances.sum(), rel=0.02)


def test_outlier_scale_ratio_is_rejected():
    edges, units = drifting(circles(), wrong=(40,))
    assert log_units(N, edges) == pytest.approx(units, abs=0.04)


def test_without_scale_ratios_nothing_is_rescaled():
    edges, _ = drifting(circles())
    graph = PoseGraph(np.arange(N), circles(), tuple(edges[:N - 1]))
    same, factors = to_common_unit(graph)
    assert np.array_equal(factors, np.ones(N))
    assert all(one is other for one, other in zip(same.edges, graph.edges))


def test_rescaled_edge_keeps_rotation_and_relative_uncertainty():
    errors, motion = np.random.default_rng(5).normal(size=(6, 20)), circles()[7]
    covariance = errors @ errors.T / 20
    edge = rescaled_edge(Edge(0, 1, motion, covariance, uncorrelated=covariance[:3, :3]), 3.0)
    assert np.array_equal(edge.motion[:3, :3], motion[:3, :3])
    assert np.array_equal(edge.motion[:3, 3], 3 * motion[:3, 3])
    errors[:3] *= 3
    assert np.allclose(edge.covariance, errors @ errors.T / 20)
    assert np.allclose(edge.uncorrelated, edge.covariance[:3, :3])


def test_loops_correct_scale_drift():
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph.backend import optimise
    truth = circles()
    edges, _ = drifting(truth)
    graph = PoseGraph(np.arange(N), integrated(edges), tuple(edges))
    rigid = PoseGraph(np.arange(N), graph.poses, tuple(
        Edge(e.source, e.target, e.motion, e.covariance, e.kind) for e in edges))
    before, mended, bent = (np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max()
                            for poses in (graph.poses, optimise(graph).graph.poses,
                                          optimise(rigid).graph.poses))
    assert before > 1
    assert mended < before / 3
    assert mended < bent / 2


def test_rejected_edges_are_counted_by_kind():
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph.backend import OptimisedGraph
    edges = tuple(Edge(0, 1, np.eye(4), np.eye(6), kind)
                  for kind in ('odometry', 'link', 'loop', 'loop', 'loop'))
    found = OptimisedGraph(PoseGraph(np.arange(2), circles()[:2], edges),
                           np.array([1.0, 0.2, 0.2, 0.0, 0.3]), np.ones(2))
    assert found.accepted.edges == (edges[0], edges[4])
    assert [found.rejected(kind) for kind in ('odometry', 'link', 'loop')] == [0, 1, 2]


def pair(points, R, t, K):
    """Exact answer of an estimator for points (N, 3) of the first view."""
    there = points @ R.T + t
    x, y = ((p @ K.T)[:, :2] / p[:, 2:] for p in (points, there))
    return RelativePose(Status.OK, R=R, t=unit(t), x=x, y=y, y_opt=y,
                        inliers=np.ones(len(x), bool)), there


def test_scale_ratio_without_points_in_all_three_pairs():
    """Half of a loop's points are those of the step at its one end, half at the other."""
    rng = np.random.default_rng(1)
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    points = rng.uniform((-6, -3, 8), (6, 3, 30), (200, 3))
    turn, still = rotation_exp(np.array([0.0, -0.05, 0.01])), np.eye(3)
    translations = np.array([[0.1, 0, 1.0], [0.4, 0.1, -0.9], [-0.1, 0, 1.2]])
    lengths = np.linalg.norm(translations, axis=1)
    loop, there = pair(points, turn, translations[1], K)
    near, far = 0.5, 0.6
    errors = []
    for noise in (0.0, *[0.2] * 40):
        step, _ = pair(points[:100], still, translations[0], K)
        other, _ = pair(there[100:], still, translations[2], K)
        noisy = [replace(one, y_opt=one.y + noise * rng.normal(size=one.y.shape))
                 for one in (step, loop, other)]
        ratio, sigma = log_scale_ratio(noisy[0], lengths[0] / near, noisy[1], lengths[1] / near,
                                       noisy[2], lengths[2] / far, K)
        if noise:
            errors.append((ratio - np.log(far / near)) / sigma)
        else:
            assert ratio == pytest.approx(np.log(far / near), abs=1e-6)
    # Points here err independently, which those of images do not.
    assert 0.1 < np.sqrt(np.mean(np.square(errors))) < 1


def test_scale_ratio_at_the_end_of_a_short_loop_is_that_of_depths():
    """A loop of two centimetres tells hardly any depth, but where the camera is."""
    rng = np.random.default_rng(4)
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    points = rng.uniform((-6, -3, 8), (6, 3, 30), (300, 3))
    ways = np.array([[0.1, 0, 1.0], [0.02, 0.0, 0.0], [-0.1, 0, 1.2]])
    lengths, near, far = np.linalg.norm(ways, axis=1), 0.5, 0.6
    step, _ = pair(points, np.eye(3), ways[0], K)
    loop, there = pair(points, rotation_exp(np.array([0.0, -0.05, 0.01])), ways[1], K)
    other, _ = pair(there, np.eye(3), ways[2], K)
    noisy = [replace(one, y_opt=one.y + 0.2 * rng.normal(size=one.y.shape))
             for one in (step, loop, other)]
    ratio, sigma = log_scale_ratio(noisy[0], lengths[0] / near, noisy[1], lengths[1] / near,
                                   noisy[2], lengths[2] / far, K)
    assert ratio == pytest.approx(np.log(far / near), abs=0.01)
    assert sigma < 0.02


def test_scale_ratio_from_depths():
    rng = np.random.default_rng(0)
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    points = rng.uniform((-6, -3, 8), (6, 3, 30), (200, 3))
    step, _ = pair(points, rotation_exp(np.array([0.0, 0.02, 0])), np.array([0.1, 0, 1.0]), K)
    loop, there = pair(points, rotation_exp(np.array([0.0, -0.05, 0.01])),
                       np.array([0.4, 0.1, -0.3]), K)
    other, _ = pair(there, rotation_exp(np.array([0.01, 0, 0])), np.array([-0.1, 0, 1.2]), K)
    near, far = 0.5, 0.6  # metres in a unit
    lengths = np.linalg.norm([[0.1, 0, 1.0], [0.4, 0.1, -0.3], [-0.1, 0, 1.2]], axis=1)
    ratio, sigma = log_scale_ratio(step, lengths[0] / near, loop, lengths[1] / near, other,
                                   lengths[2] / far, K)
    assert ratio == pytest.approx(np.log(far / near), abs=1e-6)
    assert sigma == pytest.approx(1e-3)
    few = RelativePose(Status.OK, x=other.x[:9], y=other.y[:9], y_opt=other.y_opt[:9],
                       inliers=np.ones(9, bool), R=other.R, t=other.t)
    assert log_scale_ratio(step, 1.0, loop, 1.0, few, 1.0, K) is None


def test_neither_points_without_parallax_nor_a_motion_of_the_wrong_sign_tell_a_length():
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    points = np.random.default_rng(2).uniform((-6, -3, 8), (6, 3, 30), (200, 3))
    turn, length = rotation_exp(np.array([0.0, -0.05, 0.01])), Length(2.0, 0.01, True)
    ways = np.array([[0.1, 0, 1.0], [0.4, 0.1, -0.3]])
    step, other = (pair(points, turn, way, K)[0] for way in ways)
    found = transferred_length(step, other, length, K)
    assert found.known
    assert found.value == pytest.approx(2 * np.linalg.norm(ways[1]) / np.linalg.norm(ways[0]))
    assert not transferred_length(step, replace(other, t=-other.t), length, K).known
    far, farther = (pair(1e4 * points, turn, way, K)[0] for way in ways)
    assert not transferred_length(far, farther, length, K).known


def test_edges_of_a_removed_keyframe_are_rescaled_to_its_successor(monkeypatch):
    """In a map without errors, no edge has one by removed keyframes, though the unit grows."""
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph import keyframe_map
    truth = circles()
    edges, units = drifting(truth)

    class Told:
        """Return the given loops."""

        def __init__(self, *_):
            pass

        def add(self, *_):
            pass

        def forget(self, first):
            pass

        def links(self, current):
            return [replace(edge, kind='link', source=current - 5, motion=rescaled_edge(
                Edge(0, 1, np.linalg.inv(truth[current - 5]) @ truth[current], edge.covariance),
                np.exp(-units[current - 5])).motion) for edge in edges[:N - 1]
                if edge.target == current and current % 7 == 3 and current > 5]

        def loops(self, current, units):
            return [edge for edge in edges[N - 1:] if edge.source == current]

    monkeypatch.setattr(keyframe_map, 'EdgeFinder', Told)
    graph = keyframe_map.KeyframeMap(Config(), max_keyframes=40)
    for i, place in enumerate(truth):
        step = Step(i, Status.OK, place, i - 1, edges[i - 1].motion, edges[i - 1].covariance, True,
                    metric=False, keyframe=True)
        graph.extend(step if i else Step(0, Status.FIRST_FRAME, place, keyframe=True),
                     lambda stamp: Frame(np.zeros((4, 4), np.uint8), np.eye(3), stamp))
        graph.search_loops()
        newest = graph.keyframes[-1]
        newest.pose, newest.factor = truth[i], float(np.exp(units[i]))
    assert (graph.first, graph.count('loop'), graph.count('odometry')) == (N - 40, 6, 39)
    assert graph.count('link') > 3
    assert any(edge.kind == 'link' and edge.target - edge.source < 5 for edge in graph.edges)
    for edge in graph.edges:
        source, target = (graph.keyframes[end - graph.first] for end in (edge.source, edge.target))
        assert np.allclose(rescaled_edge(edge, source.factor).motion,
                           np.linalg.inv(source.pose) @ target.pose)
        if edge.kind == 'loop':
            assert edge.log_scale_ratio[0] == pytest.approx(np.log(target.factor / source.factor))


def test_first_remaining_keyframe_keeps_its_unit():
    edges, _ = drifting(circles())
    graph = PoseGraph(np.arange(N), circles(), tuple(edges))
    one, ours = to_common_unit(graph), to_common_unit(graph, 1.5)
    assert ours[1] == pytest.approx(1.5 * one[1])
    # unless that is the metre
    metric = replace(graph, edges=(*edges[:N - 2], replace(edges[N - 2], metric=True),
                                   *edges[N - 1:]))
    assert np.array_equal(to_common_unit(metric, 1.5)[1], to_common_unit(metric)[1])
    for mine, theirs in zip(ours[0].edges, one[0].edges):
        assert np.allclose(mine.motion[:3, 3], 1.5 * theirs.motion[:3, 3])
