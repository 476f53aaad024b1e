"""``djet lens``: estimate the residual radial distortion of a calibrated camera."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.cli.options import add_overwrite, add_topics, output_path, RECORDINGS
from djet_ros.cli.replay import configuration
from djet_ros.cli.terminal import progress_bar, warn
from djet_ros.config.flags import add_flags
from djet_ros.errors import one_line
from djet_ros.lab.lens import calibration, examine, LensReport, plot_lens
from djet_ros.recordings.bags import is_bag
from djet_ros.recordings.outputs import check_ours, check_room, make_room, write_whole
from djet_ros.recordings.recording import open_recording

DESCRIPTION = """\
Estimate, from a recording in which the camera turns, the residual radial distortion that its
calibration leaves in the images: the coefficient k1 that minimises the distances of matches from
their epipolar lines. No calibration target is needed. The standard error is the larger of two
jackknife estimates (over the pairs, and over ten blocks of consecutive pairs), plus the effect of
a systematic shift of all points in one part of the image. Prints whether a correction is
worthwhile, and how to apply it. At most 2000 pairs of 300 matches are used.
"""

YAML, PLOT = 'lens.yaml', 'lens.png'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE',
                        help=RECORDINGS)
    parser.add_argument('--output', type=output_path, metavar='DIR',
                        help=f'folder for {PLOT} (shift in pixels by radius) and {YAML} (the '
                        'CameraInfo with the corrected k1, in the format of camera_info_manager; '
                        'written only if the correction is worthwhile and the images are not '
                        'rectified)')
    add_overwrite(parser)
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help='YAML file of parameters, plain or in the layout of ROS; flags '
                        'override it')
    add_flags(parser, ('odometry.rectified', 'odometry.residual_k1', 'odometry.mask_file'))
    add_topics(parser, 'image', 'info')


def run(args: argparse.Namespace) -> int:
    """Run the recording through the odometry, and print the estimated distortion."""
    if args.output is not None:
        # An image among those of a recording, lens.png would be one of them.
        check_ours(args.output, (YAML, PLOT), PLOT)
        check_room(args.output, (YAML, PLOT), args.overwrite)
    config = configuration(args)
    with open_recording(args.source, args.image_topic, args.info_topic) as recording, \
            progress_bar('lens', len(recording)) as advance:
        report = examine(recording, config, advance, warn)
    print(_summary(report, args.source))
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


def _summary(report: LensReport, source: Path) -> str:
    fit, k1 = report.fit, report.camera.k1
    pixels, sigma = (report.moved_pixels(value) for value in (fit.k1, k1 + fit.sigma))
    before = f' (calibrated: {k1:.4g})' if k1 else ''
    text = (f'k1 = {fit.k1:.4f} +- {fit.sigma:.4f}{before}, from {len(fit.linearised)} of '
            f'{report.pairs} pairs with {report.turned_deg:.0f} degrees of rotation in total\n'
            f'that moves the outermost matches by {pixels:.1f} +- {sigma:.1f} pixels: ')
    if not report.worth_correcting:
        return text + 'not worth correcting'
    return f'{text}worth correcting, {_correction(report, source)}'


def _correction(report: LensReport, source: Path) -> str:
    """Return how to apply the correction, by where the kind of source keeps its calibration."""
    if report.rectified:
        return ('by recalibrating on the raw images, or by this flag of djet replay '
                f'(odometry.residual_k1 of a node):\n--residual-k1 {report.fit.k1:.5f}')
    row = ' '.join(f'{value:.4g}' for value in report.coefficients)
    if is_bag(source):
        return (f'by {YAML} (--output), which camera_info_manager loads, or by these distortion '
                f'coefficients in the CameraInfo:\nD: {row}')
    if (source / 'calib.txt').is_file():
        return f'by this row of its calib.txt:\nD: {row}'
    return f'by these coefficients in the camera description of the folder:\nD: {row}'
