"""The linters of ROS 2 find nothing; without ROS, ``make lint`` applies the same rules."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = [str(ROOT / name) for name in ('djet_ros', 'launch', 'setup.py', 'test')]


@pytest.mark.parametrize(('linter', 'options'), [
    ('ament_flake8', ['--config', str(ROOT / 'setup.cfg')]), ('ament_pep257', [])])
def test_a_linter_finds_nothing(linter: str, options: list[str]) -> None:
    pytest.importorskip(linter, reason='comes with ROS 2')
    assert import_module(f'{linter}.main').main([*SOURCES, *options]) == 0
