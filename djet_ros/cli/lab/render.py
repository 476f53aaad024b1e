"""``djet lab render``: a rendered scene with exact ground truth, in the layout of KITTI."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
import re

from djet_ros.cli.options import add_overwrite
from djet_ros.cli.terminal import progress_bar
from djet_ros.errors import DjetError
from djet_ros.lab.scenes import render_sequence, SCENES
from djet_ros.lab.scenes.imu import Mems

DESCRIPTION = """\
Render images, calibration, times and true camera poses into OUT, in the layout of the KITTI
odometry benchmark, with imu.csv: the samples of a simulated IMU on the camera.
"""

_MEMS = {
    'rate': 'samples per second',
    'gyro': 'white noise density of the gyro, rad/s/√Hz',
    'gyro_walk': 'random walk of the gyro bias, rad/s²/√Hz',
    'gyro_bias': 'standard deviation of the initial gyro bias, rad/s',
    'accelerometer': 'white noise density of the accelerometer, m/s²/√Hz',
    'accelerometer_walk': 'random walk of the accelerometer bias, m/s³/√Hz',
    'accelerometer_bias': 'standard deviation of the initial accelerometer bias, m/s²',
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    longest = max(map(len, SCENES))
    scenes = '\n'.join(f'  {name:{longest}}  {entry.text}' for name, entry in SCENES.items())
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = f'scenes:\n{scenes}'
    parser.add_argument('scene', metavar='SCENE', choices=tuple(SCENES), help='see below')
    parser.add_argument('out', type=Path, metavar='OUT',
                        help='folder for sequences/NN and poses/NN.txt')
    parser.add_argument('--frames', type=int, metavar='N',
                        help='number of frames (default: depends on the scene)')
    parser.add_argument('--seed', type=int, default=0, metavar='S',
                        help='random seed of the scene (default: %(default)s)')
    parser.add_argument('--size', type=_size, metavar='WxH',
                        help='image size in pixels (default: depends on the scene: 1241x376 as in '
                             'KITTI, 960x540 or 640x480)')
    parser.add_argument('--slower', type=int, default=1, metavar='N',
                        help='number of steps of the camera in place of each (default: '
                             '%(default)s)')
    imu = parser.add_argument_group('IMU')
    for name, text in _MEMS.items():
        imu.add_argument(f'--{name.replace("_", "-")}', dest=f'mems.{name}', type=float,
                         metavar='X', default=getattr(Mems, name),
                         help=f'{text} (default: %(default)g)')
    add_overwrite(parser)


def run(args: argparse.Namespace) -> int:
    """Render, with a progress bar on stderr, and print what was written."""
    with progress_bar(args.scene) as progress:
        folder = render_sequence(args.scene, args.out, args.frames, args.seed, args.size,
                                 progress, overwrite=args.overwrite, mems=_mems(args),
                                 slower=args.slower)
    frames = len(list((folder / 'image_0').iterdir()))
    width, height = args.size or SCENES[args.scene].size
    print(f'{folder}: {frames} frames of {width}x{height} with ground truth')
    return 0


def _mems(args: argparse.Namespace) -> Mems:
    values = {name: getattr(args, f'mems.{name}') for name in _MEMS}
    for name, value in values.items():
        if not (math.isfinite(value) and value >= 0 and (name != 'rate' or 1 <= value <= 10_000)):
            limits = 'between 1 and 10000' if name == 'rate' else 'finite and not negative'
            raise DjetError(f'--{name.replace("_", "-")} is {value:g}; it must be {limits}')
    return Mems(**values)


def _size(text: str) -> tuple[int, int]:
    """Return width and height of a text such as 620x188."""
    match = re.fullmatch(r'(\d{1,9})x(\d{1,9})', text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not WIDTHxHEIGHT, such as 620x188")
    return int(match[1]), int(match[2])
