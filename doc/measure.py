"""
Measures the figures of doc/results.md and of the README, and writes them as JSON.

Rendered scenes use several seeds; real frames are those of $DJET_DATA, if it is set. An
interrupted run is resumed; with other settings, code or libraries the measurement starts again.
With --only, parts are added to existing results, which must have the same settings.

    python doc/measure.py --frames 21 --seeds 0,1,2,3,4 --workers 2
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import closing
from dataclasses import astuple, dataclass
from functools import partial
import json
import os
from pathlib import Path
import platform
import sys
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import djet_ros
from djet_ros.config.flat import from_flat
from djet_ros.config.sections import Config
from djet_ros.core.estimator_config import preset
from djet_ros.core.types import Status
from djet_ros.errors import DjetError
from djet_ros.lab.ablation import ablation_methods, PARTS, ratios_to_base
from djet_ros.lab.bench import bench
from djet_ros.lab.closure import closures, summary, Triangle
from djet_ros.lab.coverage import normalised_square
from djet_ros.lab.integration import estimated_trajectory, true_trajectory
from djet_ros.lab.lens import examine
from djet_ros.lab.methods import default_methods, make_methods, Method
from djet_ros.lab.pairs import evaluate_chunk, has_failed, PairChunk, PairRecord
from djet_ros.lab.provenance import code_digest
from djet_ros.lab.provenance import versions as versions_of
from djet_ros.lab.runner import local_workers
from djet_ros.lab.scenes import render_sequence, SCENES
from djet_ros.lab.sequences import Dataset, open_datasets, opened, Selection
from djet_ros.lab.summary import common_errors
from djet_ros.odometry.result import camera_motion
from djet_ros.odometry.visual_odometry import VisualOdometry
from djet_ros.recordings.bag_writers import write_kitti_bag
from djet_ros.recordings.kitti import KittiSequence
from djet_ros.recordings.outputs import write_whole
from djet_ros.recordings.recording import open_recording, SequenceRecording
from djet_ros.replay.drift import drift
from djet_ros.replay.pair_errors import motion_errors
from djet_ros.replay.replay import Replay
from djet_ros.replay.results import ResultsFolder
import numpy as np
from scipy.stats import chi2

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / 'doc' / 'results.json'
LIBRARIES = ('numpy', 'scipy', 'opencv-python-headless', 'poselib')

# The columns of the paper's Table 1.
PAPER_METHODS = ('djet', 'rpe', 'pjet', 'five_point')
# Methods compared with D-JET on the pairs that both estimated, and the preset.
AGAINST = (('rpe', 'best'), ('rpe', 'paper'), ('pjet', 'best'))
CLOSED = ('djet', 'pjet', 'rpe')
CLOSURE_FRAMES = 150
ABLATED = ('road', 'indoor', 'handheld', 'forest')
ABLATED_FRAMES, ABLATED_SEEDS = 7, 3
ABLATED_WINDOWS = (3, 5, 7, 15)
# Methods whose pairs are chained over whole drives.
CHAINED = ('djet', 'rpe', 'poselib', 'sift_poselib', 'klt_poselib')
# Metres; shorter drives have no drift by KITTI's definition.
DRIVE = 100.0
# How drives are replayed; the camera height is KITTI's published one.
ALONE = 'images alone'
REPLAYED = {ALONE: {},
            '`camera_height`': {'odometry.scale': 'camera_height', 'odometry.camera_height': 1.65}}
# First frames of replays: the error of a drive is a draw, which each small change makes anew.
STARTS = range(5)
# Parameter that corrects the estimated distortion, and offsets from the estimate that are replayed
# too, in standard errors.
RESIDUAL = 'odometry.residual_k1'
BESIDE = (-2, -1, 1, 2)
BENCH_PAIRS = 40
# Bound of the NEES that a consistent covariance of five degrees of freedom exceeds in one pair of
# a thousand.
BOUND_999 = float(chi2.ppf(0.999, 5))


@dataclass(frozen=True)
class Job:
    """
    Sequences that are measured together.

    name: as in results.json; seeds: of a rendered scene, else empty; folder: of real frames, else
    None; frames: how many are used (None: all); cost: estimate of the work, to start the longest
    first.
    """

    name: str
    seeds: tuple[int, ...]
    folder: Path | None
    frames: int | None
    cost: int


@dataclass(frozen=True)
class Outcome:
    """
    The result of a pair.

    sequence: its name; rotation, direction: errors in degrees, NaN if there is none; failed: as
    counted by djet lab evaluate; surprise: NEES, NaN if there is no direction.
    """

    sequence: str
    status: str
    rotation: float
    direction: float
    failed: bool
    surprise: float = float('nan')


def main() -> int:
    args = arguments()
    settings = {'frames': args.frames, 'seeds': list(args.seeds), 'real_frames': args.real_frames,
                'code': code_digest([Path(__file__)])}
    try:
        results = previous_results(args.output, settings, keep=bool(args.only))
    except DjetError as error:
        print(f'measure.py: {error}', file=sys.stderr)
        return 2
    failed = False
    with local_workers(args.workers) as pool:
        running = {pool.submit(work): name for name, work in pending_parts(results, args)}
        for future in as_completed(running):
            name = running[future]
            try:
                results['parts'][name] = future.result()
            except DjetError as error:
                print(f'{name}: {error}', file=sys.stderr, flush=True)
                failed = True
                continue
            write(args.output, results)
            print(f"{name}: {results['parts'][name]['seconds']:.0f} s", flush=True)
    if failed or args.only:
        return int(failed)
    if 'speed' not in results['parts']:
        # After all other parts, so that nothing of ours runs at the same time.
        results['parts']['speed'] = speed(args.data)
    results['complete'] = True
    write(args.output, results)
    return 0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=str(__doc__).split('\n\n')[0])
    parser.add_argument('--frames', type=int, default=21, metavar='N',
                        help='of each rendered scene and seed (default: %(default)s)')
    parser.add_argument('--real-frames', type=int, metavar='N',
                        help='of each real sequence (default: all)')
    parser.add_argument('--seeds', default=(0, 1, 2, 3, 4), metavar='LIST',
                        type=lambda text: tuple(int(word) for word in text.split(',')),
                        help='of each rendered scene (default: 0,1,2,3,4)')
    parser.add_argument('--only', type=lambda text: text.split(','), metavar='NAMES',
                        help='measure these parts alone, such as road,underwater')
    parser.add_argument('--workers', type=int, metavar='N',
                        help='processes (default: one for each core)')
    parser.add_argument('--output', type=Path, default=OUTPUT, metavar='FILE')
    data = os.environ.get('DJET_DATA')
    parser.add_argument('--data', type=Path, default=Path(data) if data else None, metavar='DIR',
                        help='folder of real sequences (default: $DJET_DATA)')
    return parser.parse_args()


def previous_results(output: Path, settings: dict[str, Any], *, keep: bool = False
                     ) -> dict[str, Any]:
    """
    Return the unfinished results of an earlier run with these settings, or empty ones.

    keep: return finished ones too, and raise DjetError if the existing ones have other settings,
    so that nothing is lost.
    """
    libraries = versions()
    new = {'complete': False, 'settings': settings, 'versions': libraries,
           'cores': os.cpu_count(), 'parts': {}}
    if not output.exists():
        return new
    earlier: dict[str, Any] = json.loads(output.read_text('utf-8'))
    same = {**settings, **libraries}
    before = {**earlier['settings'], **earlier['versions']}
    other = [name for name in same if before.get(name) != same[name]]
    if keep and other:
        raise DjetError(f'{output} holds results of other settings ({", ".join(other)}); measure '
                        'all, or name another file by --output')
    return new if other or (earlier['complete'] and not keep) else earlier


def versions() -> dict[str, str]:
    return {'djet_ros': djet_ros.__version__, 'python': platform.python_version(),
            **versions_of(LIBRARIES)}


def write(output: Path, results: dict[str, Any]) -> None:
    """Write the results so far, atomically."""
    ordered = {**results, 'parts': dict(sorted(results['parts'].items(), key=sort_key))}
    write_whole(output, json.dumps(ordered, indent=1, ensure_ascii=False) + '\n')


def sort_key(item: tuple[str, Any]) -> tuple[bool, int, str]:
    """Return the sort key of a part: scenes in the order of the catalogue, then the rest."""
    names = list(SCENES)
    known = item[0] in names
    return not known, names.index(item[0]) if known else 0, item[0]


# What is measured


def pending_parts(results: dict[str, Any], args: argparse.Namespace
                  ) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Yield the parts that are requested and not measured yet, the longest first."""
    jobs = [Job(name, args.seeds, None, args.frames, args.frames * len(args.seeds))
            for name in SCENES]
    for folder in real_sequences(args.data):
        frames = len([*folder.glob('image_0/*'), *folder.glob('rgb/*')])
        used = min(frames, args.real_frames or frames)
        jobs.append(Job(title(folder), (), folder, args.real_frames, used))
    work: dict[str, Callable[[], dict[str, Any]]] = {
        f'drive {title(folder)}': partial(drive, folder) for folder in kitti(args.data)
        if length(folder) > DRIVE}
    work['ablation'] = partial(ablation, args.seeds[:ABLATED_SEEDS])
    work |= {job.name: partial(measured, job) for job in sorted(jobs, key=lambda job: -job.cost)}
    for name, action in work.items():
        if name not in results['parts'] and (not args.only or name in args.only):
            yield name, action


