"""``djet lens``: what the calibration leaves of the lens's distortion."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.cli.options import add_overwrite, add_topics, place
from djet_ros.cli.replay import configured
from djet_ros.cli.terminal import progress_bar
from djet_ros.config.flags import add_flags
from djet_ros.errors import one_line
from djet_ros.lab.lens import calibration, examine, LensReport, plot_lens
from djet_ros.recordings.bags import is_bag
from djet_ros.recordings.outputs import check_room, make_room, write_whole
from djet_ros.recordings.recording import open_recording

DESCRIPTION = """\
Find, from a recording in which the camera turns, the radial distortion that its calibration leaves
in the images: the coefficient k1 that brings matches onto their epipolar lines. No target is
needed. Its standard error is the larger of two jackknifes, over the pairs and over ten groups of
them in a row, and on top what a shift of all that is seen in one part of the image would do. Says
whether that is worth correcting, and how. At most 2000 pairs of 300 matches are held.
"""

YAML, PLOT = 'lens.yaml', 'lens.png'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE',
                        help='bag or folder, as for djet replay')
    parser.add_argument('--output', type=place, metavar='DIR',
                        help=f'folder for {PLOT}, pixels by radius, and {YAML}, the CameraInfo '
                        'with another k1 as camera_info_manager reads it, where that is worth '
                        'correcting and the images are not rectified')
    add_overwrite(parser)
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help='parameters as YAML, plain or in the layout of ROS; flags come on '
                        'top')
    add_flags(parser, ('odometry.rectified', 'odometry.residual_k1', 'odometry.mask_file'))
    add_topics(parser, 'image', 'info')


def run(args: argparse.Namespace) -> int:
    """Run the recording through the odometry, and print what was found of the lens."""
    if args.output is not None:
        check_room(args.output, (YAML, PLOT), args.overwrite)
    config = configured(args)
    with open_recording(args.source, args.image_topic, args.info_topic) as recording, \
            progress_bar('lens', len(recording)) as advance:
        report = examine(recording, config, advance)
    print(_found(report, args.source))
    if args.output is not None:
        _write(args.output, report, args)
    return 0


def _write(folder: Path, report: LensReport, args: argparse.Namespace) -> None:
    make_room(folder, (YAML, PLOT), args.overwrite)
    if report.worth_correcting and not report.rectified:
        write_whole(folder / YAML, calibration(report))
        print(f'calibration: {folder / YAML}')
    plot_lens(folder / PLOT, one_line(args.source.resolve().name), report)
    print(f'plot: {folder / PLOT}')


def _found(report: LensReport, source: Path) -> str:
    fit, k1 = report.fit, report.camera.k1
    pixels, spread = (report.moved_pixels(value) for value in (fit.k1, k1 + fit.sigma))
    before = f' ({k1:.4g} so far)' if k1 else ''
    said = (f'k1 = {fit.k1:.4f} +- {fit.sigma:.4f}{before}, by {len(fit.linearised)} of '
            f'{report.pairs} pairs, which turn by {report.turned_deg:.0f} degrees\n'
            f'that moves the outermost matches by {pixels:.1f} +- {spread:.1f} pixels: ')
    if not report.worth_correcting:
        return said + 'not worth correcting'
    return f'{said}worth correcting, {_remedy(report, source)}'


def _remedy(report: LensReport, source: Path) -> str:
    """Say where the coefficients belong: nothing reads all of a driver, a calib.txt, a folder."""
    if report.rectified:
        return ('by calibrating the raw images anew, or by this flag of djet replay '
                f'(odometry.residual_k1 of a node):\n--residual-k1 {report.fit.k1:.5f}')
    row = ' '.join(f'{value:.4g}' for value in report.coefficients)
    if is_bag(source):
        return (f'by {YAML} (--output), which camera_info_manager loads, or such a d of the '
                f'CameraInfo:\nD: {row}')
    if (source / 'calib.txt').is_file():
        return f'by this row of its calib.txt:\nD: {row}'
    return f'by these coefficients where the folder describes its camera:\nD: {row}'
