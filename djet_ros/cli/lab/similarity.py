"""``djet lab similarity``: the paper's Figure 1, for one image or two."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.cli.options import add_output, check_output, numbers
from djet_ros.config.flags import add_flags, flag_values
from djet_ros.config.flat import from_flat
from djet_ros.errors import DjetError
from djet_ros.lab.similarity import (
    cross_similarity,
    draw_similarity,
    read_image,
    self_similarity,
)
import numpy as np

DESCRIPTION = """\
Plot the Hamming distances between the descriptors of keypoints and those of all pixels around
them: in the same image or, with a second image, around their matches in that one. The first row
shows the patches, the second the distances as heat maps, with the fitted paraboloids and their
minima.
"""

_LARGEST_RADIUS = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('image', type=Path, metavar='IMAGE', help='PNG or JPEG')
    parser.add_argument('other', type=Path, nargs='?', metavar='IMAGE2',
                        help='second image of the same scene (default: the first)')
    add_output(parser, 'PNG to write', 'similarity.png', 'FILE')
    parser.add_argument('--points', nargs='+', metavar='X,Y',
                        help='pixels in the first image (default: the strongest keypoints)')
    parser.add_argument('--count', type=int, default=6, metavar='N',
                        help='number of keypoints without --points (default: %(default)s)')
    parser.add_argument('--radius', type=int, default=20, metavar='PIXELS',
                        help='radius of the heat maps (default: %(default)s)')
    add_flags(parser, ('estimator.window', 'estimator.window_sigma', 'estimator.max_features',
                       'estimator.detector', 'estimator.corner_contrast',
                       'estimator.fast_threshold'))


def run(args: argparse.Namespace) -> int:
    """Draw the figure, and print its path."""
    check_output(args, '.png', inputs=(args.image, args.other or args.image))
    gray = read_image(args.image)
    other = gray if args.other is None else read_image(args.other)
    points = None if args.points is None else np.array(
        [numbers(text, '--points', 'X,Y') for text in args.points])
    config = from_flat(flag_values(args)).estimator
    if not config.window // 2 <= args.radius <= _LARGEST_RADIUS or args.count < 1:
        raise DjetError(f'--radius is {args.radius} and --count {args.count}; the radius must be '
                        f'between {config.window // 2} and {_LARGEST_RADIUS}, the count at least '
                        '1')
    if args.other is None:
        similarity = self_similarity(gray, points, args.count, args.radius, config)
    else:
        similarity = cross_similarity(gray, other, points, args.count, args.radius, config)
    draw_similarity(args.output, gray, other, similarity)
    print(f'figure: {args.output}')
    return 0