def real_sequences(data: Path | None) -> list[Path]:
    """Return the folders in the layouts of KITTI and TUM below the folder of real data."""
    if data is None:
        return []
    return sorted([*(path.parent for path in data.glob('*/sequences/*/calib.txt')),
                   *(path.parent for path in data.glob('*/*/rgb.txt'))])


def title(folder: Path) -> str:
    """Return the name of a real sequence, with its dataset."""
    data_set = folder.parent.parent if folder.parent.name == 'sequences' else folder.parent
    return f'{data_set.name} {folder.name}'


def measured(job: Job) -> dict[str, Any]:
    """Measure one job: every method, the odometry, and rotation closure."""
    started = perf_counter()
    with TemporaryDirectory() as name:
        datasets = opened_for(job, Path(name))
        methods = [*make_methods(default_methods(), ['best'], {}),
                   *make_methods(['djet'], ['fast'], {}),
                   *make_methods(PAPER_METHODS, ['paper'], {})]
        records = estimated(datasets, methods)
        found = {'seeds': list(job.seeds), 'methods': by_method(datasets, methods, records),
                 'against': [against(records, *other) for other in AGAINST],
                 'odometry': odometry(datasets), 'closure': closure_figures(datasets)}
    return {'seconds': rounded(perf_counter() - started), **found}


