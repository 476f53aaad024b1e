"""Where ROS is installed, its plugins import all test modules at collection, and none is lost."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

HERE = Path(__file__).parent

# As launch_testing does, where nothing that the tests can do without is installed.
PLUGIN = """
from importlib import import_module
import sys

for absent in ('cyclonedds', 'evo', 'gtsam', 'poselib', 'rclpy'):
    sys.modules[absent] = None


def pytest_pycollect_makemodule(module_path, parent):
    import_module(module_path.stem)
"""


@pytest.mark.slow
def test_every_module_is_collected_where_a_plugin_imports_them_and_libraries_are_missing(
        tmp_path: Path) -> None:
    (tmp_path / 'eager.py').write_text(PLUGIN)
    paths = os.pathsep.join(filter(None, [str(tmp_path), str(HERE.parent),
                                          os.environ.get('PYTHONPATH', '')]))
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '--collect-only', '-q', '-p', 'eager', '-p',
         'no:cacheprovider', str(HERE)],
        # colcon hands its own options on in PYTEST_ADDOPTS
        env={**os.environ, 'PYTHONPATH': paths, 'PYTEST_ADDOPTS': ''},
        capture_output=True, text=True, cwd=HERE.parent, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    collected = [line.partition('::')[0] for line in done.stdout.splitlines() if '::' in line]
    modules = {path.name for path in HERE.glob('test_*.py')}
    assert {Path(name).name for name in collected} == modules
    assert len(collected) > 1000
    # colcon waits for ever on a line beyond 64 KiB, such as the name of a test with its input
    assert max(map(len, done.stdout.splitlines())) < 2**16
