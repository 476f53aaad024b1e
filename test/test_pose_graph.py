"""Pose graphs: what a replay's results become, and what other programs read of it."""

import csv
from dataclasses import replace
import shutil

from cards import Cards, K, pose, SIZE
from commands import checked as djet
from conftest import write_small_kitti
from djet_ros.config.flat import from_flat
from djet_ros.config.sections import Config
from djet_ros.core.geometry import rotation_exp
from djet_ros.errors import DjetError
from djet_ros.odometry.scale import UNKNOWN_LENGTH_SIGMA
from djet_ros.odometry.uncertainty import UNKNOWN_MOTION
from djet_ros.posegraph.graph_files import write_graph
from djet_ros.posegraph.pose_graph import Edge, PoseGraph
from djet_ros.recordings.bag_writers import ResultBag
from djet_ros.recordings.bags import Bag, BagMessage
from djet_ros.recordings.recording import Recording
from djet_ros.recordings.trajectories import read_tum
from djet_ros.replay.graph_of_results import read_results
from djet_ros.replay.replay import Replay
from djet_ros.replay.results import ResultsFolder
import numpy as np
import pytest
from ros_messages import camera_info, image
from scipy.spatial.transform import Rotation

FRAMES = 5
STEP = pose(x=0.25, z=0.15, yaw=0.01)


class Drive(Recording):
    """A source of images of cards; black ones and gaps in time as wanted."""

    image_topic, info_topic = '/image_rect', '/camera_info'
    ground_truth_topic = None

    def __init__(self, black=(), gaps=(), step=STEP):
        self.auxiliary = {}
        self._black, self._gaps, self._step = black, gaps, step

    def __len__(self):
        return FRAMES

    def close(self):
        pass

    def messages(self, topics=None):
        cards, here, stamp = Cards(), np.eye(4), 10**9
        for i in range(FRAMES):
            stamp += 10**8 + (10**10 if i in self._gaps else 0)
            gray = cards.gray(here)
            if i in self._black:
                gray = np.zeros_like(gray)
            yield BagMessage(self.info_topic, stamp, camera_info(K, SIZE, stamp))
            yield BagMessage(self.image_topic, stamp, image(gray, stamp_ns=stamp))
            here = here @ self._step


def replayed(path, source=None, **parameters):
    config = from_flat({'odometry.scale': 'constant', **parameters}) if parameters else Config()
    with ResultsFolder(path, config) as folder:
        Replay(source or Drive(), config, 'drive').run(folder)
    return path


@pytest.fixture(scope='module')
def results(tmp_path_factory):
    """Results with a known scale."""
    return replayed(tmp_path_factory.mktemp('known') / 'results',
                    **{'odometry.scale_value': 0.29})


@pytest.fixture(scope='module')
def unscaled(tmp_path_factory):
    return replayed(tmp_path_factory.mktemp('unknown') / 'results',
                    **{'odometry.scale': 'none'})


