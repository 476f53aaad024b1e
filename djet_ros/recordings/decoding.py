"""
Serialised messages of any ROS 1 or ROS 2 bag to message objects of ROS 2 Jazzy.

A recording carries the definitions of its types. Where they are Jazzy's, or where it has none,
Jazzy's own classes read it. Otherwise the recorded definition reads the bytes, and fields go by
name into Jazzy's class: ROS 1's ``K`` becomes ``k``, its ``header.seq`` is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any, TypeAlias

from djet_ros.errors import one_line
from djet_ros.odometry.messages import MessageFactory
from djet_ros.recordings.storages.base import BrokenFile, Connection, LARGEST_PIECE
from djet_ros.recordings.storages.compression import decompress_message, ZSTD_MAGIC
import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

Decoder: TypeAlias = Callable[[memoryview], Any]

# rosbags compiles a definition to code, with lines for each element of a fixed array of messages
# or strings. Real definitions have a few kB with their comments, and hardly such arrays.
LONGEST_DEFINITION = 32 << 10
MOST_FIXED_ELEMENTS = 256

# Each element of a sequence of messages or strings becomes an object of a hundred bytes or more,
# and may have taken a single byte, or none, of the message.
MOST_ELEMENTS = 1 << 22

# Least bytes of the basic types; all others have one.
BYTES = {'int16': 2, 'uint16': 2, 'int32': 4, 'uint32': 4, 'float32': 4, 'string': 4, 'int64': 8,
         'uint64': 8, 'float64': 8}

# What rosbags adds to a type without fields, and reads from no byte of a ROS 1 message.
NO_FIELD = 'structure_needs_at_least_one_member'

FAMILIES = {'bool': 'bool', 'string': 'text', 'float32': 'float', 'float64': 'float'}


@cache
def jazzy() -> Typestore:
    """Message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def message_type(name: str) -> type:
    """Class of a message type of Jazzy, such as 'sensor_msgs/msg/Image'."""
    return jazzy().types[name]


# Messages of Jazzy's own classes.
MAKE = MessageFactory(message_type)


def decoder(connection: Connection) -> Decoder:
    """Make the function from bytes to a message for one connection, else BrokenFile."""
    if connection.encoding not in ('cdr', 'ros1'):
        raise BrokenFile(f"encoding '{connection.encoding[:40]}' is neither cdr nor ros1")
    # The definition becomes generated code in rosbags, which fails on hostile text in any way.
    try:
        store = _store(connection)
        if connection.msgtype not in store.types:
            raise ValueError('it is unknown, and the bag holds no definition of it')
        store.get_msgdef(connection.msgtype)
        largest = _largest_message(store, connection.msgtype)
    except Exception as error:
        raise BrokenFile(f"its type '{connection.msgtype[:80]}' can't be used: "
                         f'{type(error).__name__} {one_line(error)[:120]}') from error
    convert: Callable[[Any], Any] = _identity
    if store is not jazzy() and connection.msgtype in jazzy().types:
        convert = _converter(store, connection.msgtype)
    return partial(_decode, connection, store, convert, largest)


def _decode(connection: Connection, store: Typestore, convert: Callable[[Any], Any],
            largest: int, data: memoryview) -> Any:
    ros1 = connection.encoding == 'ros1'
    if not ros1 and data[:4] == ZSTD_MAGIC:
        data = decompress_message(data)
    if len(data) > largest:
        raise BrokenFile(f'it has {len(data)} bytes; a {connection.msgtype} of more than '
                         f'{largest} may unfold to more than memory holds')
    deserialize = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    # As above: the code that reads the bytes was generated from what the file says.
    try:
        return convert(deserialize(data, connection.msgtype))
    except Exception as error:
        raise BrokenFile(f'it is no {connection.msgtype}: {one_line(error)[:120]}') from error


