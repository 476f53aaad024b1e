"""``djet kitti-to-bag``: a KITTI odometry sequence as a rosbag2."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.cli.options import add_frames, add_overwrite
from djet_ros.cli.terminal import progress_bar
from djet_ros.recordings.bag_writers import STORAGES, write_kitti_bag
from djet_ros.recordings.kitti import KittiSequence

DESCRIPTION = """\
Write a KITTI odometry sequence (image_0/*.png, calib.txt, times.txt) as a rosbag2 with
/camera/image_rect, /camera/camera_info, /tf_static and, where there are poses,
/ground_truth/pose. Stamps are those of times.txt plus 1000 s, because ROS takes 0 for "no time".
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('sequence', type=Path, metavar='SEQUENCE_DIR',
                        help='folder such as sequences/00')
    parser.add_argument('out', type=Path, metavar='OUT', help='folder of the new bag')
    parser.add_argument('--poses', type=Path, metavar='FILE',
                        help='ground truth (default: ../../poses/NN.txt where it exists)')
    parser.add_argument('--storage', choices=tuple(STORAGES), default='mcap',
                        help='file format of the bag (default: %(default)s)')
    add_frames(parser)
    add_overwrite(parser)


def run(args: argparse.Namespace) -> int:
    """Convert, with a progress bar on stderr, and say what was written."""
    sequence = KittiSequence(args.sequence, args.poses, args.start, args.end)
    with progress_bar(sequence.name, len(sequence)) as progress:
        write_kitti_bag(sequence, args.out, args.storage, overwrite=args.overwrite,
                        progress=progress)
    seconds = (sequence.stamps_ns[-1] - sequence.stamps_ns[0]) / 1e9
    truth = 'with' if sequence.poses is not None else 'without'
    width, height = sequence.size
    print(f'{args.out}: {len(sequence)} frames of {width}x{height}, {seconds:.1f} s, '
          f'{truth} ground truth')
    return 0
