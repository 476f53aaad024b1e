"""
Place recognition by voting with shared descriptors.

Locality-sensitive hashing (Gionis, Indyk, Motwani, VLDB 1999): descriptors that agree in a
selection of bits share a bucket, and those in one bucket are compared in full. Each feature votes
for the keyframes that have a similar descriptor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from djet_ros.core.types import Features
import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

# Number of tables, and bits of each. If descriptors of one point differ in 20 to 40 bits, a table
# of 16 bits finds about a fifth of them, and eight tables most; false ones only cost time.
_TABLES, _BITS = 8, 16

_CHOSEN = np.random.default_rng(0).permutation(256)[:_TABLES * _BITS].reshape(_TABLES, _BITS)

# Keyframes that share a set of tables.
_BLOCK = 64

# Largest Hamming distance in bits of descriptors of one point.
_MAX_DISTANCE = 40

# Number of strongest features of a keyframe that are used.
_MAX_FEATURES = 500

# Pairs of descriptors that are compared at a time, in about 20 MB. A pattern that repeats itself
# has millions, in the few buckets that its descriptors fill.
_MOST_PAIRS = 1 << 18

_ONES = np.array([bin(byte).count('1') for byte in range(256)], np.uint8)


class PlaceIndex:
    """
    An index of the descriptors of keyframes in order of time.

    Hash tables are built for blocks of keyframes, when a block is full or queried, so that
    keyframes can be added at any time.
    """

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._newest: list[NDArray[np.uint8]] = []
        self._count = 0

    def add(self, features: Features) -> None:
        """Add the features of the next keyframe."""
        order = np.argsort(-features.responses, kind='stable')[:_MAX_FEATURES]
        self._newest.append(features.descriptors[order])
        self._count += 1
        if len(self._newest) == _BLOCK:
            self._blocks.append(self._open_block())
            self._newest = []

    def forget(self, first: int) -> None:
        """Remove the blocks that contain only keyframes before one."""
        self._blocks = [block for block in self._blocks if block.end > first]

    def votes(self, features: Features, before: int) -> Index:
        """Return the number (before,) of features with a similar one in each of the first."""
        order = np.argsort(-features.responses, kind='stable')[:_MAX_FEATURES]
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
    """Consecutive keyframes, with numbers from ``first`` to before ``end``."""

    def __init__(self, first: int, keyframes: Sequence[NDArray[np.uint8]]) -> None:
        self.first, self.end = first, first + len(keyframes)
        self._descriptors = np.concatenate(keyframes)
        self._owner = np.repeat(np.arange(len(keyframes)), [*map(len, keyframes)])
        self._tables: list[tuple[NDArray[np.uint16], NDArray[np.uint16]]] = []
        for keys in _keys(self._descriptors):
            order = np.argsort(keys, kind='stable')
            # A block has fewer than 2^16 descriptors.
            self._tables.append((keys[order], order.astype(np.uint16)))

    def votes(self, descriptors: NDArray[np.uint8]) -> Index:
        """Return how many of the descriptors (N, 32) have a similar one in each keyframe."""
        # One vote per feature and keyframe, however many similar descriptors there are.
        voted = np.zeros((len(descriptors), self.end - self.first), bool)
        for queries, matches in self._bucket_mates(descriptors):
            undecided = ~voted[queries, self._owner[matches]]
            queries, matches = queries[undecided], matches[undecided]
            near = _ONES[descriptors[queries] ^ self._descriptors[matches]].sum(1) <= _MAX_DISTANCE
            voted[queries[near], self._owner[matches[near]]] = True
        return np.asarray(voted.sum(0))

    def _bucket_mates(self, descriptors: NDArray[np.uint8]) -> Iterator[tuple[Index, Index]]:
        """Yield the index pairs of query and block descriptors that share a bucket, in parts."""
        for keys, (ordered, order) in zip(_keys(descriptors), self._tables):
            start = np.searchsorted(ordered, keys)
            size = np.searchsorted(ordered, keys, 'right') - start
            for part in _parts(size):
                count = size[part]
                within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
                yield (np.repeat(np.arange(part.start, part.stop), count),
                       order[np.repeat(start[part], count) + within].astype(np.int64))


def _parts(sizes: Index) -> Iterator[slice]:
    """Return slices of the sizes (N,) with sums of about _MOST_PAIRS at most."""
    part = (np.cumsum(sizes) - 1) // _MOST_PAIRS
    edges = [0, *(np.flatnonzero(np.diff(part)) + 1), len(sizes)]
    return (slice(*ends) for ends in pairwise(edges))


def _keys(descriptors: NDArray[np.uint8]) -> Iterator[NDArray[np.uint16]]:
    """Yield, for each table, the buckets (N,) of descriptors (N, 32)."""
    bits = np.unpackbits(descriptors, axis=1)
    for part in _CHOSEN:
        yield bits[:, part].astype(np.uint16) @ (1 << np.arange(_BITS)).astype(np.uint16)
