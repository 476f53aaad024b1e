"""The ``djet`` command's frame: the list of subcommands and the one error handler."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from io import TextIOWrapper
import os
import signal
import sys
from threading import current_thread, main_thread
from typing import Any, NoReturn

from djet_ros import __version__
from djet_ros.errors import DjetError
from djet_ros.libraries import how_to_get
from djet_ros.threads import one_blas_thread, sleep_while_waiting

# Only the module of the command that is called gets imported: help is quick, and no command
# needs the libraries of another.
COMMANDS = {
    'replay': 'get the trajectory of a camera from a recording',
    'live': 'the odometry on a ROS 2 graph, without ROS',
    'play': 'a recording onto a ROS 2 graph, without ROS',
    'echo': 'what a live odometry says, in the terminal',
    'slam': 'close loops offline and optimise the trajectory with GTSAM',
    'export': 'write the pose graph of a replay for a SLAM backend',
    'lens': 'what the calibration leaves of the lens, from a recording of turns',
    'kitti-to-bag': 'write a KITTI odometry sequence as a rosbag2',
    'demo': 'replay a sequence with D-JET and with re-projection error, and compare',
    'lab': 'measure and draw: errors, speed, memory, surfaces (djet lab --help)',
}
LAB = {
    'evaluate': 'estimate all pairs by several methods: tables and plots against ground truth',
    'ablate': 'estimate all pairs by variants of D-JET: what each part contributes',
    'closure': 'how well the rotations of three frames agree: no ground truth needed',
    'coverage': 'are poses as sure as they say? errors against covariances, scene by scene',
    'beside': 'what a gyro and masks are good for, on rendered scenes, with and without them',
    'lengths': 'how far do lengths drift, and are they as sure as they say? on rendered streets',
    'bench': 'measure the speed, as ratios against OpenCV from one run',
    'soak': 'run many frames through the odometry: does memory or latency grow?',
    'similarity': "draw how alike descriptors around keypoints are (the paper's Figure 1)",
    'surfaces': 'draw one match on its Hamming surface, round by round',
    'imu-offset': "find the offset of an IMU's clock, and how it is mounted, from a recording",
    'render': 'render a scene with exact ground truth as a KITTI sequence',
}


class _Parser(argparse.ArgumentParser):
    """
    A parser that reports a wrong command line in one line, without the whole usage.

    Options stand in full: ``--imu`` must not be ``--imu-topic`` where there is no ``--imu``.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'djet: error: {message} (see {self.prog} --help)\n')


# What ends a command beside Ctrl-C; SIGHUP comes where its terminal is closed.
_ENDS = (signal.SIGTERM, signal.SIGHUP)


class _Terminated(KeyboardInterrupt):
    """What such a signal raises, so that it ends as by Ctrl-C: nothing is left half done."""


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command line; the exit code is 2 for what the user can mend.

    It is 130 for Ctrl-C, 143 for SIGTERM and 129 for SIGHUP, as a shell would have it.
    """
    one_blas_thread()
    sleep_while_waiting()
    _print_anything()
    with _heeding_signals():
        return _main(argv)


def _main(argv: Sequence[str] | None) -> int:
    try:
        code = run(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
        return code
    except DjetError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        return _fail(_how_to_install(error))
    except _Terminated as end:
        # Of a terminal that was closed nothing is left to print to.
        with suppress(OSError):
            print('djet: terminated', file=sys.stderr)
        return 128 + int(end.args[0])
    except KeyboardInterrupt:
        print('djet: interrupted', file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has gone; Python would flush to it once more at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        return _fail(f'{error.filename}: {error.strerror}' if error.filename else str(error))


def _print_anything() -> None:
    """Let names of files that are no text, and signs that a terminal lacks, end no command."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')


@contextmanager
def _heeding_signals() -> Iterator[None]:
    """Let signals interrupt, unless the command or who started it has something else in mind."""
    ours = [number for number in _ENDS if current_thread() is main_thread()
            and signal.getsignal(number) is signal.SIG_DFL]
    for number in ours:
        signal.signal(number, _terminate)
    try:
        yield
    finally:
        for number in ours:
            if signal.getsignal(number) is _terminate:
                signal.signal(number, signal.SIG_DFL)


def _terminate(number: int, _: object) -> NoReturn:
    raise _Terminated(number)


def run(argv: Sequence[str]) -> int:
    """Run one subcommand, letting its exceptions through."""
    parser = _Parser(prog='djet', description='Visual odometry by D-JET, from bags and datasets.')
    parser.add_argument('--version', action='version', version=f'djet_ros {__version__}')
    _add_commands(parser, COMMANDS, argv)
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        args.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    code: int = args.run(args)
    return code


def _add_commands(parser: argparse.ArgumentParser, commands: dict[str, str],
                  words: Sequence[str], package: str = 'djet_ros.cli') -> None:
    """Add all commands by name, and the arguments of the one that the words call."""
    subparsers = parser.add_subparsers(metavar='COMMAND', required=True)
    place = _first_plain(words)
    for name, summary in commands.items():
        command = subparsers.add_parser(name, help=summary)
        if place is None or words[place] != name:
            continue
        if name == 'lab':
            command.description = 'Measure the odometry, and draw what goes on in it.'
            _add_commands(command, LAB, words[place + 1:], f'{package}.lab')
        else:
            module = import_module(f"{package}.{name.replace('-', '_')}")
            command.description = module.DESCRIPTION
            module.add_arguments(command)
            command.set_defaults(run=module.run, parser=command)


def _first_plain(words: Sequence[str]) -> int | None:
    """Where the first word stands that is no option."""
    return next((i for i, word in enumerate(words) if not word.startswith('-')), None)


def _how_to_install(error: ModuleNotFoundError) -> str:
    module = (error.name or '').partition('.')[0]
    if module in ('', 'djet_ros'):
        raise error
    return (f"this command needs the Python module '{module}', which is not installed: "
            f'{how_to_get(module)}')


def _fail(message: str) -> int:
    print(f'djet: error: {message}', file=sys.stderr)
    return 2
