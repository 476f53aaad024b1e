"""The configuration as YAML, plain or in the layout of ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import json
from pathlib import Path
import re
import textwrap
from typing import Any

from djet_ros.config.flat import explain, flat, section, shown, Value, with_values
from djet_ros.config.safe_files import read_yaml
from djet_ros.config.sections import Config, GRAPH_NAME, NODE_NAME, SECTIONS
from djet_ros.core.estimator_config import preset
from djet_ros.errors import DjetError

# Parameters that every ROS node may find in its section and that are not ours to judge.
_ROS_OWN = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


_YAML_HEAD = """\
# Parameters of the nodes, also read by `djet replay` and `djet slam` with --config FILE.
# Made from djet_ros/config by its dump_yaml; a test holds that the two agree.
"""


_PRESET_NOTE = """\
# The values that the preset sets are shown as comments; uncomment one to change it.
"""


def load_yaml(path: Path, take: Callable[[Config, Mapping[str, Any]], Config] = with_values,
              nodes: Sequence[str] = (NODE_NAME,)) -> Config:
    """
    Read a YAML file over the defaults.

    take: how these take the values; nodes: for whom it is read, by full names such as
    '/left/vo_node', or without a slash in whichever namespace the file has it. Of the pose graph's
    own parameters slam.* alone are taken.

    Both layouts are read: plain nested sections, and ROS's ``node: ros__parameters:`` with
    namespaces and wildcards. Raises DjetError, beginning with the path, on anything that is not
    such a file, and where nothing of it is for these nodes.
    """
    content = read_yaml(path)
    try:
        return take(Config(), dict(_flatten(_ours(content, nodes))))
    except DjetError as error:
        raise DjetError(f'{path}: {error}') from None


def _ours(content: Any, nodes: Sequence[str]) -> Any:
    """Take the parameters of some nodes out of ROS's layout; a plain layout stays as it is."""
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
    return {key: value for node, parameters in found for key, value in _flatten(parameters)
            if not is_ros_own(key)
            and (_last(node) != GRAPH_NAME or key.startswith('slam.'))}


def _full_name(node: str, names: Sequence[str]) -> str:
    """Give the full name that a file, by the names in it, has for a node; DjetError if several."""
    if node.startswith('/') or f'/{node}' in names:
        return f'/{node.strip("/")}'
    found = {name for name in names if _last(name) == node and '*' not in name}
    if len(found) > 1:
        raise DjetError(f'it is for {" and ".join(sorted(found))}, and one of them is meant; '
                        'give a file for that one')
    return found.pop() if found else f'/{node}'


def why_unused(path: Path, node: str) -> str:
    """
    Say that a file of ROS parameters is for other nodes alone; nothing where it is for this one.

    node: its full name, such as '/left/vo_node'. DjetError where the file can't be read.
    """
    names = [name for name, _ in _addressed(read_yaml(path))]
    return '' if any(_is_for(name, node) for name in names) else (
        f'{path}: {_for_others(names, [node])}')


def _for_others(names: Iterable[str], nodes: Sequence[str]) -> str:
    return (f'it is for {", ".join(names) or "no node"}, and nothing is taken from it: this is '
            f"{' and '.join(nodes)}; '/**' is for all")


# Namespaces in one another, deeper than anybody's.
_DEPTH = 20


def _addressed(content: Any, above: str = '', depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Give names of nodes, perhaps with wildcards, and the parameters that a file has for them."""
    if not isinstance(content, dict) or depth > _DEPTH:
        return
    for key, value in content.items():
        if key == 'ros__parameters':
            yield above, value
        else:
            yield from _addressed(value, f'{above}/{str(key).strip("/")}', depth + 1)


def _is_for(name: str, node: str) -> bool:
    """Tell whether ROS takes a name, perhaps with wildcards, for that of a node."""
    wildcards = {'**': r'(/\w+)*', '*': r'/\w+'}
    pattern = ''.join(wildcards.get(part, f'/{re.escape(part)}') for part in name.split('/')[1:])
    return re.fullmatch(pattern, node) is not None


def _last(name: str) -> str:
    return name.rpartition('/')[2]


def is_ros_own(name: str) -> bool:
    """Tell of a parameter whether every ROS node has it, such as use_sim_time."""
    return name.partition('.')[0] in _ROS_OWN


def _flatten(content: Any) -> Iterator[tuple[str, Any]]:
    """Flat names and values; only our own sections are entered, so the depth is bounded."""
    if not isinstance(content, dict):
        raise DjetError(f'{shown(content)} stands where parameters were expected')
    for name, value in content.items():
        if name in SECTIONS and isinstance(value, dict):
            yield from ((f'{name}.{inner}', inner_value) for inner, inner_value in value.items())
        elif name not in SECTIONS or value is not None:
            yield str(name), value


def dump_yaml(config: Config, parts: Sequence[str] = ('', *SECTIONS), *,
              preset_as_comments: bool = False) -> str:
    """
    Write the configuration as YAML in ROS's layout, each parameter under its description.

    parts: the sections that are written; '' are the parameters that stand in none. With
    preset_as_comments the estimator's values that the preset gives anyway are commented out, so
    that the file leaves the choice of preset free.
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
            lines += textwrap.wrap(explain(item), 97, initial_indent=f'{indent}# ',
                                   subsequent_indent=f'{indent}# ')
            mark = '# ' if item.name in silent else ''
            name = item.name.rpartition('.')[2]
            lines.append(f'{indent}{mark}{name}: {_yaml_scalar(item.value)}')
        if part and silent.issuperset(item.name for item in section(config, part)):
            # A section of comments alone would be null, which ROS refuses.
            lines[0] = f'    # {part}:'
        texts.append('\n'.join(lines) + '\n')
    return (_YAML_HEAD + (_PRESET_NOTE if silent else '') + '/**:\n  ros__parameters:\n'
            + '\n'.join(texts))


def _yaml_scalar(value: Value) -> str:
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition('e')
        # YAML 1.1 readers take 1e-06 for a string, and 1.0e-06 for the number that it is.
        return f'{mantissa}.0e{exponent}' if e and '.' not in mantissa else repr(value)
    return json.dumps(value)
