"""Entry point of the ``djet`` command: subcommands, signals and error handling."""

from __future__ import annotations

import argparse
import atexit
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
import gc
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

# Only the module of the called command is imported: help is fast, and no command needs the
# libraries of another.
COMMANDS = {
    'replay': 'estimate the trajectory of a camera from a recording',
    'live': 'run the odometry on a ROS 2 graph, without ROS',
    'play': 'publish a recording on a ROS 2 graph, without ROS',
    'echo': 'print poses or diagnostics of a running odometry',
    'slam': 'close loops offline and optimise the pose graph with GTSAM',
    'export': 'write the pose graph of a replay for a SLAM back end',
    'lens': 'estimate the residual radial distortion of a calibrated camera',
    'kitti-to-bag': 'convert a KITTI odometry sequence to a rosbag2',
    'demo': 'replay a sequence with D-JET and with re-projection error, and compare',
    'lab': 'evaluate and plot: errors, speed, memory, surfaces (djet lab --help)',
}
LAB = {
    'evaluate': 'compare methods on all pairs of sequences, against ground truth',
    'ablate': 'compare variants of D-JET on all pairs: the contribution of each part',
    'closure': 'rotation closure error of frame triplets, without ground truth',
    'coverage': 'covariance calibration: coverage of ellipsoids and NEES, scene by scene',
    'beside': 'benefit of a gyro and of masks, on rendered scenes',
    'lengths': 'scale drift and its covariance, on rendered streets',
    'bench': 'measure the speed, as ratios to an OpenCV pipeline in the same run',
    'soak': 'long run: does memory or latency grow?',
    'similarity': "plot descriptor distances around keypoints (the paper's Figure 1)",
    'surfaces': 'plot one match on its Hamming surface, iteration by iteration',
    'imu-offset': 'estimate time offset and rotation between IMU and camera, and the gyro bias',
    'render': 'render a scene with exact ground truth as a KITTI sequence',
}


class _Parser(argparse.ArgumentParser):
    """
    Parser that reports a wrong command line in one line, without the usage text.

    Options cannot be abbreviated: if a command lacks ``--imu``, that must not mean
    ``--imu-topic``.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f'djet: error: {message} (see {self.prog} --help)\n')


# Signals that end a command like Ctrl-C; SIGHUP is sent when its terminal closes.
_TERMINATING = (signal.SIGTERM, signal.SIGHUP)


class _Terminated(KeyboardInterrupt):
    """Raised by these signals, so that a command cleans up as it does after Ctrl-C."""


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command line and return its exit code.

    It is 2 for errors that the user can correct, and by the convention of shells 130 for Ctrl-C,
    143 for SIGTERM and 129 for SIGHUP.
    """
    one_blas_thread()
    sleep_while_waiting()
    # What the system frees at once, the interpreter would search for cycles for a third of a
    # second.
    atexit.register(gc.freeze)
    _escape_unprintable()
    with _terminating_signals():
        return _main(argv)


def _main(argv: Sequence[str] | None) -> int:
    try:
        code = run(sys.argv[1:] if argv is None else argv)
        # As print does, without a stdout do nothing.
        print(end='', flush=True)
        return code
    except DjetError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        return _fail(_how_to_install(error))
    except _Terminated as end:
        # After SIGHUP the terminal may be gone.
        with suppress(OSError):
            print('djet: terminated', file=sys.stderr)
        return 128 + int(end.args[0])
    except KeyboardInterrupt:
        print('djet: interrupted', file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has closed it; Python would fail to flush once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        return _fail(f'{error.filename}: {error.strerror}' if error.filename else str(error))


def _escape_unprintable() -> None:
    """Escape what stdout cannot encode: undecodable file names, characters missing in ASCII."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')


@contextmanager
def _terminating_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise, except those that already have another handler."""
    ours = [number for number in _TERMINATING if current_thread() is main_thread()
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
    """Run one subcommand and return its exit code; its exceptions propagate."""
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
    """Add all commands by name, and the arguments of the one that is called."""
    subparsers = parser.add_subparsers(metavar='COMMAND', required=True)
    place = _first_positional(words)
    for name, summary in commands.items():
        command = subparsers.add_parser(name, help=summary)
        if place is None or words[place] != name:
            continue
        if name == 'lab':
            command.description = 'Evaluate the odometry, and plot its intermediate results.'
            _add_commands(command, LAB, words[place + 1:], f'{package}.lab')
        else:
            module = import_module(f"{package}.{name.replace('-', '_')}")
            command.description = module.DESCRIPTION
            module.add_arguments(command)
            command.set_defaults(run=module.run, parser=command)


def _first_positional(words: Sequence[str]) -> int | None:
    """Return the index of the first word that is not an option."""
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