def _store(connection: Connection) -> Typestore:
    """Types to read a connection with: Jazzy's own if they are the same."""
    if not connection.definition:
        return get_typestore(Stores.ROS1_NOETIC) if connection.encoding == 'ros1' else jazzy()
    if len(connection.definition) > LONGEST_DEFINITION:
        raise ValueError(f'its definition has {len(connection.definition)} characters')
    types = get_types_from_msg(connection.definition, connection.msgtype)
    if (elements := sum(map(_fixed_elements, types.values()))) > MOST_FIXED_ELEMENTS:
        raise ValueError(f'its definition has fixed arrays of {elements} elements')
    if connection.encoding == 'cdr' and all(
            jazzy().fielddefs.get(name, ((), None))[1] == fields
            for name, (_, fields) in types.items()):
        return jazzy()
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def _largest_message(store: Typestore, msgtype: str) -> int:
    """Bytes of a message beyond which it might have more than MOST_ELEMENTS elements."""
    least = min(_elements(store, (Nodetype.NAME, msgtype)), default=LARGEST_PIECE)
    if least == 0:
        raise ValueError('it has sequences of elements that take no bytes')
    return min(least * MOST_ELEMENTS, LARGEST_PIECE)


def _elements(store: Typestore, kind: Any) -> Iterator[int]:
    """Least bytes of the elements of all sequences in a kind of field that become objects."""
    node, detail = kind
    if node == Nodetype.NAME:
        for _, inner in store.fielddefs[detail][1]:
            yield from _elements(store, inner)
    elif node != Nodetype.BASE:
        inner = detail[0]
        if node == Nodetype.SEQUENCE and (inner[0] != Nodetype.BASE or inner[1][0] == 'string'):
            yield _least_bytes(store, inner)
        yield from _elements(store, inner)


def _least_bytes(store: Typestore, kind: Any) -> int:
    """Bytes that a kind of field takes at least."""
    node, detail = kind
    if node == Nodetype.NAME:
        return sum(_least_bytes(store, inner) for name, inner in store.fielddefs[detail][1]
                   if name != NO_FIELD)
    if node == Nodetype.BASE:
        return BYTES.get(detail[0], 1)
    # A sequence may be empty, but has its length.
    return 4 if node == Nodetype.SEQUENCE else detail[1] * _least_bytes(store, detail[0])


def _fixed_elements(definition: Any) -> int:
    _, fields = definition
    return sum(detail[1] for _, (kind, detail) in fields if kind == Nodetype.ARRAY
               and (detail[0][0] == Nodetype.NAME or detail[0][1][0] == 'string'))


def _identity(message: Any) -> Any:
    return message


def _converter(source: Typestore, name: str) -> Callable[[Any], Any]:
    """Make the function that copies a message of another store into Jazzy's class."""
    recorded = {field.lower(): (field, kind) for field, kind in source.fielddefs[name][1]}
    steps = []
    for field, kind in jazzy().fielddefs[name][1]:
        attribute, have = recorded.get(field.lower(), (field, None))
        if have is None or not _alike(have, kind):
            raise BrokenFile(f"type '{name}' was recorded without a field '{field}' as ROS 2 "
                             'Jazzy has it')
        steps.append((attribute, _copier(source, kind)))
    cls = message_type(name)
    return lambda message: cls(*(copy(getattr(message, attribute)) for attribute, copy in steps))


def _copier(source: Typestore, kind: Any) -> Callable[[Any], Any]:
    """Make the function that copies one field of a kind."""
    if kind[0] == Nodetype.NAME:
        return _converter(source, kind[1])
    if kind[0] == Nodetype.BASE:
        return _identity
    inner, _ = kind[1]
    if inner[0] == Nodetype.NAME:
        convert = _converter(source, inner[1])
        return lambda items: [convert(item) for item in items]
    if inner[1][0] == 'string':
        return _identity
    dtype = getattr(np, {'bool': 'bool_', 'char': 'uint8', 'byte': 'uint8'}.get(
        inner[1][0], inner[1][0]))
    return lambda items: np.asarray(items, dtype=dtype)


def _alike(have: Any, want: Any) -> bool:
    """Tell whether values of one kind of field fit into another."""
    if have[0] != want[0]:
        return False
    if have[0] == Nodetype.NAME:
        return bool(have[1] == want[1])
    if have[0] == Nodetype.BASE:
        return FAMILIES.get(have[1][0], 'int') == FAMILIES.get(want[1][0], 'int')
    fixed = have[0] == Nodetype.ARRAY
    return _alike(have[1][0], want[1][0]) and (not fixed or have[1][1] == want[1][1])
