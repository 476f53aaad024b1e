"""The figures of processes on a graph: doc/record.py always ends."""

from __future__ import annotations

from pathlib import Path
import re
import shlex
import shutil
import subprocess
import sys

from dds_graph import ENVIRONMENT, needs_dds
from djet_ros.lab.scenes import render_sequence
import pytest
import yaml

pytestmark = [needs_dds, pytest.mark.slow]

DOC = Path(__file__).parents[1] / 'doc'
LIVE = shlex.join([sys.executable, '-c', 'from djet_ros.cli.main import main; '
                   'raise SystemExit(main())', 'live'])


@pytest.fixture(scope='module')
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_sequence('road', tmp_path_factory.mktemp('street'), 30, size=(320, 240))


@pytest.fixture
def place(street: Path, tmp_path: Path) -> Path:
    """Return a folder with the script, its figures, and a rendered street as KITTI 06."""
    for name in ('record.py', 'recorded.yaml'):
        shutil.copy(DOC / name, tmp_path)
    (tmp_path / 'kitti' / 'sequences').mkdir(parents=True)
    shutil.copytree(street, tmp_path / 'kitti' / 'sequences' / '06')
    return tmp_path


def record(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Measure tables, with a short PATIENCE."""
    return subprocess.run(
        [sys.executable, '-c', 'import record; record.PATIENCE = 5; raise SystemExit('
         'record.main())', *arguments, '--data', place], cwd=place, env=ENVIRONMENT,
        capture_output=True, text=True, timeout=120, check=False)


def tables(place: Path) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = yaml.safe_load((place / 'recorded.yaml').read_text())
    return found


def test_a_node_that_exits_is_reported_in_one_line_and_other_tables_are_kept(place: Path) -> None:
    before = tables(place)
    done = record(place, 'dds', 'node', '--node', 'echo there is no ROS >&2; exit 3;')
    assert done.returncode == 1
    assert done.stdout == 'dds\n'
    assert done.stderr == ('record.py: error: node: vo_node: visual odometry ended with status 3: '
                           'there is no ROS\n')
    after = tables(place)
    (_, processed), *_ = after.pop('dds')['rows']
    worked_on, of, dropped = map(int, re.findall('[0-9]+', processed))
    assert worked_on + dropped == of == 30
    before.pop('dds')
    assert after == before


def test_waiting_for_images_that_never_come_ends(place: Path) -> None:
    before = tables(place)
    # The first of two remappings counts, so the node does not receive the images of the player.
    done = record(place, 'node', '--node', f'exec {LIVE} -r image:=/elsewhere')
    assert done.returncode == 1
    assert done.stderr == ('record.py: error: node: 0 of 30 images came to anything, and nothing '
                           'more for 5 s; are messages lost on the way?\n')
    assert tables(place) == before