def random_graph(seed, vertices=8):
    """Return a graph whose poses are inconsistent with its edges, with full covariances."""
    rng = np.random.default_rng(seed)

    def motion(size):
        result = np.eye(4)
        result[:3, :3] = rotation_exp(size * rng.normal(size=3))
        result[:3, 3] = rng.normal(size=3)
        return result

    def covariance():
        A = rng.normal(size=(6, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
        return (A.T @ A + np.diag([1, 1, 1, 0.01, 0.01, 0.01])) * 1e-2

    poses = np.array([motion(0.5) for _ in range(vertices)])
    edges = [Edge(i, i + 1, motion(0.3), covariance()) for i in range(vertices - 1)]
    edges += [Edge(vertices - 1, 0, motion(0.3), covariance(), 'loop')]
    return PoseGraph(np.arange(vertices) * 10**8 + 10**9, poses, tuple(edges))


def exact_graph(vertices=6):
    """Return a graph whose poses are consistent with its edges."""
    graph = random_graph(3, vertices)
    edges = [replace(edge, motion=np.linalg.inv(graph.poses[edge.source])
                     @ graph.poses[edge.target]) for edge in graph.edges]
    return replace(graph, edges=tuple(edges))


# From results

def test_replay_gives_a_chain_of_its_frames(results):
    graph = read_results(results)
    stamps, poses = read_tum(results / 'trajectory_tum.txt')
    assert np.array_equal(graph.stamps_ns, stamps)
    assert np.array_equal(graph.poses, poses)
    assert [(edge.source, edge.target) for edge in graph.edges] == [
        (i, i + 1) for i in range(FRAMES - 1)]
    for edge in graph.edges:
        assert edge.kind == 'odometry'
        assert edge.scale_known
        assert np.allclose(poses[edge.source] @ edge.motion, poses[edge.target], atol=1e-9)


def test_body_axes_in_the_messages_do_not_change_the_graph(results, tmp_path):
    turned = read_results(replayed(tmp_path / 'body', **{
        'odometry.scale_value': 0.29, 'odometry.frame_convention': 'body'}))
    graph = read_results(results)
    for edge, other in zip(graph.edges, turned.edges, strict=True):
        assert np.allclose(edge.motion, other.motion, atol=1e-12)
        assert np.allclose(edge.covariance, other.covariance, atol=1e-12)


def test_unknown_scale_weakens_the_information_only_along_the_translation(unscaled):
    graph = read_results(unscaled)
    for edge in graph.edges:
        assert not edge.scale_known
        information = edge.information()
        along = np.append(edge.motion[:3, :3].T @ edge.motion[:3, 3], np.zeros(3))
        assert along @ np.linalg.inv(information) @ along == pytest.approx(
            UNKNOWN_LENGTH_SIGMA**2, rel=1e-2)
        assert np.linalg.eigvalsh(information)[1] > 1


def test_failed_frame_is_bridged_without_a_vertex(tmp_path):
    graph = read_results(replayed(tmp_path / 'results', Drive(black=[2])))
    assert len(graph.poses) == FRAMES - 1
    assert [(edge.source, edge.target, edge.kind) for edge in graph.edges] == [
        (i, i + 1, 'odometry') for i in range(FRAMES - 2)]


@pytest.mark.slow
def test_repeated_stamps_after_a_reset_get_their_own_motions(tmp_path):
    """As those of a simulation that is reset: what was first is not what came second."""
    # Less of a step back would be taken for late images.
    runs = Drive(gaps=[4]), Drive(black=[2], gaps=[4], step=np.linalg.inv(STEP))

    class Both(Drive):

        def messages(self, topics=None):
            for run in runs:
                yield from run.messages(topics)

    alone = [read_results(replayed(tmp_path / str(i), run)) for i, run in enumerate(runs)]
    both = read_results(replayed(tmp_path / 'both', Both()))
    assert len(both.poses) == len(alone[0].poses) + len(alone[1].poses)
    edges, expected = ([edge for graph in graphs for edge in graph.edges
                        if edge.kind == 'odometry'] for graphs in ([both], alone))
    for edge, one in zip(edges, expected, strict=True):
        assert np.array_equal(edge.motion, one.motion)
        assert np.array_equal(edge.covariance, one.covariance)


def test_time_gap_is_an_edge_with_unknown_motion(tmp_path):
    graph = read_results(replayed(tmp_path / 'results', Drive(gaps=[3])))
    assert [edge.kind for edge in graph.edges] == ['odometry', 'odometry', 'unknown', 'odometry']
    assert [(edge.source, edge.target) for edge in graph.edges] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert np.array_equal(graph.edges[2].covariance, UNKNOWN_MOTION)
    assert graph.edges[2].information().max() < 1


def test_other_folders_and_damaged_results_are_refused(results, tmp_path):
    with pytest.raises(DjetError, match='is not a results folder'):
        read_results(tmp_path)
    for name, damage, error_text in (
            ('frames.csv', lambda text: text.replace('OK', 'SPLENDID', 1), 'line 3'),
            ('frames.csv', lambda text: f'{text}0,"{"x" * 200_000}\n', 'larger than field limit'),
            ('frames.csv', lambda text: text.replace('1100000000', '1100000001'), 'same run'),
            ('trajectory_tum.txt', lambda text: 'x' + text, 'not a number')):
        folder = tmp_path / f'damaged {error_text}'
        shutil.copytree(results, folder)
        file = folder / name
        file.write_text(damage(file.read_text()))
        with pytest.raises(DjetError, match=error_text):
            read_results(folder)


# Information matrices

def test_information_is_the_inverse_covariance_in_the_target_frame():
    """By sampling: errors in ROS's sense, as g2o and GTSAM see them."""
    graph = random_graph(1)
    edge = replace(graph.edges[0], covariance=graph.edges[0].covariance * 1e-6)
    rng = np.random.default_rng(0)
    errors = []
    for sample in rng.multivariate_normal(np.zeros(6), edge.covariance, 20_000):
        wrong = edge.motion.copy()
        wrong[:3, 3] += sample[:3]
        wrong[:3, :3] = rotation_exp(sample[3:]) @ wrong[:3, :3]
        delta = np.linalg.inv(edge.motion) @ wrong
        errors.append([*delta[:3, 3], delta[2, 1], delta[0, 2], delta[1, 0]])
    white = np.linalg.cholesky(edge.information()).T @ np.transpose(errors)
    assert np.abs(np.cov(white) - np.eye(6)).max() < 0.05


@pytest.mark.parametrize(('spoil', 'error_text'), [
    (lambda C: C * np.nan, 'is not a finite 6x6 matrix'),
    (lambda C: np.zeros((6, 6)), 'has the variance 0'),
    (lambda C: -C, 'has the variance -'),
    (lambda C: C + np.triu(C, 1), 'is not symmetric'),
    (lambda C: np.ones((6, 6)), 'is singular'),
    (lambda C: np.diag([1e-300, 1, 1, 1, 1, 1]), 'is singular'),
    (lambda C: np.diag([1, 1, 1, 1e-17, 1, 1]), 'is singular'),
    (lambda C: np.eye(6) * 3 - 1, 'has a negative eigenvalue'),
    (lambda C: C[:5, :5], 'is not a finite 6x6 matrix')])
def test_singular_covariance_is_refused_with_the_edge_name(
        spoil, error_text, tmp_path):
    graph = random_graph(2)
    bad = replace(graph.edges[4], covariance=spoil(graph.edges[4].covariance))
    graph = replace(graph, edges=(*graph.edges[:4], bad, *graph.edges[5:]))
    for kind in ('g2o', 'csv'):
        with pytest.raises(DjetError, match=r'edge 4 -> 5 \(1400000000 ns') as refused:
            write_graph(graph, tmp_path / 'graph', kind)
        assert error_text in str(refused.value)
    assert not list(tmp_path.iterdir())


def spoilt(results, path, spoil):
    """Results in whose bag the relative pose of the third frame was edited by hand."""
    shutil.copytree(results, path)
    shutil.rmtree(path / 'bag')
    with Bag(results / 'bag') as read, ResultBag(path / 'bag') as written:
        for topic, stamp, message in read.messages():
            if topic == '/vo_node/relative_pose_cov' and stamp == 13 * 10**8:
                covariance = np.array(message.pose.covariance).reshape(6, 6)
                message.pose.covariance = np.asarray(spoil(covariance, message), float).ravel()
            written.write(topic, message, stamp)
    return path


def no_orientation(covariance, message):
    message.pose.pose.orientation.w = message.pose.pose.orientation.y = 0.0
    return covariance


def asymmetric(covariance, message):
    covariance[0, 4] += 0.5 * np.sqrt(covariance[0, 0] * covariance[4, 4])
    return covariance


SPOILT = [(lambda C, _: C * np.nan, 'is not a finite 6x6 matrix'),
          (lambda C, _: np.ones((6, 6)), 'is singular'),
          (lambda C, _: np.zeros((6, 6)), 'has the variance 0'),
          (lambda C, _: np.eye(6) * 3 - 1, 'has a negative eigenvalue'),
          (asymmetric, 'is not symmetric'),
          (no_orientation, 'is not a finite pose')]


@pytest.mark.parametrize(('spoil', 'error_text'), SPOILT)
def test_edited_results_are_refused_with_the_edge_name(
        results, spoil, error_text, tmp_path):
    graph = read_results(spoilt(results, tmp_path / 'spoilt', spoil))
    with pytest.raises(DjetError, match=r'odometry edge 1 -> 2 \(1200000000 ns') as refused:
        graph.check()
    assert error_text in str(refused.value)
    with pytest.raises(DjetError, match='edge 1 -> 2'):
        write_graph(graph, tmp_path / 'graph', 'g2o')


def test_invalid_edge_gives_one_line_and_no_output(results, tmp_path):
    pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    folder, out = spoilt(results, tmp_path / 'spoilt', asymmetric), tmp_path / 'out'
    sequence = write_small_kitti(tmp_path / 'dataset')
    for arguments in (('export', folder, '--output', out),
                      ('slam', folder, '--source', sequence, '--output', tmp_path / 'slam')):
        error_text = djet(*arguments, expect=2).stderr
        assert 'odometry edge 1 -> 2' in error_text
        assert len(error_text.strip().splitlines()) == 1
    assert not out.exists()


def test_results_of_a_killed_replay_give_the_graph_up_to_the_break(results, tmp_path):
    killed, whole = tmp_path / 'killed', read_results(results)
    shutil.copytree(results, killed)
    file, = (killed / 'bag').glob('*.mcap')
    file.write_bytes(file.read_bytes()[:file.stat().st_size * 4 // 10])
    (killed / 'bag' / 'metadata.yaml').unlink()
    with pytest.raises(DjetError, match='cut short'):
        read_results(killed)
    warnings = []
    graph = read_results(killed, warnings.append)
    assert 2 <= len(graph.poses) < FRAMES
    assert np.array_equal(graph.stamps_ns, whole.stamps_ns[:len(graph.poses)])
    assert np.array_equal(graph.poses, whole.poses[:len(graph.poses)])
    assert f'only the first {len(graph.poses)} of {FRAMES} frames are used' in warnings[0]
    done = djet('export', killed, '--output', tmp_path / 'graph.g2o')
    assert done.stderr == f'djet: warning: {warnings[0]}\n'
    assert f'{len(graph.poses)} poses' in done.stdout
    # Of a bag that holds no motion at all there is no graph.
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(DjetError):
        read_results(killed, warnings.append)


# Files

def test_the_files_read_back_to_the_graph(results, tmp_path):
    graph = read_results(results)
    done = djet('export', results, '--format', 'csv', '--output', tmp_path / 'out' / 'graph.csv')
    assert f'{FRAMES} poses, {FRAMES - 1} edges ({FRAMES - 1} odometry)' in done.stdout
    for row, edge in zip(csv.DictReader((tmp_path / 'out' / 'graph.csv').open()), graph.edges,
                         strict=True):
        assert int(row['target_stamp_ns']) == graph.stamps_ns[edge.target]
        assert (row['kind'], row['scale_known']) == ('odometry', '1')
        assert float(row['z']) == edge.motion[2, 3]
        assert float(row['cov_y_rz']) == edge.covariance[1, 5]
    write_graph(graph, tmp_path / 'tum', 'tum')
    stamps, poses = read_tum(tmp_path / 'tum')
    assert np.array_equal(stamps, graph.stamps_ns)
    assert np.allclose(poses, graph.poses, atol=1e-12)
    write_graph(graph, tmp_path / 'kitti', 'kitti')
    assert np.array_equal(np.loadtxt(tmp_path / 'kitti').reshape(-1, 3, 4), graph.poses[:, :3])


def test_exported_covariances_are_inflated_for_correlated_errors(results, tmp_path):
    graph, out = read_results(results), tmp_path / 'chained.csv'
    djet('export', results, '--format', 'csv', '--chained', '--output', out)
    # Errors that agree by 0.25 with those of the next pair, by nine tenths of that with those of
    # the one after it, and so on: the variance of the sum of a thousand, over that of as many
    # independent ones.
    apart = np.abs(np.subtract.outer(np.arange(1000), np.arange(1000)))
    alike = np.where(apart > 0, 0.25 * 0.9**apart, 1.0)
    factor = alike.sum() / 1000
    for row, edge in zip(csv.DictReader(out.open()), graph.edges, strict=True):
        assert float(row['cov_y_rz']) == pytest.approx(factor * edge.covariance[1, 5], rel=0.02)
    unknown = replace(graph.edges[0], kind='unknown')
    assert unknown.inflated() is unknown


def test_export_replaces_nothing_of_the_replay(results, tmp_path):
    shutil.copytree(results, tmp_path / 'results')
    before = {path: path.read_bytes() for path in (tmp_path / 'results').glob('*.*')}
    for name in ('frames.csv', 'errors.csv', 'bag/graph.csv'):
        refused = djet('export', tmp_path / 'results', '--format', 'csv', '--output',
                       tmp_path / 'results' / name, '--overwrite', expect=2).stderr
        assert f"{name}', which belongs to the input; choose another one" in refused
    assert {path: path.read_bytes() for path in (tmp_path / 'results').glob('*.*')} == before
    # Beside them it may lie.
    djet('export', tmp_path / 'results', '--output', tmp_path / 'results' / 'drive.g2o')


def test_export_refuses_to_overwrite_and_warns_of_unknown_scale(
        unscaled, tmp_path):
    out = tmp_path / 'graph.g2o'
    done = djet('export', unscaled, '--output', out)
    assert f'{FRAMES - 1} of unknown scale' in done.stdout
    before = out.read_bytes()
    assert 'exists already' in djet('export', unscaled, '--output', out, expect=2).stderr
    assert out.read_bytes() == before


def test_gtsam_reads_the_poses_and_edges_of_a_g2o_file(tmp_path):
    gtsam = pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    graph = random_graph(5)
    write_graph(graph, tmp_path / 'graph.g2o', 'g2o')
    factors, values = gtsam.readG2o(str(tmp_path / 'graph.g2o'), True)
    assert (factors.size(), values.size()) == (len(graph.edges), len(graph.poses))
    for key, true in enumerate(graph.poses):
        assert np.allclose(values.atPose3(key).matrix(), true, atol=1e-12)
    for i, edge in enumerate(graph.edges):
        # the error of an edge, by hand and to second order of what the poses are off
        factor = factors.at(i)
        small = np.full(6, 1e-4)
        off = gtsam.Values()
        off.insert(edge.source, gtsam.Pose3())
        off.insert(edge.target, gtsam.Pose3(edge.motion).retract(np.roll(small, 3)))
        assert factor.error(off) == pytest.approx(
            small @ edge.information() @ small / 2, rel=1e-2)


def test_a_g2o_file_has_the_same_errors_as_the_graph_has_in_gtsam(results, unscaled, tmp_path):
    gtsam = pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    from djet_ros.posegraph.backend import factor_graph, initial_values
    graphs = [random_graph(seed) for seed in range(5)]
    for i, graph in enumerate([*graphs, read_results(results), read_results(unscaled)]):
        write_graph(graph, tmp_path / f'{i}.g2o', 'g2o')
        read, _ = gtsam.readG2o(str(tmp_path / f'{i}.g2o'), True)
        wrong = initial_values(graph.poses @ STEP @ graph.poses)
        ours = factor_graph(graph)
        errors = [ours.at(k + 1).error(wrong) for k in range(len(graph.edges))]
        assert np.allclose([read.at(k).error(wrong) for k in range(read.size())], errors,
                           rtol=1e-6)
        assert max(errors) > 1


def test_the_errors_stay_the_same_through_a_file_that_gtsam_writes(tmp_path):
    """For graphs with similar sigmas: GTSAM writes six digits, too few for unknown lengths."""
    gtsam = pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    for seed in range(5):
        graph, path = random_graph(seed), tmp_path / f'{seed}.g2o'
        write_graph(graph, path, 'g2o')
        factors, values = gtsam.readG2o(str(path), True)
        gtsam.writeG2o(factors, values, str(path))
        again, poses = gtsam.readG2o(str(path), True)
        assert again.error(poses) == pytest.approx(factors.error(values), rel=1e-3)


def test_consistent_graph_has_zero_error(tmp_path):
    gtsam = pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    write_graph(exact_graph(), tmp_path / 'graph.g2o', 'g2o')
    factors, values = gtsam.readG2o(str(tmp_path / 'graph.g2o'), True)
    assert factors.error(values) < 1e-18


def g2o_errors(path):
    """
    Weighted squared errors of the edges of a file, as g2o defines them.

    Its EdgeSE3 takes the translation and the vector part of the quaternion of Z^-1 X_i^-1 X_j.
    """
    def motion(numbers):
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
        return result

    rows = [(arguments[0], np.array(arguments[1:], float))
            for arguments in map(str.split, path.read_text().splitlines())]
    poses = {row[0]: motion(row[1:]) for kind, row in rows if kind == 'VERTEX_SE3:QUAT'}
    errors = {}
    for kind, row in rows:
        if kind == 'EDGE_SE3:QUAT':
            off = np.linalg.inv(poses[row[0]] @ motion(row[2:9])) @ poses[row[1]]
            error = np.append(off[:3, 3], Rotation.from_matrix(off[:3, :3]).as_quat(
                canonical=True)[:3])
            information = np.zeros((6, 6))
            information[np.triu_indices(6)] = row[9:]
            information += np.triu(information, 1).T
            errors[int(row[0]), int(row[1])] = error @ information @ error
    return errors


@pytest.mark.parametrize(('part', 'weight'), [(slice(0, 3), 1.0), (slice(3, 6), 0.25)])
def test_g2o_weighs_translations_as_gtsam_does_and_rotations_a_quarter_as_much(
        part, weight, tmp_path):
    graph, small = exact_graph(), np.zeros(6)
    small[part] = 1e-3, -2e-3, 1e-3
    off = np.eye(4)
    off[:3, 3], off[:3, :3] = small[:3], rotation_exp(small[3:])
    edge = graph.edges[0]
    poses = graph.poses.copy()
    poses[edge.target] = poses[edge.target] @ off
    write_graph(replace(graph, poses=poses), tmp_path / 'graph.g2o', 'g2o')
    assert g2o_errors(tmp_path / 'graph.g2o')[edge.source, edge.target] == pytest.approx(
        weight * small @ edge.information() @ small, rel=1e-4)


def test_g2o_itself_reads_the_file_and_finds_the_same_errors(results, unscaled, tmp_path):
    g2opy = pytest.importorskip('g2opy', reason='g2o is not installed: pip install g2opy')
    for i, graph in enumerate([random_graph(7), read_results(results), read_results(unscaled)]):
        path = tmp_path / f'{i}.g2o'
        write_graph(replace(graph, poses=graph.poses @ STEP @ graph.poses), path, 'g2o')
        optimizer = g2opy.SparseOptimizer()
        assert optimizer.load(str(path))
        assert len(optimizer.vertices()) == len(graph.poses)
        optimizer.initialize_optimization()
        optimizer.compute_active_errors()
        found = {tuple(vertex.id() for vertex in edge.vertices()): edge.chi2()
                 for edge in optimizer.edges()}
        assert found == pytest.approx(g2o_errors(path), rel=1e-6)
