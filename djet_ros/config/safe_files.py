"""Reading of untrusted text and YAML files: bounded in size, with a reason for each error."""

from __future__ import annotations

from pathlib import Path
import re
from typing import Any

from djet_ros.errors import DjetError, one_line
import yaml

# Bytes: enough for a pose file of 300,000 frames, and not for a disk image given by mistake.
LARGEST_TEXT = 64 << 20

# Bytes. Pure-Python YAML reads about 200 kB/s; the compiled loader overflows the stack on deep
# nesting.
LARGEST_YAML = 2 << 20

# Characters. PyYAML's time for 1:59:59:..., an integer to the base of 60, grows with their square.
_LONGEST_INTEGER = 1000

# The first line of OpenCV's files looks like a YAML directive but is not a valid one.
_OPENCV_HEADER = re.compile(r'\A%YAML:\d[^\n]*')


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """A safe loader that reads OpenCV matrices as mappings."""


_Loader.add_constructor('tag:yaml.org,2002:opencv-matrix', yaml.SafeLoader.construct_yaml_map)


def read_text(path: Path, largest: int = LARGEST_TEXT) -> str:
    """Return the text of a regular UTF-8 file of at most ``largest`` bytes; else DjetError."""
    try:
        if not path.is_file():
            state = 'is not a regular file' if path.exists() else 'does not exist'
            raise DjetError(f'{path} {state}; give a readable text file')
        if (size := path.stat().st_size) > largest:
            raise DjetError(f'{path} has {size} bytes, more than the limit of {largest}; '
                            'is it the right file?')
        # Editors of Windows put a byte order mark before the text.
        return path.read_text('utf-8-sig')
    except OSError as error:
        raise DjetError(f'{path} could not be read: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise DjetError(f'{path} is not a text file: byte {error.start} is not UTF-8') from error


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML or OpenCV file: plain values only, no Python objects."""
    text = _OPENCV_HEADER.sub('', read_text(path, LARGEST_YAML))
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        _expanded_size(node, {})
        return None if node is None else loader.construct_document(node)
    # PyYAML does not wrap errors of its constructors, such as the KeyError of '!!bool x'.
    except (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, RecursionError,
            TypeError, ValueError) as error:
        raise DjetError(f'{path} is not valid YAML: {one_line(error, 300)}') from error


def _expanded_size(node: Any, known: dict[int, int]) -> int:
    """
    Return the number of values below a node with aliases expanded.

    A few lines of nested aliases ("billion laughs") can expand beyond any memory: YAMLError, as
    for other nodes that must not be constructed.
    """
    if id(node) in known:
        if not known[id(node)]:
            raise yaml.YAMLError('an alias refers to a node that contains it')
        return known[id(node)]
    known[id(node)] = 0
    count = 1
    if isinstance(node, yaml.MappingNode):
        _refuse_repeated_keys(node)
    elif node is not None and node.tag == 'tag:yaml.org,2002:int' \
            and len(node.value) > _LONGEST_INTEGER:
        raise yaml.YAMLError(f'it has an integer of {len(node.value)} characters')
    if isinstance(node, yaml.CollectionNode):
        for item in node.value:
            count += sum(_expanded_size(part, known)
                         for part in (item if isinstance(item, tuple) else (item,)))
    if count > LARGEST_YAML:
        raise yaml.YAMLError(f'its aliases expand to more than {LARGEST_YAML} values')
    known[id(node)] = count
    return count


def _refuse_repeated_keys(node: yaml.MappingNode) -> None:
    """Raise YAMLError if a key stands twice: PyYAML would drop the first value without a word."""
    lines: dict[tuple[str, str], int] = {}
    for key, _ in node.value:
        # A merge (<<) may be repeated.
        if isinstance(key, yaml.ScalarNode) and key.tag != 'tag:yaml.org,2002:merge':
            name, line = (key.tag, key.value), key.start_mark.line + 1
            if name in lines:
                raise yaml.YAMLError(f"'{key.value[:80]}' stands twice in one mapping, in lines "
                                     f'{lines[name]} and {line}; join the two')
            lines[name] = line