def opened_for(job: Job, place: Path) -> list[Dataset]:
    """Open real frames, or render a scene with each seed."""
    folders = [job.folder] if job.folder else [
        render_sequence(job.name, place / f'seed{seed}', job.frames, seed) for seed in job.seeds]
    return open_datasets(folders, Selection(end=job.frames), place)


def ratios(records: Sequence[PairRecord], base: Sequence[PairRecord]) -> dict[str, Any]:
    """Return the ratios of errors to those of `base` on the same pairs, with intervals."""
    return {'ratio': {what: {kind: [rounded(value) for value in astuple(one)]
                             for kind, one in by_kind.items()}
                      for what, by_kind in ratios_to_base(records, base).items()}}


def estimated(datasets: Sequence[Dataset], methods: Sequence[Method]) -> list[PairRecord]:
    """Estimate all pairs, independently."""
    return [record for dataset in datasets
            for record in evaluate_chunk(PairChunk(dataset, 0, dataset.pairs), methods)]


def by_method(datasets: Sequence[Dataset], methods: Sequence[Method],
              records: Sequence[PairRecord], *, compared: bool = False) -> list[dict[str, Any]]:
    """
    Summarise the records of all pairs by method; hamming: in bits, over the inliers of pairs.

    compared: add the ratios to the first method.
    """
    found: list[dict[str, Any]] = []
    base: list[PairRecord] = []
    for method in methods:
        own = [record for record in records if (record.method, record.preset, record.change)
               == (method.name, method.preset, method.change)]
        base = base or own
        outcomes = [Outcome(record.sequence, record.status, record.rotation_error_deg,
                            record.translation_error_deg, record.failed) for record in own]
        found.append({'method': method.name, 'preset': method.preset, 'change': method.change,
                      **summarised(outcomes),
                      'hamming': statistics([record.hamming_mean for record in own])['mean'],
                      'ms': rounded(np.median([record.milliseconds for record in own])),
                      **drifts(datasets, own), **(ratios(own, base) if compared else {})})
    return found


def against(records: Sequence[PairRecord], other: str, preset: str) -> dict[str, Any]:
    """
    Compare D-JET with another method on the pairs that both estimated.

    Figures are [D-JET's, the other's].
    """
    ours, theirs = ([one for one in records if (one.method, one.preset) == (method, preset)]
                    for method in ('djet', other))
    found: dict[str, Any] = {'other': other, 'preset': preset}
    for what, errors in common_errors(ours, theirs).items():
        both = [statistics(column) for column in errors.T]
        found[what] = {kind: [one[kind] for one in both] for kind in ('mean', 'median')}
        found[what]['told'] = both[0]['told']
    return found


