"""``djet lab surfaces``: one match through the iterations of Algorithm 1."""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from djet_ros.cli.options import add_output, check_output, numbers
from djet_ros.cli.terminal import warn
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import from_flat
from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.estimator_config import PRESETS
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.sequences import pair_of_frames
from djet_ros.lab.similarity import read_image
from djet_ros.lab.surface_steps import (
    animate_trace,
    draw_trace,
    illustrative_match,
    trace_rounds,
)
import numpy as np
from numpy.typing import NDArray

DESCRIPTION = """\
Plot one match on its Hamming surface, iteration by iteration of D-JET: the sampled window, the
fitted paraboloid and its minimum, the epipolar line of the pose, and the optimum on it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE',
                        help='a sequence or a bag, or the first of two images')
    parser.add_argument('other', type=Path, nargs='?', metavar='IMAGE2', help='the second image')
    add_output(parser, 'PNG, or GIF for an animation', 'surfaces.png', 'FILE')
    parser.add_argument('--camera', metavar='FX,FY,CX,CY',
                        help='camera matrix of two images, in pixels')
    parser.add_argument('--pair', type=int, default=0, metavar='I',
                        help='frames I and I + 1 of a sequence (default: %(default)s)')
    parser.add_argument('--match', type=int, metavar='K',
                        help='index of the match (default: the inlier with a minimum in every '
                        'iteration that moves farthest)')
    parser.add_argument('--preset', choices=PRESETS, default='paper',
                        help='preset of parameters; paper takes small steps (default: '
                        '%(default)s, whose values are the defaults below)')
    add_flags(parser, ('estimator.window', 'estimator.window_sigma', 'estimator.max_iterations',
                       'estimator.step', 'estimator.step_share'), from_flat({'preset': 'paper'}))


def run(args: argparse.Namespace) -> int:
    """Draw the figure, and print its path."""
    check_output(args, '.png', '.gif', inputs=(args.source, args.other) if args.other else ())
    draw = draw_trace if args.output.suffix.lower() == '.png' else animate_trace
    config = from_flat(flag_values(args)).estimator
    first, second, K = _images(args)
    estimator = TwoViewEstimator(config)
    previous, current = estimator.view(first, K), estimator.view(second, K)
    x, y = estimator.match(previous, current)
    if len(x) < config.min_matches:
        raise DjetError(f'the two images have {len(x)} matches, at least {config.min_matches} are '
                        'needed; choose images of the same scene with texture')
    trace = trace_rounds(previous, current, x, y, config)
    match = illustrative_match(trace) if args.match is None else args.match
    draw(args.output, trace, match)
    print(f'match {match} of {len(trace.y)}, {len(trace.rounds)} iterations')
    print(f'figure: {args.output}')
    return 0


def _images(args: argparse.Namespace) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Array]:
    """Return two images (H, W) and their camera matrix (3, 3)."""
    if args.other is None:
        if args.camera is not None:
            raise DjetError(f"--camera is '{args.camera}', but {args.source} has a calibration of "
                            'its own; omit the option, or name two images')
        with TemporaryDirectory(prefix='djet-') as workspace:
            return pair_of_frames(args.source, args.pair, Path(workspace), warn)
    if args.camera is None:
        raise DjetError('two images need --camera FX,FY,CX,CY')
    fx, fy, cx, cy = numbers(args.camera, '--camera', 'FX,FY,CX,CY')
    if min(fx, fy) <= 0:
        raise DjetError(f"--camera is '{args.camera}'; focal lengths must be positive numbers")
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return read_image(args.source), read_image(args.other), K
