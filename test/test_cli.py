"""The ``djet`` command: help, errors, and in real processes its signals."""

from __future__ import annotations

from pathlib import Path
import signal
import subprocess
import sys

from commands import alone, DJET, djet
import djet_ros
from djet_ros.cli.main import COMMANDS, LAB, main
import pytest

pytestmark = pytest.mark.slow

# The command with one more subcommand.
PROBE = """\
import sys
import types
from djet_ros.cli.main import COMMANDS, main
from djet_ros.errors import DjetError

def run(args):
    {body}

COMMANDS['probe'] = 'what one test needs'
probe = types.ModuleType('djet_ros.cli.probe')
probe.DESCRIPTION, probe.add_arguments, probe.run = '', lambda parser: None, run
sys.modules[probe.__name__] = probe
sys.exit(main(['probe']))
"""


def start_probe(body: str, *before: str) -> subprocess.Popen[str]:
    """Start a subcommand with this body; before: what runs it."""
    return subprocess.Popen([*before, sys.executable, '-c', PROBE.format(body=body)], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def verbs(folder: str) -> set[str]:
    """Return the commands that have a module in a folder of the package."""
    files = (Path(djet_ros.__file__).parent / folder).glob('*.py')
    return {path.stem.replace('_', '-') for path in files
            if 'def add_arguments(' in path.read_text()}


def test_the_lists_of_commands_are_the_lists_of_their_modules() -> None:
    assert set(COMMANDS) == verbs('cli') | {'lab'}
    assert set(LAB) == verbs('cli/lab')


@pytest.mark.parametrize(('call', 'commands'), [((), COMMANDS), (('lab',), LAB)])
def test_help_names_every_command_without_importing_any(
        call: tuple[str, ...], commands: dict[str, str]) -> None:
    listing = subprocess.run([sys.executable, '-X', 'importtime', *DJET[1:], *call, '--help'],
                             capture_output=True, text=True, timeout=60, check=False)
    assert listing.returncode == 0
    assert set(commands) <= set(listing.stdout.split())
    for library in ('numpy', 'cv2', 'rosbags', 'rich', 'matplotlib'):
        assert f'| {library}\n' not in listing.stderr


@pytest.mark.parametrize('command', [*COMMANDS, *(f'lab {verb}' for verb in LAB)])
def test_every_command_has_help_also_where_only_ascii_is_possible(command: str) -> None:
    answer = djet(*command.split(), '--help', encoding='ascii')
    assert (answer.returncode, answer.stderr) == (0, '')
    assert answer.stdout.startswith(f'usage: djet {command} ')


def test_without_gtsam_slam_shows_its_help_and_says_how_to_install_it() -> None:
    def slam(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, '-c', f"import sys; sys.modules['gtsam'] = None; {DJET[-1]}", 'slam',
             *arguments], capture_output=True, text=True, timeout=60, check=False)

    helped = slam('--help')
    assert (helped.returncode, helped.stderr) == (0, '')
    assert '--loop-gap' in helped.stdout
    refused = slam('results')
    assert refused.returncode == 2
    assert refused.stderr.startswith('djet: error: gtsam is missing: pip install ')
    assert 'djet_ros[slam]' in refused.stderr


def test_the_help_of_surfaces_has_the_defaults_of_its_own_preset() -> None:
    message = ' '.join(djet('lab', 'surfaces', '--help').stdout.split())
    assert '(default: paper, ' in message
    for name, value in (('window', 7), ('window-sigma', 0.0), ('max-iterations', 20),
                        ('step', "'share'"), ('step-share', 0.3)):
        _, _, meaning = message.rpartition(f' --{name} ')
        assert f'(default: {value})' == meaning[meaning.index('(default: '):].partition(' --')[0]


def test_a_size_beyond_the_largest_is_told_the_limit(tmp_path: Path) -> None:
    answer = djet('lab', 'render', 'road', str(tmp_path / 'out'), '--size', '100000x100000')
    assert answer.returncode == 2
    assert answer.stderr == ('djet: error: --size is 100000x100000; width and height must be '
                             'between 64 and 4096 pixels\n')


def test_the_version_is_the_packages() -> None:
    assert alone('--version').stdout == f'djet_ros {djet_ros.__version__}\n'


@pytest.mark.parametrize('arguments', [
    (), ('reply',), ('--fast',), ('--', 'demo', '--fast'), ('demo', '--fast'), ('-', 'demo'),
    ('lab',), ('lab', 'demo'), ('lab', 'bench', '--fast'), ('bench', '--help')])
def test_a_wrong_command_line_gives_one_line_and_exit_code_2(arguments: tuple[str, ...]) -> None:
    answer = djet(*arguments)
    assert answer.returncode == 2
    assert answer.stdout == ''
    assert answer.stderr.startswith('djet: error: ')
    assert answer.stderr.count('\n') == 1


@pytest.mark.parametrize('call', [
    ('slam', 'bag', '--imu', 'true'), ('lab', 'soak', '--output', 'f.json', '--frame', '9')])
def test_an_option_is_what_it_is_called_and_no_beginning_of_another(call: tuple[str, ...]
                                                                    ) -> None:
    answer = djet(*call)
    assert answer.returncode == 2
    command = ' '.join(call[:2] if call[0] == 'lab' else call[:1])
    assert answer.stderr == (f'djet: error: unrecognized arguments: {" ".join(call[-2:])} '
                             f'(see djet {command} --help)\n')