def closure_figures(datasets: Sequence[Dataset]) -> dict[str, Any]:
    """Summarise the rotation closure of the first frames of all sequences by method."""
    triangles: dict[str, list[Triangle | None]] = {method: [] for method in CLOSED}
    for dataset in datasets:
        frames = min(dataset.pairs + 1, CLOSURE_FRAMES)
        for method, some in closures(opened(dataset), CLOSED, frames).items():
            triangles[method] += some
    return {method: rounded_figures(summary(some)) for method, some in triangles.items()}


def drifts(datasets: Iterable[Dataset], records: Sequence[PairRecord]) -> dict[str, Any]:
    """Return the mean drift of the chained pairs of one method, if a path is long enough."""
    found = []
    for dataset in datasets:
        own = [record for record in records if record.sequence == dataset.name]
        one = drift(true_trajectory(dataset, own).poses,
                    estimated_trajectory(dataset, own).poses) if own else None
        if one:
            found.append(one)
    if not found:
        return {}
    return {'drift': {
        'translation_percent': rounded(np.mean([one.translation_percent for one in found])),
        'rotation_deg_per_100m': rounded(np.mean([one.rotation_deg_per_100m for one in found])),
        'segments': sum(one.segments for one in found),
        'longest': max(one.longest for one in found)}}


def odometry(datasets: Iterable[Dataset]) -> dict[str, Any]:
    """Summarise the odometry: frames in sequence, with the previous motion as initial pose."""
    outcomes = [outcome for dataset in datasets for outcome in odometry_outcomes(dataset)]
    surprises = np.array([outcome.surprise for outcome in outcomes])
    surprises = surprises[np.isfinite(surprises)]
    return {**summarised(outcomes), 'surprise': {
        'pairs': len(surprises), 'beyond': int((surprises > BOUND_999).sum()),
        **{name: rounded(value(surprises)) if len(surprises) else None
           for name, value in (('mean', np.mean), ('median', np.median))}}}


def odometry_outcomes(dataset: Dataset) -> Iterator[Outcome]:
    """Yield the outcome of each pair of the odometry on a sequence."""
    sequence, tracker = opened(dataset), VisualOdometry(preset('best'))
    assert sequence.poses is not None  # datasets without poses are refused
    stamps = sequence.stamps_ns
    for index in dataset.frames:
        result = tracker.process(sequence.frame(index))
        if result.previous_stamp_ns is None or result.relative is None:
            continue
        previous = sequence.poses[np.searchsorted(stamps, result.previous_stamp_ns)]
        true_motion = np.linalg.inv(previous) @ sequence.poses[index]
        if not np.isfinite(true_motion).all():
            continue
        rotation, direction = motion_errors(result.status, camera_motion(result.relative),
                                            true_motion)
        yield Outcome(dataset.name, result.status.value, rotation, direction,
                      has_failed(rotation, direction, true_motion),
                      normalised_square(result.relative, true_motion) if np.isfinite(direction)
                      else float('nan'))


def drive(folder: Path) -> dict[str, Any]:
    """Measure a whole drive: chained pairs by method, and replays."""
    started = perf_counter()
    with TemporaryDirectory() as name:
        datasets = open_datasets([folder], Selection(), Path(name))
        chained = make_methods(CHAINED, ['best'], {})
        found = {'frames': datasets[0].pairs + 1, 'length': rounded(length(folder)),
                 'chained': by_method(datasets, chained, estimated(datasets, chained)),
                 'replays': {how: replayed(folder, values) for how, values in REPLAYED.items()},
                 **lens(folder)}
    return {'seconds': rounded(perf_counter() - started), **found}


def lens(folder: Path) -> dict[str, Any]:
    """Replay a drive with its estimated distortion corrected, if that is worthwhile."""
    with closing(open_recording(folder)) as recording:
        try:
            report = examine(recording, Config(), lambda: None)
        except DjetError:
            # Too few informative pairs, as on straight roads.
            return {}
    if not report.worth_correcting:
        return {}
    k1, sigma = report.fit.k1, report.fit.sigma
    return {'lens': {
        'k1': rounded(k1), 'sigma': rounded(sigma),
        'replays': {how: replayed(folder, {**values, RESIDUAL: k1})
                    for how, values in REPLAYED.items()},
        'beside': {str(off): replayed(folder, {**REPLAYED[ALONE], RESIDUAL: k1 + off * sigma})
                   for off in BESIDE}}}


