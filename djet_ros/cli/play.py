"""``djet play``: publish a recording on a ROS 2 graph, without ROS."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
import sys

from djet_ros.cli.graph_options import add_remappings, ENVIRONMENT, stop_by_signal
from djet_ros.cli.options import add_topics, RECORDINGS
from djet_ros.errors import DjetError
from djet_ros.recordings.recording import AUXILIARY, open_recording

DESCRIPTION = f"""\
Publish the images of a recording with their CameraInfo, ground truth, and any recorded speeds,
IMU, other odometry, masks and tf, at the recorded rate. Playback starts when a node subscribes to
the images. All topics are offered as reliable: with a reliable subscriber, the player waits rather
than drops an image. CameraInfo is latched (transient local).
{ENVIRONMENT}"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('source', type=Path, metavar='SOURCE', help=RECORDINGS)
    parser.add_argument('--rate', type=float, default=1.0, metavar='R',
                        help='playback speed as a multiple of the recorded (default: '
                        '%(default)s)')
    parser.add_argument('--loop', action='store_true', help='start again at the end')
    parser.add_argument('--clock', action='store_true',
                        help='publish the recorded time on /clock')
    add_topics(parser, 'image', 'info')
    add_remappings(parser)


def run(args: argparse.Namespace) -> int:
    """Play until the end, SIGINT or SIGTERM, and print the number of images."""
    if not (args.rate > 0 and math.isfinite(args.rate)):
        raise DjetError(f'--rate is {args.rate}; it must be a positive number')
    stop = stop_by_signal()

    from djet_ros.dds.graph import Graph
    from djet_ros.dds.names import Names
    from djet_ros.dds.player import Player
    names = Names('player', args.remap)
    with open_recording(args.source, args.image_topic, args.info_topic,
                        auxiliary=dict.fromkeys(AUXILIARY), strict=False) as source, \
            Graph() as graph:
        player = Player(graph, source, names, args.rate, args.clock)
        print(f'waiting for a subscriber to {player.image_topic}', file=sys.stderr, flush=True)
        player.wait_for_listener(stop)
        while not stop.is_set():
            player.play(stop)
            if not args.loop:
                break
    late = f', the last {player.late:.1f} s late' if player.late > 0.1 else ''
    print(f'{player.images} images published on {player.image_topic}{late}')
    return 0