@pytest.mark.parametrize(('body', 'code', 'line'), [
    ('return 3', 3, ''),
    ("raise DjetError('calib.txt has no P0')", 2, 'djet: error: calib.txt has no P0\n'),
    ("open('/no/such/file')", 2, 'djet: error: /no/such/file: No such file or directory\n'),
    ('import no_such_library.part', 2,
     "djet: error: this command needs the Python module 'no_such_library', which is not "
     'installed: pip install no_such_library\n'),
])
def test_user_errors_give_one_line_and_exit_code_2(
        body: str, code: int, line: str) -> None:
    probe = start_probe(body)
    assert probe.communicate(timeout=60) == ('', line)
    assert probe.returncode == code


@pytest.mark.parametrize(('call', 'nodes'), [
    (('replay', 'bag', '--output', 'out', '--config'), '/vo_node'),
    (('lens', 'bag', '--config'), '/vo_node'),
    (('slam', 'bag', '--output', 'out', '--config'), '/vo_node and /pose_graph_node'),
    (('live', '-r', '__ns:=/rear', '--params'), '/rear/vo_node')])
def test_a_file_of_parameters_for_others_alone_is_refused_by_every_command_that_takes_one(
        tmp_path: Path, call: tuple[str, ...], nodes: str) -> None:
    if call[0] == 'slam':
        pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    path = tmp_path / 'theirs.yaml'
    path.write_text('/left/eye: {ros__parameters: {preset: fast}}')
    done = djet(*call, str(path))
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr == (
        f'djet: error: {path}: it has parameters for /left/eye and none for {nodes}, so it is '
        "ignored; name the node in the file, or use '/**' for all nodes\n")


@pytest.mark.parametrize('body', ["raise ValueError('a bug')", 'import djet_ros.no_such_module'])
def test_an_internal_error_keeps_its_traceback(body: str) -> None:
    probe = start_probe(body)
    assert probe.communicate(timeout=60)[1].startswith('Traceback')
    assert probe.returncode == 1


@pytest.mark.parametrize(('number', 'message', 'code'), [
    (signal.SIGINT, 'interrupted', 130), (signal.SIGTERM, 'terminated', 143),
    (signal.SIGHUP, 'terminated', 129)])
def test_an_interrupt_gives_one_line_and_the_exit_code_of_a_shell(
        number: signal.Signals, message: str, code: int) -> None:
    probe = start_probe("import time; print('ready', flush=True); time.sleep(60)")
    assert probe.stdout is not None
    assert probe.stdout.readline() == 'ready\n'
    probe.send_signal(number)
    assert probe.communicate(timeout=60) == ('', f'djet: {message}\n')
    assert probe.returncode == code


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP])
def test_a_call_from_python_keeps_its_signal_handler(
        tmp_path: Path, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    assert main(['replay', str(tmp_path / 'absent'), '--output', str(tmp_path / 'out')]) == 2
    assert signal.getsignal(number) is before


@pytest.mark.parametrize('body', ['time.sleep(1)', 'stop_by_signal().wait(1) and sys.exit(3)'])
def test_with_nohup_a_command_outlives_its_terminal(body: str) -> None:
    probe = start_probe('import time; from djet_ros.cli.graph_options import stop_by_signal; '
                        f"print('ready', flush=True); {body}", 'nohup')
    assert probe.stdout is not None
    assert probe.stdout.readline() == 'ready\n'
    probe.send_signal(signal.SIGHUP)
    assert probe.wait(timeout=60) == 0


@pytest.mark.parametrize('body', ["print('x' * 1_000_000)", "sys.stdin.read(); print('x')"])
def test_a_reader_that_leaves_early_is_no_error(body: str) -> None:
    probe = subprocess.Popen([sys.executable, '-c', PROBE.format(body=body)],
                             stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                             stderr=subprocess.PIPE)
    assert probe.stdin is not None
    assert probe.stdout is not None
    assert probe.stderr is not None
    probe.stdout.close()
    probe.stdin.close()
    assert probe.stderr.read() == b''
    assert probe.wait(timeout=60) == 141


def test_a_command_needs_no_stdout() -> None:
    done = subprocess.run(['sh', '-c', '"$@" >&-', 'sh', sys.executable, '-c',
                           PROBE.format(body="print('x')")], capture_output=True, text=True,
                          timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, '')


# Ends, unless a signal handler waits for the call that it interrupted.
# By default a thread that waits for the interpreter waits for 5 ms, between any two signals.
SIGNALS = """
import os, signal, sys, time
from threading import Thread
from djet_ros.cli.graph_options import stop_by_signal

def send():
    for _ in range(2000):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(2e-4)

sys.setswitchinterval(1e-4)
stop = stop_by_signal()
sender = Thread(target=send)
sender.start()
while sender.is_alive():
    stop.wait(1e-3)
assert stop.is_set()
"""


def test_a_signal_at_any_moment_stops_a_command_on_the_graph():
    assert subprocess.run([sys.executable, '-c', SIGNALS], timeout=60).returncode == 0
