"""Parameter files in YAML, with plain sections or in the ros__parameters layout."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import json
from pathlib import Path
import re
import textwrap
from typing import Any

from djet_ros.config.flat import flat, from_flat, section, shown, Value
from djet_ros.config.safe_files import read_yaml
from djet_ros.config.sections import Config, GRAPH_NAME, NODE_NAME, SECTIONS
from djet_ros.core.estimator_config import preset
from djet_ros.errors import DjetError

# Parameters of every ROS node, which these commands ignore.
_ROS_OWN = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


_YAML_HEAD = """\
# Parameters of the nodes, also read by `djet replay` and `djet slam` with --config FILE.
# Generated from djet_ros/config by dump_yaml; a test checks that it is up to date.
"""


_PRESET_NOTE = """\
# Values set by the preset are commented out; uncomment one to override it.
"""


def load_yaml(path: Path, take: Callable[[Mapping[str, Any]], Config] = from_flat,
              nodes: Sequence[str] = (NODE_NAME,)) -> Config:
    """
    Return the configuration of a YAML file.

    Both layouts are read: plain nested sections, and ROS's ``node: ros__parameters:`` with
    namespaces and wildcards. nodes: the nodes whose parameters are read, by full name such as
    '/left/vo_node', or without a leading slash for that node in any namespace. Of the pose graph
    node only slam.* is read. take: makes the configuration from the values by flat name.

    Raises DjetError, beginning with the path, if the file is not such a file or has no
    parameters for these nodes.
    """
    content = read_yaml(path)
    try:
        return take(_flattened(_ours(content, nodes)))
    except DjetError as error:
        raise DjetError(f'{path}: {error}') from None


def _ours(content: Any, nodes: Sequence[str]) -> Any:
    """Select the parameters of some nodes from ROS's layout; a plain layout is kept."""
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise DjetError('the file must hold sections with parameters')
    parts = list(_addressed(content))
    if not parts:
        return content
    full = [_full_name(node, [name for name, _ in parts]) for node in nodes]
    found = [(node, parameters) for node in full for name, parameters in parts
             if _is_for(name, node)]
    if not found:
        raise DjetError(_for_others((name for name, _ in parts), full))
    return {key: value for node, parameters in found
            for key, value in _flattened(parameters).items() if not is_ros_own(key)
            and (_last(node) != GRAPH_NAME or key.startswith('slam.'))}


def _full_name(node: str, names: Sequence[str]) -> str:
    """Return the full name of a node in a file with these names; DjetError if ambiguous."""
    if node.startswith('/') or f'/{node}' in names:
        return f'/{node.strip("/")}'
    found = {name for name in names if _last(name) == node and '*' not in name}
    if len(found) > 1:
        raise DjetError(f'it has parameters for {" and ".join(sorted(found))}, and only one of '
                        'them can be used; give a file with the parameters of that one')
    return found.pop() if found else f'/{node}'


def why_unused(path: Path, node: str) -> str:
    """
    Return why a ROS parameter file has no effect on a node, or '' if it has one.

    node: full name, such as '/left/vo_node'. DjetError if the file cannot be read.
    """
    names = [name for name, _ in _addressed(read_yaml(path))]
    return '' if any(_is_for(name, node) for name in names) else (
        f'{path}: {_for_others(names, [node])}')


def _for_others(names: Iterable[str], nodes: Sequence[str]) -> str:
    return (f'it has parameters for {", ".join(names) or "no node"} and none for '
            f"{' and '.join(nodes)}, so it is ignored; name the node in the file, or use '/**' "
            'for all nodes')


# Nesting of namespaces that is followed at most.
_DEPTH = 20


def _addressed(content: Any, above: str = '', depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield node names, which may have wildcards, with their parameters in a file."""
    if not isinstance(content, dict) or depth > _DEPTH:
        return
    for key, value in content.items():
        if key == 'ros__parameters':
            yield above, value
        else:
            yield from _addressed(value, f'{above}/{str(key).strip("/")}', depth + 1)


def _is_for(name: str, node: str) -> bool:
    """Return whether a name in a file, which may have wildcards, matches a node as in ROS."""
    wildcards = {'**': r'(/\w+)*', '*': r'/\w+'}
    pattern = ''.join(wildcards.get(part, f'/{re.escape(part)}') for part in name.split('/')[1:])
    return re.fullmatch(pattern, node) is not None


def _last(name: str) -> str:
    return name.rpartition('/')[2]


def is_ros_own(name: str) -> bool:
    """Return whether a parameter is one of every ROS node, such as use_sim_time."""
    return name.partition('.')[0] in _ROS_OWN


def _flattened(content: Any) -> dict[str, Any]:
    """Return values by flat name; DjetError if one is given nested and by its flat name."""
    values: dict[str, Any] = {}
    for name, value in _flat_items(content):
        if name in values:
            raise DjetError(f"'{name}' is given twice, in its section and by its flat name; "
                            'remove one')
        values[name] = value
    return values


def _flat_items(content: Any) -> Iterator[tuple[str, Any]]:
    """Yield flat names and values; only one level is entered, so the depth is bounded."""
    if not isinstance(content, dict):
        raise DjetError(f'expected a mapping of parameters, but found {shown(content)}')
    for key, value in content.items():
        name = str(key)
        if isinstance(value, dict) and value and '.' not in name and not is_ros_own(name):
            yield from ((f'{name}.{inner}', inner_value) for inner, inner_value in value.items())
        elif name not in SECTIONS or value not in (None, {}):
            yield name, value


def dump_yaml(config: Config, parts: Sequence[str] = ('', *SECTIONS), *,
              preset_as_comments: bool = False) -> str:
    """
    Return the configuration as YAML in ROS's layout, with descriptions as comments.

    parts: the sections to write; '' is the top level. preset_as_comments: comment out the
    estimator's values that equal those of the preset, so that the preset can still be chosen.
    """
    silent = set()
    if preset_as_comments and 'estimator' in parts:
        given = flat(replace(config, estimator=preset(config.preset)))
        silent = {item.name for item in section(config, 'estimator')
                  if item.value == given[item.name].value}
    texts = []
    for part in parts:
        lines = [f'    {part}:'] if part else []
        indent = '      ' if part else '    '
        for item in section(config, part):
            lines += textwrap.wrap(item.description.explained, 97, initial_indent=f'{indent}# ',
                                   subsequent_indent=f'{indent}# ')
            mark = '# ' if item.name in silent else ''
            name = item.name.rpartition('.')[2]
            lines.append(f'{indent}{mark}{name}: {_yaml_scalar(item.value)}')
        if part and silent.issuperset(item.name for item in section(config, part)):
            # A section without values would be null, which ROS refuses.
            lines[0] = f'    # {part}:'
        texts.append('\n'.join(lines) + '\n')
    return (_YAML_HEAD + (_PRESET_NOTE if silent else '') + '/**:\n  ros__parameters:\n'
            + '\n'.join(texts))


def _yaml_scalar(value: Value) -> str:
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition('e')
        # YAML 1.1 reads 1e-06 as a string, and 1.0e-06 as a number.
        return f'{mantissa}.0e{exponent}' if e and '.' not in mantissa else repr(value)
    return json.dumps(value)
