"""
Measures what doc/results.md and the README's table show, and writes it as JSON.

Every figure is made by commands that a reader can run, ``djet lab evaluate`` above all. Rendered
scenes are taken with several seeds; real frames are those of $DJET_DATA, if it is set. A run that
was broken off is taken up where it ended; one of other settings, or of other code, begins anew.

    python doc/measure.py --frames 21 --seeds 0,1,2,3,4 --workers 2
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import as_completed, ThreadPoolExecutor
import csv
from dataclasses import dataclass
from functools import partial
import hashlib
from importlib.metadata import PackageNotFoundError, version
import json
import os
from pathlib import Path
import platform
import subprocess
import sys
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import djet_ros
from djet_ros.lab.scenes import SCENES
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / 'doc' / 'results.json'
LIBRARIES = ('numpy', 'scipy', 'opencv-python-headless', 'poselib')
DJET = (sys.executable, '-c', 'import sys; from djet_ros.cli.main import main; sys.exit(main())')
LAB = ('lab',)

# An odometry cannot live with these, in degrees: see djet lab evaluate.
GROSS_ROTATION, GROSS_DIRECTION = 1.0, 10.0
# The paper's own parameters are compared between its two methods only.
PAPER_METHODS = 'djet,rpe'
CLOSURE_FRAMES = 150
ABLATED = 51
BENCH_PAIRS = 40

Row = dict[str, str]


@dataclass(frozen=True)
class Job:
    """
    Sequences that are measured together.

    name: what pages call them; seeds: those of a rendered scene, or none; folder: of real frames;
    frames: how many are used (None: all); cost: a guess of the work, to begin with the longest.
    """

    name: str
    seeds: tuple[int, ...]
    folder: Path | None
    frames: int | None
    cost: int


def main() -> int:
    args = arguments()
    settings = {'frames': args.frames, 'seeds': list(args.seeds),
                'real_frames': args.real_frames, 'code': digest_of_the_code()}
    results = begun(args.output, settings)
    failed = False
    with ThreadPoolExecutor(args.workers) as pool:
        running = {pool.submit(work): name for name, work in missing(results, args)}
        for future in as_completed(running):
            name = running[future]
            try:
                results['parts'][name] = future.result()
            except CommandFailed as error:
                print(f'{name}: {error}', file=sys.stderr, flush=True)
                failed = True
                continue
            write(args.output, results)
            print(f"{name}: {results['parts'][name]['seconds']:.0f} s", flush=True)
    if failed or args.only:
        return int(failed)
    if 'speed' not in results['parts']:
        # Alone on the machine, as far as that is in our hands.
        results['parts']['speed'] = speed(args.data)
    results['complete'] = True
    write(args.output, results)
    return 0


class CommandFailed(Exception):
    """A command ended with an error, which is what this says."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--frames', type=int, default=21, help='of each rendered scene and seed')
    parser.add_argument('--real-frames', type=int, help='of each real sequence (default: all)')
    parser.add_argument('--seeds', default=(0, 1, 2, 3, 4),
                        type=lambda text: tuple(int(word) for word in text.split(',')))
    parser.add_argument('--only', type=lambda text: text.split(','), metavar='NAMES',
                        help='measure these parts alone, such as road,underwater')
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    parser.add_argument('--output', type=Path, default=OUTPUT)
    data = os.environ.get('DJET_DATA')
    parser.add_argument('--data', type=Path, default=data and Path(data),
                        help='folder of real sequences (default: $DJET_DATA)')
    return parser.parse_args()


