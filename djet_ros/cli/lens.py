"""``djet lens``: what the calibration leaves of the lens's distortion."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.cli.options import add_overwrite, add_topics
from djet_ros.cli.terminal import progress_bar
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import with_values
from djet_ros.config.sections import Config
from djet_ros.lab.lens import calibration, examine, LensReport, plot_lens
from djet_ros.recordings.outputs import make_room, write_whole
from djet_ros.recordings.recording import open_recording

DESCRIPTION = """\
Find, from a recording in which the camera turns, the radial distortion that its calibration leaves
in the images: the coefficient k1 that brings matches onto their epipolar lines, with its standard
error by a jackknife over groups of pairs. No target is needed. Says whether that is worth
correcting, and how. At most 2000 pairs of 300 matches are held.
"""

YAML, PLOT = 'lens.yaml', 'lens.png'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE',
                        help='bag or folder, as for djet replay')
    parser.add_argument('--output', type=Path, metavar='DIR',
                        help=f'folder for {YAML}, the corrected calibration as ROS has it, and '
                        f'{PLOT}, pixels by radius')
    add_overwrite(parser)
    add_flags(parser, ('odometry.rectified',))
    add_topics(parser, 'image', 'info')


def run(args: argparse.Namespace) -> int:
    """Run the recording through the odometry, and print what its pairs tell of the lens."""
    if args.output is not None:
        make_room(args.output, (YAML, PLOT), args.overwrite)
    config = with_values(Config(), flag_values(args))
    with open_recording(args.source, args.image_topic, args.info_topic) as recording, \
            progress_bar('lens', len(recording)) as advance:
        report = examine(recording, config, advance)
    print(_found(report))
    if args.output is not None:
        write_whole(args.output / YAML, calibration(report))
        plot_lens(args.output / PLOT, args.source.resolve().name, report)
        print(f'calibration: {args.output / YAML}\nplot: {args.output / PLOT}')
    return 0


def _found(report: LensReport) -> str:
    fit, k1 = report.fit, report.camera.k1
    pixels, spread = (report.corner_pixels(value) for value in (fit.k1, k1 + fit.sigma))
    before = f' ({k1:.4g} by the calibration)' if k1 else ''
    said = (f'k1 = {fit.k1:.4f} +- {fit.sigma:.4f}{before}, by {len(fit.told)} of {report.pairs} '
            f'pairs, which turn by {report.turned_deg:.0f} degrees\n'
            f'that moves pixels in the corners by {pixels:.1f} +- {spread:.1f}: ')
    if not report.worth_correcting:
        return said + 'not worth correcting'
    row = ' '.join(f'{value:.4g}' for value in report.coefficients)
    return said + ('worth correcting, by this row of a calib.txt, or by such a d of the '
                   f'CameraInfo with odometry.rectified false:\nD: {row}')
