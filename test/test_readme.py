"""Everything that the pages name exists, and their generated blocks match the data."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
import json
from pathlib import Path
import re
import shlex
import shutil
import subprocess
import sys
from typing import Any

import djet_ros
from djet_ros.cli.main import main
from djet_ros.core.geometry import direction_angle, rotation_angle
from djet_ros.core.matching import MIN_RIGID_SHARE
from djet_ros.lab.scenes import make_scene
import numpy as np
import pytest
from test_layers import ORDER
import yaml

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
DOC = ROOT / 'doc'
PAGES = [ROOT / 'README.md', *sorted(DOC.glob('*.md'))]

each_page = pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)


def data(name: str) -> Any:
    return yaml.safe_load((DOC / f'{name}.yaml').read_text())


@cache
def functions_in(file: str) -> set[str]:
    tree = ast.parse((ROOT / 'test' / file).read_text())
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def exists(test: str) -> bool:
    file, _, name = test.partition('::')
    return (ROOT / 'test' / file).exists() and (not name or name in functions_in(file))


def test_the_readme_is_short():
    assert len((ROOT / 'README.md').read_bytes()) <= 8000


def test_the_printed_distortion_of_a_drive_is_the_measured_one():
    part = json.loads((DOC / 'results.json').read_text())['parts']['drive kitti 03']['lens']
    page = (DOC / 'scale.md').read_text()
    assert f'k1 = {part["k1"]:.4f} +- {part["sigma"]:.4f}, from ' in page
    assert set(re.findall(r'--residual-k1 ([\d.]+)', page)) == {f'{part["k1"]:.5f}'}


def examples(page):
    return re.findall(r'```python\n(.*?)```', (ROOT / page).read_text(), re.DOTALL)


@pytest.fixture(scope='module')
def road():
    """Return images of a street for the examples, and true poses (3, 4, 4)."""
    scene = make_scene('road', 0, (620, 188))
    poses = scene.trajectory(3)
    images = [scene.render(pose, index) for index, pose in enumerate(poses)]
    return {'K': scene.K, 'one': images[0], 'other': images[1],
            'images': [(10**9 + 10**8 * i, image) for i, image in enumerate(images)]}, poses


def test_the_example_of_a_pair_estimates_the_motion_between_two_images(road, capsys):
    names, poses = road
    names = dict(names)
    exec(examples('doc/without-ros.md')[0], names)
    assert capsys.readouterr().out.startswith('OK [[')
    pair, true = names['pair'], np.linalg.inv(poses[1]) @ poses[0]
    assert pair.status is djet_ros.Status.OK
    assert np.degrees(rotation_angle(pair.R, true[:3, :3])) < 0.1
    assert np.degrees(direction_angle(pair.t, true[:3, 3])) < 1


@pytest.mark.parametrize(('page', 'index'), [('README.md', 0), ('doc/without-ros.md', 1)])
def test_the_examples_of_an_odometry_estimate_the_path_of_a_camera(road, capsys, page, index):
    names, poses = road
    names = dict(names)
    exec(examples(page)[index], names)
    assert re.findall('^[A-Z_]+', capsys.readouterr().out, re.MULTILINE) == [
        'FIRST_FRAME', 'OK', 'OK']
    pose, true = names['result'].pose, np.linalg.inv(poses[0]) @ poses[2]
    assert np.degrees(rotation_angle(pose[:3, :3], true[:3, :3])) < 0.1
    assert np.degrees(direction_angle(pose[:3, 3], true[:3, 3])) < 1


def test_the_package_imports_its_api_lazily():
    subprocess.run([sys.executable, '-c', 'import sys, djet_ros\n'
                    'assert not {"numpy", "cv2", "scipy"} & set(sys.modules)\n'
                    'from djet_ros import *\n'
                    'assert set(djet_ros.__all__) <= set(globals())\n'
                    'TwoViewEstimator(preset("fast"))\n'
                    'assert "matplotlib" not in sys.modules\n'
                    'assert not hasattr(djet_ros, "Statues")'], check=True)


def test_the_generated_blocks_match_the_data():
    done = subprocess.run([sys.executable, DOC / 'pages.py', '--check'], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_block_edited_by_hand_is_detected_and_restored(tmp_path):
    shutil.copytree(DOC, tmp_path / 'doc')
    readme = tmp_path / 'README.md'
    whole = (ROOT / 'README.md').read_text()
    readme.write_text(whole.replace('<!-- generated: summary -->\n',
                                    '<!-- generated: summary -->\nD-JET is the best.\n'))
    command = [sys.executable, tmp_path / 'doc' / 'pages.py']
    output = subprocess.run([*command, '--check'], capture_output=True, text=True, check=False)
    assert output.returncode == 1
    assert 'README.md' in output.stderr
    subprocess.run(command, check=True)
    assert readme.read_text() == whole


def complaints_of_the_code() -> set[tuple[str, str]]:
    """Return the warnings of the diagnostics as patterns of their names, with their levels."""
    found = set()
    for path in (ROOT / 'djet_ros').rglob('*.py'):
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and getattr(call.func, 'id', '') == 'Complaint':
                name, level = call.args[:2]
                parts = name.values if isinstance(name, ast.JoinedStr) else [name]
                found.add((''.join(re.escape(one.value) if isinstance(one, ast.Constant)
                                   else r'\w+' for one in parts), level.value))
    return found


def test_the_table_of_warnings_has_those_of_the_code_and_no_others():
    listed = {(one['name'], one['level']) for one in data('complaints')}
    code = complaints_of_the_code()
    fits = {(name, level): [one for one in code if one[1] == level and re.fullmatch(one[0], name)]
            for name, level in listed}
    assert all(len(found) == 1 for found in fits.values())
    assert {one for found in fits.values() for one in found} == code


def test_every_guarantee_and_every_answer_names_tests_that_exist():
    promises = data('promises')
    assert promises and all(one['tests'] for one in promises)
    for one in [*promises, *data('reports')]:
        for test in one['tests']:
            assert exists(test), test


@each_page
def test_every_test_that_is_named_exists(page):
    for test in re.findall(r'`(test_\w+\.py(?:::test_\w+)?)`', page.read_text()):
        assert exists(test), test


@each_page
def test_every_make_target_that_is_named_exists(page):
    makefile, text = (ROOT / 'Makefile').read_text(), page.read_text()
    for target in [*re.findall(r'`make ([a-z]+)', text),
                   *(arguments[1] for arguments in commands(text) if arguments[0] == 'make')]:
        assert f'\n{target}:' in makefile, target


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command in the blocks of shell code."""
    for block in re.findall(r'^```(?:sh|bash)\n(.*?)^```', text, re.MULTILINE | re.DOTALL):
        for command in re.split(r'\n|&&', block):
            arguments = shlex.split(command, comments=True)
            if arguments:
                yield arguments


