"""``djet live``: run the odometry on a ROS 2 graph, without ROS."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from djet_ros.cli.graph_options import add_remappings, ENVIRONMENT, stop_by_signal
from djet_ros.config.flat import flat, parse_value
from djet_ros.config.sections import Config, NODE_NAME
from djet_ros.config.yaml_files import load_yaml
from djet_ros.dds.names import Names
from djet_ros.errors import DjetError
from djet_ros.live.parameters import with_live_values

DESCRIPTION = f"""\
Run the odometry on a ROS 2 graph from a machine without ROS, with the interface of 'ros2 run
djet_ros vo_node': the same topics (image, camera_info; ~/relative_pose, ~/relative_pose_cov,
~/relative_pose_status, ~/odometry, ~/path, ~/landmarks, ~/debug_image, /diagnostics, /tf),
services (~/reset, ~/pause, ~/resume) and parameters.
{ENVIRONMENT}"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--params', type=Path, metavar='FILE',
                        help='YAML file of parameters, plain or in the layout of ROS')
    parser.add_argument('-p', '--param', action='append', default=[], metavar='NAME:=VALUE',
                        help='a parameter, such as ros.queue_policy:=every, or '
                        'use_sim_time:=true; overrides the file; may be repeated')
    add_remappings(parser)


def run(args: argparse.Namespace) -> int:
    """Run the odometry until SIGINT or SIGTERM."""
    stop = stop_by_signal()
    names = Names(NODE_NAME, args.remap)
    config, use_sim_time = _configuration(args, names.full_node)

    from djet_ros.dds.graph import Graph
    from djet_ros.dds.middleware import DdsMiddleware
    from djet_ros.live.odometry_node import OdometryNode
    with Graph() as graph:
        return OdometryNode(DdsMiddleware(graph, names, use_sim_time), config).run(stop)


def _configuration(args: argparse.Namespace, node: str) -> tuple[Config, bool]:
    """Return (configuration, use_sim_time) from file and command line; node: its full name."""
    config = Config()
    if args.params is not None:
        config = load_yaml(args.params, partial(with_live_values, config), [node])
    known = flat(config)
    values: dict[str, Any] = {}
    use_sim_time = False
    for given in args.param:
        name, mark, text = given.partition(':=')
        if not mark:
            raise DjetError(f"--param is '{given}'; write it as name:=value")
        if name == 'use_sim_time':
            if text not in ('true', 'false'):
                raise DjetError(f"use_sim_time is '{text}'; it must be true or false")
            use_sim_time = text == 'true'
        else:
            values[name] = parse_value(known[name], text) if name in known else text
    return with_live_values(config, values), use_sim_time