def digest_of_the_code() -> str:
    """Tell one state of the package from another."""
    digest = hashlib.sha256()
    folder = Path(djet_ros.__file__).parent
    for path in sorted(folder.rglob('*.py')):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def begun(output: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Give the unfinished results of an earlier run with these settings, or empty ones."""
    if output.exists():
        earlier: dict[str, Any] = json.loads(output.read_text())
        if not earlier['complete'] and earlier['settings'] == settings:
            return earlier
    return {'complete': False, 'settings': settings, 'versions': versions(),
            'cores': os.cpu_count(), 'parts': {}}


def versions() -> dict[str, str]:
    found = {'djet_ros': djet_ros.__version__, 'python': platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = 'not installed'
    return found


def write(output: Path, results: dict[str, Any]) -> None:
    """Write all that is known so far, whole or not at all."""
    ordered = {**results, 'parts': dict(sorted(results['parts'].items(), key=place))}
    beside = output.with_suffix('.part')
    beside.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + '\n')
    beside.replace(output)


def place(item: tuple[str, Any]) -> tuple[bool, int, str]:
    """Say where a part stands: scenes in the order of the catalogue, then the rest."""
    names = list(SCENES)
    known = item[0] in names
    return not known, names.index(item[0]) if known else 0, item[0]


def missing(results: dict[str, Any], args: argparse.Namespace
            ) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Give the parts that are wanted and not measured yet, the longest first."""
    jobs = [Job(name, args.seeds, None, args.frames, args.frames * len(args.seeds))
            for name in SCENES]
    for folder in real_sequences(args.data):
        frames = len([*folder.glob('image_0/*'), *folder.glob('rgb/*')])
        used = min(frames, args.real_frames or frames)
        jobs.append(Job(title(folder), (), folder, args.real_frames, used))
    for job in sorted(jobs, key=lambda job: -job.cost):
        if wanted(job.name, results, args):
            yield job.name, partial(measured, job)
    if wanted('ablation', results, args):
        yield 'ablation', partial(ablation, args.data)


def wanted(name: str, results: dict[str, Any], args: argparse.Namespace) -> bool:
    return name not in results['parts'] and (not args.only or name in args.only)


def real_sequences(data: Path | None) -> list[Path]:
    """Folders in the layouts of KITTI and TUM below the folder of real data."""
    if data is None:
        return []
    return sorted([*(path.parent for path in data.glob('*/sequences/*/calib.txt')),
                   *(path.parent for path in data.glob('*/*/rgb.txt'))])


def title(folder: Path) -> str:
    """Name of a real sequence: its data set and its own."""
    data_set = folder.parent.parent if folder.parent.name == 'sequences' else folder.parent
    return f'{data_set.name} {folder.name}'


def djet(*words: object) -> None:
    """Run a command; its last words are the error if it fails."""
    done = subprocess.run([*DJET, *map(str, words)], capture_output=True, text=True, check=False,
                          env={**os.environ, 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'})
    if done.returncode:
        raise CommandFailed(f'djet {" ".join(map(str, words))}: {done.stderr.strip()[-500:]}')


def measured(job: Job) -> dict[str, Any]:
    """Measure one job with every method, as an odometry, and by its triangles."""
    started = perf_counter()
    with TemporaryDirectory() as name:
        place = Path(name)
        folders = [job.folder] if job.folder else list(rendered(job, place))
        end = ('--end', job.frames) if job.frames else ()
        djet(*LAB, 'evaluate', *folders, '--output', place / 'best', '--presets', 'best',
             '--workers', 1, *end)
        djet(*LAB, 'evaluate', *folders, '--output', place / 'paper', '--presets', 'paper',
             '--methods', PAPER_METHODS, '--workers', 1, *end)
        found = {'seeds': list(job.seeds),
                 'methods': [*by_method(place / 'best'), *by_method(place / 'paper')],
                 'odometry': odometry(folders, place),
                 'closure': closure(folders[0], place, job.frames)}
    return {'seconds': rounded(perf_counter() - started), **found}


def rendered(job: Job, place: Path) -> Iterator[Path]:
    """Render a scene with each seed; gives the sequences' folders."""
    for seed in job.seeds:
        out = place / f'seed{seed}'
        djet(*LAB, 'render', job.name, out, '--seed', seed, '--frames', job.frames)
        folder, = out.glob('sequences/*')
        yield folder


def by_method(folder: Path) -> list[dict[str, Any]]:
    """Sum up an evaluation by method, over all of its sequences."""
    times = read_csv(folder / 'timings.csv')
    groups: dict[tuple[str, str], list[Row]] = {}
    for row, time in zip(read_csv(folder / 'pairs.csv'), times, strict=True):
        groups.setdefault((row['method'], row['preset']), []).append({**row, **time})
    return [{'method': method, 'preset': preset, **summed(rows),
             'ms': rounded(np.median([float(row['milliseconds']) for row in rows]))}
            for (method, preset), rows in groups.items()]


def summed(rows: list[Row]) -> dict[str, Any]:
    """
    Sum up rows of pairs.

    failed: as djet lab evaluate counts; sure: how many of these called themselves OK; by_seed:
    mean errors and failures of each sequence.
    """
    sequences: dict[str, list[Row]] = {}
    for row in rows:
        sequences.setdefault(row['sequence'], []).append(row)
    return {'pairs': len(rows), 'failed': failures(rows),
            'sure': sum(row['failed'] == '1' and row['status'] == 'OK' for row in rows),
            'rotation': spread(errors(rows, 'rotation')),
            'direction': spread(errors(rows, 'translation')),
            'by_seed': [{'rotation': mean(errors(one, 'rotation')),
                         'direction': mean(errors(one, 'translation')), 'failed': failures(one)}
                        for one in sequences.values()]}


def failures(rows: Iterable[Row]) -> int:
    return sum(row['failed'] == '1' for row in rows)


def errors(rows: Iterable[Row], what: str) -> list[float]:
    """Give the errors in degrees that are known."""
    return [float(row[f'{what}_error_deg']) for row in rows if row[f'{what}_error_deg']]


def spread(values: list[float]) -> dict[str, float | None]:
    if not values:
        return dict.fromkeys(('mean', 'median', 'p95', 'max'))
    return {'mean': mean(values), 'median': rounded(np.median(values)),
            'p95': rounded(np.percentile(values, 95)), 'max': rounded(max(values))}


def mean(values: list[float]) -> float | None:
    return rounded(np.mean(values)) if values else None


def odometry(folders: Iterable[Path], place: Path) -> dict[str, Any]:
    """
    Sum up replays: pairs in their order, each with the motion before it as a start.

    Whole sequences are replayed; rendered ones have no more frames than are wanted.
    """
    rows: list[Row] = []
    for index, folder in enumerate(folders):
        output = place / f'replay{index}'
        djet('replay', folder, '--output', output)
        rows += [{**row, 'sequence': str(index), 'failed': str(int(gross(row)))}
                 for row in read_csv(output / 'errors.csv')]
    return summed(rows)


def gross(row: Row) -> bool:
    """Tell whether a row of errors.csv is of no use."""
    rotation, direction = row['rotation_error_deg'], row['translation_error_deg']
    return (not rotation or float(rotation) > GROSS_ROTATION
            or bool(direction and float(direction) > GROSS_DIRECTION))


def closure(folder: Path, place: Path, frames: int | None) -> dict[str, Any]:
    """Triangles of three frames of one sequence: what they leave, and what was claimed."""
    output = place / 'closure.json'
    djet(*LAB, 'closure', folder, '--output', output, '--frames',
         min(frames or CLOSURE_FRAMES, CLOSURE_FRAMES))
    summary: dict[str, dict[str, float]] = json.loads(output.read_text())['summary']
    return {method: {name: rounded(value) for name, value in one.items()}
            for method, one in summary.items()}


def ablation(data: Path | None) -> dict[str, Any]:
    """Measure variants of D-JET on KITTI's frames, or on a street if there are none."""
    started = perf_counter()
    with TemporaryDirectory() as name:
        place = Path(name)
        folders = kitti_or_street(data, place)
        djet(*LAB, 'ablate', *folders, '--output', place / 'ablation', '--presets', 'best',
             '--end', ABLATED, '--workers', 1)
        found = {'of': [title(folder) for folder in folders], 'frames': ABLATED,
                 'variants': variants(place / 'ablation')}
    return {'seconds': rounded(perf_counter() - started), **found}


def speed(data: Path | None) -> dict[str, Any]:
    """Measure the time of a pair against OpenCV's plain chain."""
    started = perf_counter()
    with TemporaryDirectory() as name:
        place = Path(name)
        folder = kitti_or_street(data, place)[0]
        djet(*LAB, 'bench', folder, '--output', place / 'bench.json', '--pairs', BENCH_PAIRS)
        found = {'of': title(folder), **json.loads((place / 'bench.json').read_text())}
    return {'seconds': rounded(perf_counter() - started), **found}


def kitti_or_street(data: Path | None, place: Path) -> list[Path]:
    """Folders of KITTI's sequences, or of a rendered street."""
    real = [folder for folder in real_sequences(data) if title(folder).startswith('kitti')]
    return real or list(rendered(Job('road', (0,), None, ABLATED, 0), place))


def variants(folder: Path) -> list[dict[str, Any]]:
    """Rows of an ablation over all of its sequences."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in read_csv(folder / 'pairs.csv'):
        groups.setdefault((row['method'], row['change']), []).append(row)
    return [{'method': method, 'change': change, **summed(rows)}
            for (method, change), rows in groups.items()]


def read_csv(path: Path) -> list[Row]:
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def rounded(value: Any) -> float | None:
    """Four digits that mean something; None for what is not known."""
    return float(f'{value:.4g}') if np.isfinite(value) else None


if __name__ == '__main__':
    sys.exit(main())
