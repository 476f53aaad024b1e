"""``djet lab coverage``: calibration of the covariances of poses."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from functools import partial
from pathlib import Path

from djet_ros.cli.lab.pair_runs import datasets_of
from djet_ros.cli.options import (
    add_frames,
    add_output,
    add_seeds,
    add_workers,
    check_least,
    split,
    write_json,
)
from djet_ros.cli.terminal import compact_table, console, new_table, progress_bar
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import from_flat
from djet_ros.errors import DjetError
from djet_ros.lab.coverage import (
    ALONE,
    cover_chunk,
    Coverage,
    coverage_rows,
    CoverageRow,
    draw_reliability,
    IN_A_ROW,
    LEVELS,
    started_chunks,
    SURE_DIRECTION,
    SURE_ROTATION,
)
from djet_ros.lab.methods import check_names
from djet_ros.lab.pairs import FAILURE
from djet_ros.lab.runner import as_completed, local_workers, run as run_chunks
from djet_ros.lab.scenes import render_sequence, SCENES
from djet_ros.lab.sequences import Dataset
from djet_ros.lab.store import FILE_NAME, RecordStore
from djet_ros.recordings.outputs import check_ours, make_folder
from rich.table import Table

DESCRIPTION = """\
Estimate the relative pose of all consecutive frames, each pair by itself and in sequence as in
the odometry, and compare the errors with the covariances: the share of poses inside their 50 to
99.9 % ellipsoids, scene by scene, a reliability plot, and the list of overconfident failures.
Rendered scenes are kept in OUTPUT/scenes. An interrupted run is resumed.
"""

RESULTS = ('coverage.json', 'reliability.png')
SCENES_FOLDER = 'scenes'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('sources', nargs='*', type=Path, metavar='SOURCE',
                        help='sequences with ground truth: folders or bags')
    parser.add_argument('--scenes', default='', metavar='LIST',
                        help=f'scenes to render: all, or some of {", ".join(SCENES)}')
    add_seeds(parser)
    parser.add_argument('--frames', type=int, default=17, metavar='N',
                        help='frames of each rendered scene (default: %(default)s)')
    add_output(parser, 'folder for the results')
    add_frames(parser)
    add_workers(parser)
    add_flags(parser, ('estimator.method', 'estimator.calibration_sigma'))


def run(args: argparse.Namespace) -> int:
    """Render missing scenes, estimate all pairs, and print the coverage."""
    scenes = list(SCENES) if args.scenes == 'all' else split(args.scenes)
    if scenes:
        check_names('scene', scenes, SCENES)
    check_least(args, workers=1, frames=2)
    if not scenes and not args.sources:
        raise DjetError('no SOURCE and no --scenes: nothing to measure; name one of them')
    check_ours(args.output, (*RESULTS, SCENES_FOLDER), FILE_NAME)
    make_folder(args.output)
    with local_workers(args.workers) as executor:
        rendered = _rendered(executor, args.output / SCENES_FOLDER,
                             [(name, seed) for name in scenes for seed in args.seeds], args.frames)
        with datasets_of(args, [*args.sources, *rendered]) as datasets:
            records = _records(args, datasets, executor)
    rows = coverage_rows(records)
    _show(rows, records)
    write_json(args.output / 'coverage.json',
               {'levels': LEVELS, 'rows': [asdict(row) for row in rows]})
    draw_reliability(records, args.output / 'reliability.png')
    print(f'plot: {args.output / "reliability.png"}')
    return 0


def _records(args: argparse.Namespace, datasets: Sequence[Dataset],
             executor: Executor) -> list[Coverage]:
    config = from_flat(flag_values(args)).estimator
    settings = {'sequences': [dataset.settings() for dataset in datasets],
                'estimator': asdict(config)}
    with (RecordStore(args.output, Coverage, settings, RESULTS,
                      overwrite=args.overwrite) as store,
          progress_bar('pairs') as progress):
        return run_chunks(executor, started_chunks(datasets),
                          partial(cover_chunk, config=config), store, progress)


def _rendered(executor: Executor, folder: Path, wanted: Sequence[tuple[str, int]],
              frames: int) -> list[Path]:
    """Render the scenes that an earlier run has not, and return the folders of all."""
    places = [folder / f'{name}-{seed}-{frames}' for name, seed in wanted]
    # Poses are written last: a folder with poses is complete.
    missing = [executor.submit(render_sequence, name, place, frames, seed, overwrite=True)
               for (name, seed), place in zip(wanted, places)
               if not any(place.glob('poses/*.txt'))]
    with progress_bar('scenes', len(missing)) as progress:
        for future in as_completed(missing):
            future.result()
            progress()
    return [next(place.glob('sequences/*')) for place in places]


def _show(rows: Sequence[CoverageRow], records: Sequence[Coverage]) -> None:
    out = console()
    for start in dict.fromkeys(row.start for row in rows):
        out.print(_coverage_table([row for row in rows if row.start == start],
                                  f'share of poses inside their ellipsoids, {_STARTS[start]}'))
    print('no dir.: pairs tracked without a translation direction although the camera moved, '
          'such as NO_PARALLAX\n'
          'lost: pairs without a pose; correct: of those, the ones whose best estimate was '
          'correct\n'
          f'failed: {FAILURE}\n'
          f'overconf.: of those, the ones with standard deviations below {SURE_ROTATION:g} '
          f'(rotation) and {SURE_DIRECTION:g} deg (direction)\n'
          'NEES: median of e^T C^-1 e, over the median of its distribution; confidence intervals '
          'of the shares are in coverage.json')
    if wrong := [record for record in records if record.overconfident]:
        out.print(_overconfident_pairs(wrong))


# Titles of the two ways to start a pair.
_STARTS = {ALONE: 'each pair by itself', IN_A_ROW: 'pairs in sequence'}


def _coverage_table(rows: Sequence[CoverageRow], title: str) -> Table:
    table = compact_table('', 'pairs', 'OK', 'no dir.', 'lost', 'correct', 'failed', 'overconf.',
                          'NEES', *(f'{100 * level:g}%' for level in LEVELS), title=title)
    for row in rows:
        table.add_row(row.scene, *map(str, (
            row.pairs, row.told, row.untold, row.given_up, row.needlessly, row.failed,
            row.wrong_and_sure)),
            f'{row.median:.2f}', *(f'{100 * share:.3g}' for share, _, _ in row.inside))
    return table


def _overconfident_pairs(wrong: Sequence[Coverage]) -> Table:
    table = new_table('overconfident failures', 'sequence', 'frames', 'start', 'rotation deg',
                      'sigma', 'direction deg', 'sigma', 'inliers')
    for one in wrong:
        table.add_row(one.sequence, f'{one.previous} {one.current}', one.start,
                      f'{one.rotation_error_deg:.2f}', f'{one.rotation_claim_deg:.3f}',
                      f'{one.direction_error_deg:.1f}', f'{one.direction_claim_deg:.2f}',
                      f'{one.inliers} of {one.matches}')
    return table