def replayed(folder: Path, values: dict[str, Any]) -> list[dict[str, Any]]:
    """Replay a KITTI sequence from STARTS; returns drifts and position errors."""
    return [replayed_once(KittiSequence(folder, start=start), values) for start in STARTS]


def replayed_once(sequence: KittiSequence, values: dict[str, Any]) -> dict[str, Any]:
    config = from_flat(values)
    with TemporaryDirectory() as name, closing(SequenceRecording(sequence)) as recording, \
            ResultsFolder(Path(name) / 'results', config) as results:
        summary = Replay(recording, config, sequence.folder.name).run(results).summary
    return {what: {name: rounded(value) if value is not None else None
                   for name, value in summary[what].items()} for what in ('drift', 'positions')}


def length(folder: Path) -> float:
    """Return the length of a KITTI sequence's true path in metres; 0 if unknown."""
    poses = KittiSequence(folder).poses
    return 0.0 if poses is None else float(
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def ablation(seeds: tuple[int, ...]) -> dict[str, Any]:
    """Measure variants of D-JET on rendered scenes, whose ground truth is exact."""
    started = perf_counter()
    with TemporaryDirectory() as name:
        datasets = [dataset for scene in ABLATED for dataset in opened_for(
            Job(scene, seeds, None, ABLATED_FRAMES, 0), Path(name) / scene)]
        methods = ablation_methods(['best'], PARTS, ABLATED_WINDOWS, {})
        found = {'of': list(ABLATED), 'frames': ABLATED_FRAMES, 'seeds': list(seeds),
                 'variants': by_method(datasets, methods, estimated(datasets, methods),
                                       compared=True)}
    return {'seconds': rounded(perf_counter() - started), **found}


def speed(data: Path | None) -> dict[str, Any]:
    """Measure the time per pair relative to OpenCV's pipeline: of files, a bag, and by hand."""
    started = perf_counter()
    with TemporaryDirectory() as name:
        real = kitti(data)
        tum = [one for one in real_sequences(data) if (one / 'rgb.txt').exists()]
        folder = real[0] if real else render_sequence('road', Path(name), BENCH_PAIRS + 1)
        bag = Path(name) / 'bag'
        write_kitti_bag(KittiSequence(folder), bag)
        sources = {title(folder) if real else 'road': folder, 'the same from a bag': bag,
                   **{title(one): one for one in tum}}
        found = {of: bench(source, BENCH_PAIRS) for of, source in sources.items()}
    return {'seconds': rounded(perf_counter() - started), 'sources': found}


def kitti(data: Path | None) -> list[Path]:
    """Return the folders of KITTI's sequences."""
    return [folder for folder in real_sequences(data) if title(folder).startswith('kitti')]


# Summaries


def summarised(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """
    Summarise the outcomes of pairs.

    sure: how many of the failed pairs have status OK; by_seed: mean errors and failures of each
    sequence.
    """
    sequences: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        sequences.setdefault(outcome.sequence, []).append(outcome)
    return {'pairs': len(outcomes), 'failed': sum(one.failed for one in outcomes),
            'sure': sum(one.failed and one.status == Status.OK.value for one in outcomes),
            'rotation': statistics([one.rotation for one in outcomes]),
            'direction': statistics([one.direction for one in outcomes]),
            'by_seed': [{'rotation': statistics([one.rotation for one in some])['mean'],
                         'direction': statistics([one.direction for one in some])['mean'],
                         'failed': sum(one.failed for one in some)}
                        for some in sequences.values()]}


def statistics(values: Iterable[float]) -> dict[str, Any]:
    """Return mean, median, 95th percentile, maximum and number (told) of the finite values."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return {'told': 0, **dict.fromkeys(('mean', 'median', 'p95', 'max'))}
    return {'told': len(known), 'mean': rounded(known.mean()), 'median': rounded(np.median(known)),
            'p95': rounded(np.percentile(known, 95)), 'max': rounded(known.max())}


def rounded_figures(figures: dict[str, Any]) -> dict[str, float | None]:
    return {name: rounded(value) for name, value in figures.items()}


def rounded(value: Any) -> float | None:
    """Round to four significant digits; None if not finite."""
    return float(f'{value:.4g}') if np.isfinite(value) else None


if __name__ == '__main__':
    sys.exit(main())
