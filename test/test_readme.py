"""What the README names exists: tests, make targets, commands and linked files."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
import re

from djet_ros.cli.main import COMMANDS

ROOT = Path(__file__).parents[1]
README = (ROOT / 'README.md').read_text()


@cache
def functions_in(file: str) -> set[str]:
    tree = ast.parse((ROOT / 'test' / file).read_text())
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_every_test_that_is_named_exists() -> None:
    named = re.findall(r'`(test_\w+\.py|…)(?:::(test_\w+))?`', README)
    assert len(named) > 40
    file = ''
    for where, name in named:
        file = file if where == '…' else where
        assert not name or name in functions_in(file), f'{file}::{name}'


def test_every_promise_names_a_test() -> None:
    section = README.split('\n## What is promised')[1].split('\n## ')[0]
    rows = re.findall(r'^\| (.+) \| (.+) \|$', section, re.MULTILINE)[2:]
    assert len(rows) > 12
    for promise, held_by in rows:
        assert '::test_' in held_by, promise


def test_every_make_target_and_command_that_is_named_exists() -> None:
    makefile = (ROOT / 'Makefile').read_text()
    for target in re.findall(r'(?:^|`)make ([a-z]+)', README, re.MULTILINE):
        assert f'\n{target}:' in makefile, target
    for command in re.findall(r'(?:^|`)\s*djet ([a-z][a-z-]*)', README, re.MULTILINE):
        assert command in COMMANDS, command


def test_every_linked_file_and_section_exists() -> None:
    titles = [re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-')
              for title in re.findall(r'^#+ (.+)$', README, re.MULTILINE)]
    for target in re.findall(r'\]\(([^)]+)\)', README):
        if target.startswith('#'):
            assert target[1:] in titles, target
        elif '://' not in target:
            assert (ROOT / target).exists(), target
