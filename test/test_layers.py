"""Imports only go down: each room knows those below it, and none above or beside it."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import requires
from pathlib import Path
import re
import subprocess
import sys
from xml.etree import ElementTree

import djet_ros
from djet_ros.libraries import EXTRAS, REQUIREMENTS
import pytest

PACKAGE = Path(djet_ros.__file__).parent
MANIFEST = ElementTree.parse(Path(__file__).parents[1] / 'package.xml')
ROS_LIBRARIES = {depend.text for depend in MANIFEST.iter('exec_depend')}

# From the bottom up. Packages in one tuple do not import one another.
ORDER = (('__init__', 'errors', 'interrupts', 'libraries', 'threads'), ('compiled',), ('core',),
         ('config',), ('odometry',), ('recordings',), ('posegraph',), ('replay',), ('live',),
         ('ros', 'dds'), ('lab',), ('cli',))
FLOOR = {room: floor for floor, rooms in enumerate(ORDER) for room in rooms}

CORE_LIBRARIES = {'cv2', 'djet_ros', 'numpy', 'scipy'}
OUTSIDE_WORLD = {'argparse', 'glob', 'io', 'logging', 'os', 'pathlib', 'pickle', 'random',
                 'shutil', 'signal', 'socket', 'sqlite3', 'subprocess', 'sys', 'tempfile',
                 'threading'}
OUTSIDE_CALLS = {'eval', 'exec', 'input', 'open', 'print'}

Imports = dict[str, set[str]]


def dotted(path: Path) -> str:
    """Name of the module in a file of the package."""
    return '.'.join(path.relative_to(PACKAGE.parent).with_suffix('').parts)


@cache
def trees() -> dict[str, ast.Module]:
    """Parse all modules; not at import, which every worker does."""
    return {dotted(path): ast.parse(path.read_text(), path)
            for path in sorted(PACKAGE.rglob('*.py'))}


def room(module: str) -> str:
    """Room in which ``djet_ros.<room>...`` stands; names of the package itself are __init__'s."""
    name = module.split('.')[1]
    return name if name in FLOOR or (PACKAGE / name).exists() else '__init__'


def imported(tree: ast.AST) -> Iterator[str]:
    """All names that a module imports, in functions too; ``from a import b`` gives a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'a relative import of {node.module}'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


@cache
def all_imports() -> Imports:
    """Return what each module imports."""
    return {module: set(imported(tree)) for module, tree in trees().items()}


def libraries(module: str) -> set[str]:
    """Top-level packages that a module imports from."""
    return {name.partition('.')[0] for name in all_imports()[module]}


def upward(imports: Imports) -> set[tuple[str, str]]:
    """Find imports from a room above the module's own, or beside it."""
    return {(module, name) for module, names in imports.items() for name in names
            if name.startswith('djet_ros.') and room(name) != room(module)
            and FLOOR[room(name)] >= FLOOR[room(module)]
            and '__init__' not in (room(name), room(module))}


def cycle(imports: Imports) -> list[str]:
    """Find modules that import one another in a ring, or none."""
    def known(name: str) -> str | None:
        return name if name in imports else (
            name.rpartition('.')[0] if name.rpartition('.')[0] in imports else None)

    arrows = {module: sorted({end for end in map(known, names) if end and end != module})
              for module, names in imports.items()}
    done: set[str] = set()

    def search(module: str, chain: list[str]) -> list[str]:
        if module in chain:
            return [*chain[chain.index(module):], module]
        if module in done:
            return []
        found = next(filter(None, (search(end, [*chain, module]) for end in arrows[module])), [])
        done.add(module)
        return found

    return next(filter(None, (search(module, []) for module in arrows)), [])


def planted(module: str, name: str) -> Imports:
    """Return the imports as they would be with one more."""
    return {**all_imports(), module: all_imports()[module] | {name}}


def test_every_package_has_its_place_in_the_order() -> None:
    rooms = {path.stem for path in PACKAGE.iterdir()
             if path.suffix == '.py' or (path.is_dir() and any(path.glob('*.py')))}
    assert rooms == set(FLOOR)


@pytest.mark.slow
def test_no_module_imports_from_a_package_above_or_next_to_its_own() -> None:
    assert not upward(all_imports())


