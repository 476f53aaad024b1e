"""
Places seen before, by the descriptors that they share.

Locality-sensitive hashing (Gionis, Indyk, Motwani, VLDB 1999): descriptors that agree in some
chosen bits fall into one bucket; those of a bucket are compared in full. A keyframe gets a vote
from each feature that has a near descriptor in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from djet_ros.core.types import Features
import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

# With descriptors of one point 20 to 40 bits apart, a table of 16 bits finds about a fifth of
# them, and eight tables most; wrong ones are compared in full and cost time only.
_TABLES, _BITS = 8, 16

_CHOSEN = np.random.default_rng(0).permutation(256)[:_TABLES * _BITS].reshape(_TABLES, _BITS)

# Keyframes that are sorted into tables together.
_BLOCK = 64

# Descriptors farther apart than this are of different points.
_NEAR = 40

# Strongest features that speak for a keyframe.
_SPEAKERS = 500

_ONES = np.array([bin(byte).count('1') for byte in range(256)], np.uint8)


class PlaceIndex:
    """
    Descriptors of keyframes in the order of time, and the tables to find near ones.

    The tables are made for blocks of keyframes, when one is full or is asked: so that keyframes
    can be added at any time.
    """

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._newest: list[NDArray[np.uint8]] = []
        self._count = 0

    def add(self, features: Features) -> None:
        """Take the features of the next keyframe."""
        order = np.argsort(-features.responses, kind='stable')[:_SPEAKERS]
        self._newest.append(features.descriptors[order])
        self._count += 1
        if len(self._newest) == _BLOCK:
            self._blocks.append(self._open_block())
            self._newest = []

    def forget(self, first: int) -> None:
        """Forget the keyframes before one, as far as whole blocks are of such."""
        self._blocks = [block for block in self._blocks if block.end > first]

    def votes(self, features: Features, before: int) -> Index:
        """Count (before,) the features that each of the first keyframes has too."""
        order = np.argsort(-features.responses, kind='stable')[:_SPEAKERS]
        asking = features.descriptors[order]
        votes = np.zeros(before, np.int64)
        blocks = self._blocks
        if self._newest and before > self._count - len(self._newest):
            blocks = [*blocks, self._open_block()]
        for block in blocks:
            owners = block.votes(asking)[:max(before - block.first, 0)]
            votes[block.first:block.first + len(owners)] = owners
        return votes

    def _open_block(self) -> _Block:
        return _Block(self._count - len(self._newest), self._newest)


class _Block:
    """Some keyframes in a row, from the one with the number ``first`` to before ``end``."""

    def __init__(self, first: int, keyframes: Sequence[NDArray[np.uint8]]) -> None:
        self.first, self.end = first, first + len(keyframes)
        self._descriptors = np.concatenate(keyframes)
        self._owner = np.repeat(np.arange(len(keyframes)), [*map(len, keyframes)])
        self._tables: list[tuple[NDArray[np.uint16], NDArray[np.uint16]]] = []
        for keys in _keys(self._descriptors):
            order = np.argsort(keys, kind='stable')
            # A block has fewer descriptors than two bytes can count.
            self._tables.append((keys[order], order.astype(np.uint16)))

    def votes(self, asking: NDArray[np.uint8]) -> Index:
        """Count for each keyframe which of the descriptors (N, 32) have a near one there."""
        mine, found = self._bucket_mates(asking)
        near = _ONES[asking[mine] ^ self._descriptors[found]].sum(1) <= _NEAR
        # A feature has one vote for a keyframe, however many near descriptors it finds there.
        size = self.end - self.first
        cast = np.unique(mine[near] * size + self._owner[found[near]])
        return np.bincount(cast % size, minlength=size)

    def _bucket_mates(self, asking: NDArray[np.uint8]) -> tuple[Index, Index]:
        """Pairs of descriptors, of those asking and of the block's, that share a bucket."""
        pairs = []
        for keys, (ordered, order) in zip(_keys(asking), self._tables):
            start = np.searchsorted(ordered, keys)
            size = np.searchsorted(ordered, keys, 'right') - start
            within = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
            pairs.append((np.repeat(np.arange(len(asking)), size),
                          order[np.repeat(start, size) + within]))
        mine, found = (np.concatenate(part) for part in zip(*pairs))
        return mine, found


def _keys(descriptors: NDArray[np.uint8]) -> Iterator[NDArray[np.uint16]]:
    """Buckets (N,) of descriptors (N, 32) in each table."""
    bits = np.unpackbits(descriptors, axis=1)
    for part in _CHOSEN:
        yield bits[:, part].astype(np.uint16) @ (1 << np.arange(_BITS)).astype(np.uint16)
