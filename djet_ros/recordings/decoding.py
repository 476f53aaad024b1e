"""
Deserialisation of messages of any ROS 1 or ROS 2 bag to message objects of ROS 2 Jazzy.

A bag carries the definitions of its types. If they equal Jazzy's, or if it has none, Jazzy's own
classes deserialise the messages. Otherwise the recorded definition does, and fields are copied by
name into Jazzy's class: ROS 1's ``K`` becomes ``k``, its ``header.seq`` is dropped.
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
# or strings. Limits in characters and elements; real definitions have a few kB with comments, and
# rarely such arrays.
LONGEST_DEFINITION = 32 << 10
MOST_FIXED_ELEMENTS = 256

# Limit of the objects in sequences of messages or strings: each takes a hundred bytes or more in
# memory, from as little as one byte, or none, of the message.
MOST_OBJECTS = 1 << 22

# Minimum serialised size of basic types in bytes; all others have 1.
BYTES = {'int16': 2, 'uint16': 2, 'int32': 4, 'uint32': 4, 'float32': 4, 'string': 4, 'int64': 8,
         'uint64': 8, 'float64': 8}

# Field that rosbags adds to an empty type; it takes no bytes of a ROS 1 message.
NO_FIELD = 'structure_needs_at_least_one_member'

FAMILIES = {'bool': 'bool', 'string': 'text', 'float32': 'float', 'float64': 'float'}


@cache
def jazzy() -> Typestore:
    """Return the message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def message_type(name: str) -> type:
    """Return the class of a message type of Jazzy, such as 'sensor_msgs/msg/Image'."""
    return jazzy().types[name]


# Factory of messages in Jazzy's classes.
MAKE = MessageFactory(message_type)


def decoder(connection: Connection) -> Decoder:
    """Return the function from bytes to message of a connection; raise BrokenFile if none can."""
    if connection.encoding not in ('cdr', 'ros1'):
        raise BrokenFile(f"encoding '{connection.encoding[:40]}' is neither cdr nor ros1")
    # rosbags generates code from the definition; with malformed text it can raise any exception.
    try:
        store = _store(connection)
        if connection.msgtype not in store.types:
            raise ValueError('it is not in ROS 2 Jazzy, and the bag holds no definition of it')
        store.get_msgdef(connection.msgtype)
        converted = store is not jazzy() and connection.msgtype in jazzy().types
        largest = _largest_message(store, connection.msgtype, copies=2 if converted else 1)
    except Exception as error:
        raise BrokenFile(f"its type '{connection.msgtype[:80]}' can't be used: "
                         f'{type(error).__name__} {one_line(error)[:120]}') from error
    convert = _converter(store, connection.msgtype) if converted else _identity
    return partial(_decode, connection, store, convert, largest)


def _decode(connection: Connection, store: Typestore, convert: Callable[[Any], Any],
            largest: int, data: memoryview) -> Any:
    ros1 = connection.encoding == 'ros1'
    if not ros1 and data[:4] == ZSTD_MAGIC:
        data = decompress_message(data)
    if len(data) > largest:
        raise BrokenFile(f'it has {len(data)} bytes; a {connection.msgtype} of more than '
                         f'{largest} could exceed the memory when deserialised')
    deserialize = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    # As above: the code was generated from the file, and can raise any exception.
    try:
        return convert(deserialize(data, connection.msgtype))
    except Exception as error:
        raise BrokenFile(f'it is no {connection.msgtype}: {one_line(error)[:120]}') from error


def _store(connection: Connection) -> Typestore:
    """Return the types that deserialise a connection: Jazzy's own if they are the same."""
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


def _largest_message(store: Typestore, msgtype: str, copies: int) -> int:
    """Return the bytes beyond which a message could become more than MOST_OBJECTS objects."""
    elements = list(_elements(store, (Nodetype.NAME, msgtype)))
    if any(size == 0 for size, _ in elements):
        raise ValueError('it has sequences of elements that take no bytes')
    return min([LARGEST_PIECE, *(
        size * MOST_OBJECTS // (copies * objects) for size, objects in elements)])


def _elements(store: Typestore, kind: Any) -> Iterator[tuple[int, int]]:
    """Yield, of all sequences of messages or strings, the least bytes and objects per element."""
    node, detail = kind
    if node == Nodetype.NAME:
        for _, inner in store.fielddefs[detail][1]:
            yield from _elements(store, inner)
    elif node != Nodetype.BASE:
        inner = detail[0]
        if node == Nodetype.SEQUENCE and (inner[0] != Nodetype.BASE or inner[1][0] == 'string'):
            yield _least_bytes(store, inner), _objects(store, inner)
        yield from _elements(store, inner)


def _objects(store: Typestore, kind: Any) -> int:
    """Return how many objects a field becomes; elements of sequences are counted by themselves."""
    node, detail = kind
    if node == Nodetype.NAME:
        return 1 + sum(_objects(store, inner) for _, inner in store.fielddefs[detail][1])
    if node == Nodetype.ARRAY and (detail[0][0] != Nodetype.BASE or detail[0][1][0] == 'string'):
        return 1 + int(detail[1]) * _objects(store, detail[0])
    return 1


def _least_bytes(store: Typestore, kind: Any) -> int:
    """Return the minimum serialised size of a field type in bytes."""
    node, detail = kind
    if node == Nodetype.NAME:
        return sum(_least_bytes(store, inner) for name, inner in store.fielddefs[detail][1]
                   if name != NO_FIELD)
    if node == Nodetype.BASE:
        return BYTES.get(detail[0], 1)
    # A sequence may be empty, but its length is stored.
    return 4 if node == Nodetype.SEQUENCE else detail[1] * _least_bytes(store, detail[0])


def _fixed_elements(definition: Any) -> int:
    _, fields = definition
    return sum(detail[1] for _, (kind, detail) in fields if kind == Nodetype.ARRAY
               and (detail[0][0] == Nodetype.NAME or detail[0][1][0] == 'string'))


def _identity(message: Any) -> Any:
    return message


def _converter(source: Typestore, name: str) -> Callable[[Any], Any]:
    """Return the function that copies a message of another store into Jazzy's class."""
    recorded = {field.lower(): (field, kind) for field, kind in source.fielddefs[name][1]}
    steps = []
    for field, kind in jazzy().fielddefs[name][1]:
        attribute, have = recorded.get(field.lower(), (field, None))
        if have is None or not _compatible(have, kind):
            raise BrokenFile(f"type '{name}' was recorded without a field '{field}' of the type "
                             'that it has in ROS 2 Jazzy')
        steps.append((attribute, _copier(source, kind)))
    cls = message_type(name)
    return lambda message: cls(*(copy(getattr(message, attribute)) for attribute, copy in steps))


def _copier(source: Typestore, kind: Any) -> Callable[[Any], Any]:
    """Return the function that copies a field of a type."""
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


def _compatible(have: Any, want: Any) -> bool:
    """Return whether values of one field type can be assigned to another."""
    if have[0] != want[0]:
        return False
    if have[0] == Nodetype.NAME:
        return bool(have[1] == want[1])
    if have[0] == Nodetype.BASE:
        return FAMILIES.get(have[1][0], 'int') == FAMILIES.get(want[1][0], 'int')
    fixed = have[0] == Nodetype.ARRAY
    return _compatible(have[1][0], want[1][0]) and (not fixed or have[1][1] == want[1][1])
