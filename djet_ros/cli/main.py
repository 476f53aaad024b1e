"""The ``djet`` command's frame: the list of subcommands and the one error handler."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
import os
import sys
from types import ModuleType
from typing import NoReturn

from djet_ros import __version__
from djet_ros.errors import DjetError
from djet_ros.threads import one_blas_thread

# Only the module of the command that is called gets imported: help is quick, and no command
# needs the libraries of another.
COMMANDS = {
    'render': 'render a scene with exact ground truth as a KITTI sequence',
    'kitti-to-bag': 'write a KITTI odometry sequence as a rosbag2',
    'replay': 'get the trajectory of a camera from a recording',
    'export': 'write the pose graph of a replay for a SLAM backend',
    'live': 'the odometry on a ROS 2 graph, without ROS',
    'play': 'a recording onto a ROS 2 graph, without ROS',
    'echo': 'what a live odometry says, in the terminal',
    'slam': 'close loops offline and optimise the trajectory with GTSAM',
    'bench': 'measure the speed, as ratios against OpenCV from one run',
    'soak': 'run many frames through the odometry: does memory or latency grow?',
    'evaluate': 'estimate all pairs by several methods: tables and plots against ground truth',
    'ablate': 'estimate all pairs by variants of D-JET: what each part contributes',
    'closure': 'how well the rotations of three frames agree: no ground truth needed',
    'similarity': "draw how alike descriptors around keypoints are (the paper's Figure 1)",
    'surfaces': 'draw one match on its Hamming surface, round by round',
    'demo': 'replay a sequence with D-JET and with re-projection error, and compare',
}

# Where a module and the distribution that brings it differ in name.
DISTRIBUTIONS = {
    'backports': 'backports.zstd',
    'cv2': 'opencv-python-headless',
    'yaml': 'PyYAML',
}


class _Parser(argparse.ArgumentParser):
    """A parser that reports a wrong command line in one line, without the whole usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'djet: error: {message} (see {self.prog} --help)\n')


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; the exit code is 2 for what the user can mend, 130 for Ctrl-C."""
    one_blas_thread()
    try:
        code = run(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
        return code
    except DjetError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        return _fail(_how_to_install(error))
    except KeyboardInterrupt:
        print('djet: interrupted', file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has gone; Python would flush to it once more at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        return _fail(f'{error.filename}: {error.strerror}' if error.filename else str(error))


def run(argv: Sequence[str]) -> int:
    """Run one subcommand, letting its exceptions through."""
    parser = _Parser(prog='djet', description='Visual odometry by D-JET, from bags and datasets.')
    parser.add_argument('--version', action='version', version=f'djet_ros {__version__}')
    subparsers = parser.add_subparsers(metavar='COMMAND', required=True)
    command = next((argument for argument in argv if not argument.startswith('-')), None)
    for name, summary in COMMANDS.items():
        if name == command:
            _module(name).add_parser(subparsers)
        else:
            subparsers.add_parser(name, help=summary)
    args = parser.parse_args(argv)
    code: int = _module(str(command)).run(args)
    return code


def _module(command: str) -> ModuleType:
    return import_module('djet_ros.cli.' + command.replace('-', '_'))


def _how_to_install(error: ModuleNotFoundError) -> str:
    module = (error.name or '').partition('.')[0]
    if module in ('', 'djet_ros'):
        raise error
    return (f"this command needs the Python module '{module}', which is not installed: "
            f'pip install {DISTRIBUTIONS.get(module, module)}')


def _fail(message: str) -> int:
    print(f'djet: error: {message}', file=sys.stderr)
    return 2
