"""``djet kitti-to-bag``: convert a KITTI odometry sequence to a rosbag2."""

from __future__ import annotations

import argparse
from pathlib import Path

from djet_ros.cli.options import add_frames, add_overwrite
from djet_ros.cli.terminal import progress_bar
from djet_ros.recordings.bag_writers import STORAGES, write_kitti_bag
from djet_ros.recordings.kitti import KittiSequence

DESCRIPTION = """\
Convert a KITTI odometry sequence (image_0/*.png, calib.txt, times.txt) to a rosbag2 with
/camera/image_rect, /camera/camera_info, /tf_static and, if there is ground truth,
/ground_truth/pose. Stamps are those of times.txt plus 1000 s, because in ROS a stamp of 0 means
"no time".
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('sequence', type=Path, metavar='SEQUENCE_DIR',
                        help='folder of the sequence, such as sequences/00')
    parser.add_argument('out', type=Path, metavar='OUT', help='folder of the new bag')
    parser.add_argument('--poses', type=Path, metavar='FILE',
                        help='ground truth poses (default: ../../poses/NN.txt of the sequence, '
                        'if it exists)')
    parser.add_argument('--storage', choices=tuple(STORAGES), default='mcap',
                        help='file format of the bag (default: %(default)s)')
    add_frames(parser)
    add_overwrite(parser)


def run(args: argparse.Namespace) -> int:
    """Convert, with a progress bar on stderr, and print what was written."""
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
