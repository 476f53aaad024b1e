"""``djet lab imu-offset``: time offset and rotation between IMU and camera."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.cli.options import add_topics
from djet_ros.cli.terminal import progress_bar, warn
from djet_ros.config.sections import Config
from djet_ros.errors import DjetError
from djet_ros.lab.imu_offset import fit_imu, rotations_and_rates
from djet_ros.recordings.recording import open_recording
import numpy as np

DESCRIPTION = """\
Estimate, from a recording in which the camera rotates back and forth, the time offset of the IMU
(odometry.imu_offset, t_imu = t_image + offset), the rotation between IMU and camera
(odometry.imu_rotation), and the gyro bias. No calibration target is needed.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE',
                        help='bag, or folder of EuRoC, TUM-VI, KITTI raw or a rendered scene')
    parser.add_argument('--widest', type=float, default=0.5, metavar='S',
                        help='largest offset to search for, in seconds (default: %(default)s)')
    add_topics(parser, 'image', 'info', 'imu')


def run(args: argparse.Namespace) -> int:
    """Run the recording through the odometry, without its IMU, and print the estimate."""
    if not 0 < args.widest <= 10:
        raise DjetError(f'--widest is {args.widest:g}; it must be between 0 and 10 s')
    with open_recording(args.source, args.image_topic, args.info_topic,
                        auxiliary={'imu': args.imu_topic}) as recording, \
            progress_bar('imu-offset', len(recording)) as advance:
        rotations, stamps, rates = rotations_and_rates(recording, Config(), advance, warn)
    fit = fit_imu(rotations, stamps, rates, args.widest)
    print(f'odometry.imu_offset: {fit.offset:.5f}   # seconds, sigma {fit.offset_sigma:.5f}')
    print('odometry.imu_rotation: "' + ' '.join(f'{q:.6f}' for q in fit.quaternion()) + '"')
    bias = ' '.join(f'{value:.4f}' for value in np.degrees(fit.bias))
    print(f'# gyro bias {bias} deg/s; {fit.pairs} pairs, residual {np.degrees(fit.residual):.4f} '
          'deg/s')
    return 0