@pytest.mark.parametrize(('module', 'name'), [
    ('djet_ros.core.jet', 'djet_ros.config.sections.Config'),
    ('djet_ros.config.flat', 'djet_ros.odometry.frame.Frame'),
    ('djet_ros.posegraph.pose_graph', 'djet_ros.replay.results.BAG'),
    ('djet_ros.dds.graph', 'djet_ros.ros.vo_node.make'),
    ('djet_ros.live.session', 'djet_ros.lab.soak')])
def test_an_upward_import_is_detected(module: str, name: str) -> None:
    assert upward(planted(module, name)) == {(module, name)}


def test_no_modules_import_one_another_in_a_cycle() -> None:
    assert not cycle(all_imports())


def test_a_cycle_of_imports_is_detected() -> None:
    ring = cycle(planted('djet_ros.core.types', 'djet_ros.core.estimator.TwoViewEstimator'))
    assert ring[0] == ring[-1]
    assert {'djet_ros.core.types', 'djet_ros.core.estimator'} <= set(ring)


def in_room(name: str) -> Iterable[str]:
    return (module for module in trees() if module.split('.')[1] == name)


def test_the_core_uses_arrays_and_no_files_threads_or_terminals() -> None:
    for module in in_room('core'):
        assert libraries(module) <= (sys.stdlib_module_names - OUTSIDE_WORLD) | CORE_LIBRARIES
        called = {node.func.id for node in ast.walk(trees()[module])
                  if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert not called & OUTSIDE_CALLS, module


def test_packages_of_ros_are_imported_by_the_ros_package_only() -> None:
    users = {module for module in trees() if libraries(module) & ROS_LIBRARIES}
    assert users
    assert users <= set(in_room('ros'))


def test_a_missing_module_of_ros_names_the_package_in_package_xml() -> None:
    asked = {node.args[1].value for node in ast.walk(trees()['djet_ros.ros.parameters'])
             if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
             and node.func.id == '_require' and isinstance(node.args[1], ast.Constant)}
    assert asked == {'tf2-msgs', 'tf2-ros-py'}
    assert {str(package).replace('-', '_') for package in asked} <= ROS_LIBRARIES


@pytest.mark.slow
@pytest.mark.parametrize('node', ['odometry_node', 'graph_node'])
def test_a_live_node_loads_nothing_that_reads_recordings_draws_or_fills_terminals(
        node: str) -> None:
    # Ubuntu has no rosbags: a robot is to do without.
    if node == 'graph_node':
        pytest.importorskip('gtsam', reason='GTSAM is not installed: the extra slam')
    done = subprocess.run(
        [sys.executable, '-c', f'import sys, djet_ros.live.{node};'
         'print(*{name.partition(".")[0] for name in sys.modules})'],
        capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {'cv2', 'numpy', 'scipy', 'yaml'} <= loaded
    assert not loaded & {'apsw', 'backports', 'compression', 'lz4', 'matplotlib', 'rich',
                         'rosbags', 'sqlite3', 'zstandard'}


def name_of(requirement: str) -> str:
    return re.split(r'[<>=!;\[ ]', requirement)[0]


def test_every_library_is_a_declared_dependency() -> None:
    declared = {name_of(line) for line in requires('djet_ros') or []
                if not re.search(r'extra == .(test|lint)', line)}
    # Python 3.14 has zstd.
    known = sys.stdlib_module_names | {'compression', 'djet_ros'} | ROS_LIBRARIES
    undeclared = {(module, library) for module in trees() for library in libraries(module) - known
                  if name_of(REQUIREMENTS.get(library, library)) not in declared}
    assert not undeclared


def test_a_missing_library_names_the_extra_in_setup_py() -> None:
    declared = [line.replace('"', "'") for line in requires('djet_ros') or []]
    for library, extra in EXTRAS.items():
        assert any(name_of(line) == library and f"extra == '{extra}'" in line
                   for line in declared), library
    bounds = {name_of(line): set(re.findall(r'[<>=][^,; ]+', line.partition(';')[0]))
              for line in declared if 'extra' not in line}
    for requirement in REQUIREMENTS.values():
        versions = set(re.findall(r'[<>=][^,]+', requirement))
        assert not versions or versions == bounds[name_of(requirement)]
