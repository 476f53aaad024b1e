"""Imports only go down: faces, then odometry and data, then the core."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib.metadata import requires
from pathlib import Path
import re
import sys
from xml.etree import ElementTree

import djet_ros
from djet_ros.cli.main import DISTRIBUTIONS

PACKAGE = Path(djet_ros.__file__).parent
MANIFEST = ElementTree.parse(Path(__file__).parents[1] / 'package.xml')
ROS_LIBRARIES = {depend.text for depend in MANIFEST.iter('exec_depend')}

FLOORS = {'cli': 3, 'dds': 3, 'ros': 3, 'core': 1, '__init__': 1}
ALL_OTHERS = 2

CORE_LIBRARIES = {'cv2', 'djet_ros', 'numpy', 'scipy'}
OUTSIDE_WORLD = {'argparse', 'glob', 'io', 'logging', 'os', 'pathlib', 'pickle', 'random',
                 'shutil', 'signal', 'socket', 'sqlite3', 'subprocess', 'sys', 'tempfile',
                 'threading'}
OUTSIDE_CALLS = {'eval', 'exec', 'input', 'open', 'print'}


def dotted(path: Path) -> str:
    """Name of the module in a file of the package."""
    return '.'.join(path.relative_to(PACKAGE.parent).with_suffix('').parts)


TREES = {dotted(path): ast.parse(path.read_text(), path)
         for path in sorted(PACKAGE.rglob('*.py'))}


def floor(module: str) -> int:
    """Floor on which ``djet_ros.<part>...`` stands."""
    return FLOORS.get(module.split('.')[1], ALL_OTHERS)


def imported(module: str) -> Iterator[str]:
    """All names that a module imports, in functions too; ``from a import b`` gives a.b."""
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{module} has a relative import'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def libraries(module: str) -> set[str]:
    """Top-level packages that a module imports from."""
    return {name.partition('.')[0] for name in imported(module)}


def test_no_module_imports_from_a_floor_above_its_own() -> None:
    upward = [(module, name) for module in TREES for name in imported(module)
              if name.startswith('djet_ros.') and floor(name) > floor(module)]
    assert not upward


def test_the_core_knows_arrays_and_nothing_of_files_threads_or_terminals() -> None:
    for module in (module for module in TREES if floor(module) == 1):
        assert libraries(module) <= (sys.stdlib_module_names - OUTSIDE_WORLD) | CORE_LIBRARIES
        called = {node.func.id for node in ast.walk(TREES[module])
                  if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert not called & OUTSIDE_CALLS, module


def test_what_comes_with_ros_is_imported_by_the_ros_face_only() -> None:
    users = {module for module in TREES if libraries(module) & ROS_LIBRARIES}
    assert users
    assert all(module.startswith('djet_ros.ros.') for module in users)


def test_every_library_is_a_declared_dependency() -> None:
    declared = {re.split(r'[<>=!;\[ ]', line)[0] for line in requires('djet_ros') or []
                if not re.search(r'extra == .(test|lint)', line)}
    # Python 3.14 has zstd.
    known = sys.stdlib_module_names | {'compression', 'djet_ros'} | ROS_LIBRARIES
    undeclared = {(module, library) for module in TREES for library in libraries(module) - known
                  if DISTRIBUTIONS.get(library, library) not in declared}
    assert not undeclared