def calls(text: str) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Yield subcommands and options of djet in blocks of code, and its subcommands in text."""
    for arguments in commands(text):
        if arguments[0] == 'djet':
            options = tuple(word.partition('=')[0] for word in arguments if word.startswith('-'))
            yield tuple(arguments[1:3 if arguments[1] == 'lab' else 2]), options
    for verbs in re.findall(r'`djet ((?:lab )?[a-z][a-z-]*)', text):
        yield tuple(verbs.split()), ()


@each_page
def test_every_command_and_option_that_is_named_exists(page, capsys):
    for verbs, options in set(calls(page.read_text())):
        with pytest.raises(SystemExit) as ended:
            main([*verbs, '--help'])
        assert ended.value.code == 0, verbs
        output = capsys.readouterr().out
        for option in options:
            assert re.search(rf'(?<![\w-]){option}(?![\w-])', output), (verbs, option)


@each_page
def test_every_linked_file_and_section_exists(page):
    for target in re.findall(r'\]\(([^)]+)\)', page.read_text()):
        name, _, section = target.partition('#')
        if '://' in target:
            continue
        linked = page.parent / name if name else page
        assert linked.exists(), target
        assert not section or section in sections(linked), target


def sections(page: Path) -> list[str]:
    """Return the anchors of the headings of a page."""
    return [re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-')
            for title in re.findall(r'^#+ (.+)$', page.read_text(), re.MULTILINE)]


def test_the_packages_on_the_design_page_are_the_folders_in_order_of_imports():
    listed = [set(level) for level in data('rooms')]
    folders = {path.parent.name for path in ROOT.glob('djet_ros/*/__init__.py')}
    assert set().union(*listed) == folders
    assert listed == [set(rooms) & folders for rooms in reversed(ORDER) if set(rooms) & folders]


def test_the_design_page_states_the_share_of_inliers_that_predicted_matches_need():
    assert f'no more than {MIN_RIGID_SHARE * 100:.0f} % of its matches agree' in (
        DOC / 'design.md').read_text()


def test_no_host_of_a_package_registry_is_named():
    hosts = re.compile('|'.join((r'pypi\.' + 'org', 'python' + 'hosted', r'crates\.' + 'io')))
    tracked = subprocess.run(['git', 'ls-files'], cwd=ROOT, capture_output=True, text=True,
                             check=False).stdout.split() or PAGES
    named = [path for path in tracked if hosts.search(
        (ROOT / path).read_bytes().decode('utf-8', 'replace'))]
    assert not named
