"""Text and YAML files of strangers, read with bounds and with a reason for every refusal."""

from __future__ import annotations

from pathlib import Path
import re
from typing import Any

from djet_ros.errors import DjetError, one_line
import yaml

# A pose file of 300,000 frames fits; a disk image given by mistake doesn't.
LARGEST_TEXT = 64 << 20

# Pure-Python YAML reads about 200 kB/s; the compiled loader overflows the stack on deep nesting.
LARGEST_YAML = 2 << 20

# OpenCV begins its files with what looks like a directive of YAML, and is none.
_OPENCV_HEADER = re.compile(r'\A\ufeff?%YAML:\d[^\n]*')


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Reads plain values, and OpenCV's matrices as the mappings that they are."""


_Loader.add_constructor('tag:yaml.org,2002:opencv-matrix', yaml.SafeLoader.construct_yaml_map)


def read_text(path: Path, largest: int = LARGEST_TEXT) -> str:
    """Text of a regular UTF-8 file of at most ``largest`` bytes, else DjetError."""
    try:
        if not path.is_file():
            state = 'is not a regular file' if path.exists() else 'does not exist'
            raise DjetError(f'{path} {state}; give a readable text file')
        if (size := path.stat().st_size) > largest:
            raise DjetError(f'{path} has {size} bytes, at most {largest} are read; '
                            'is it the right file?')
        return path.read_text('utf-8')
    except OSError as error:
        raise DjetError(f'{path} could not be read: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise DjetError(f'{path} is not a text file: byte {error.start} is not UTF-8') from error


def read_yaml(path: Path) -> Any:
    """Content of a YAML file, OpenCV's included: plain values only, no Python objects."""
    text = _OPENCV_HEADER.sub('', read_text(path, LARGEST_YAML))
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        _unfolded(node, {})
        return None if node is None else loader.construct_document(node)
    # PyYAML lets out whatever its constructors stumble over: KeyError of '!!bool x'.
    except (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, RecursionError,
            TypeError, ValueError) as error:
        raise DjetError(f'{path} is not valid YAML: {one_line(error, 300)}') from error


def _unfolded(node: Any, known: dict[int, int]) -> int:
    """
    Count the values below a node, those behind aliases again each time.

    A few lines of lists of aliases of lists are more values than any memory holds.
    """
    if id(node) in known:
        if not known[id(node)]:
            raise yaml.YAMLError('an alias stands within what it stands for')
        return known[id(node)]
    known[id(node)] = 0
    count = 1
    if isinstance(node, yaml.CollectionNode):
        for item in node.value:
            count += sum(_unfolded(part, known)
                         for part in (item if isinstance(item, tuple) else (item,)))
    if count > LARGEST_YAML:
        raise yaml.YAMLError(f'its aliases unfold to more than {LARGEST_YAML} values')
    known[id(node)] = count
    return count
