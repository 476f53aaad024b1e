"""
Places seen before, by the descriptors that they share.

Locality-sensitive hashing (Gionis, Indyk, Motwani, VLDB 1999): descriptors that agree in some
chosen bits fall into one bucket; those of a bucket are compared in full. A keyframe gets a vote
from each feature that has a near descriptor in it.
"""

from __future__ import annotations

from djet_ros.core.types import Features
import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]

# With descriptors of one point 20 to 40 bits apart, a table of 16 bits finds about a fifth of
# them, and eight tables most; wrong ones are compared in full and cost time only.
_TABLES, _BITS = 8, 16

# Descriptors farther apart than this are of different points.
_NEAR = 40

# Strongest features that speak for a keyframe.
_SPEAKERS = 500

_ONES = np.array([bin(byte).count('1') for byte in range(256)], np.uint8)


class PlaceIndex:
    """Descriptors of keyframes in the order of time, and the tables to find near ones."""

    def __init__(self, keyframes: list[Features]) -> None:
        """Take the features of all keyframes."""
        speakers = [_strongest(features) for features in keyframes]
        self._first = np.cumsum([0, *map(len, speakers)])
        self._descriptors = np.concatenate(speakers or [np.empty((0, 32), np.uint8)])
        self._owner = np.repeat(np.arange(len(speakers)), np.diff(self._first))
        bits = np.unpackbits(self._descriptors, axis=1)
        chosen = np.random.default_rng(0).permutation(256)[:_TABLES * _BITS]
        weights = 1 << np.arange(_BITS)
        self._keys = [bits[:, part].astype(np.int64) @ weights
                      for part in chosen.reshape(_TABLES, _BITS)]
        self._orders = [np.argsort(keys, kind='stable') for keys in self._keys]
        self._sorted = [keys[order] for keys, order in zip(self._keys, self._orders)]

    def votes(self, keyframe: int, before: int) -> Index:
        """Count (before,) the features of a keyframe that each of the first keyframes has too."""
        asking, found = self._bucket_mates(keyframe, before)
        differing = _ONES[self._descriptors[asking] ^ self._descriptors[found]].sum(1)
        near = differing <= _NEAR
        # A feature has one vote for a keyframe, however many near descriptors it finds there.
        _, once = np.unique(asking[near] * len(self._first) + self._owner[found[near]],
                            return_index=True)
        return np.bincount(self._owner[found[near][once]], minlength=before)

    def _bucket_mates(self, keyframe: int, before: int) -> tuple[Index, Index]:
        """Pairs of descriptors, of the keyframe and of the first ones, that share a bucket."""
        mine = np.arange(self._first[keyframe], self._first[keyframe + 1])
        pairs = []
        for keys, order, ordered in zip(self._keys, self._orders, self._sorted):
            start = np.searchsorted(ordered, keys[mine])
            size = np.searchsorted(ordered, keys[mine], 'right') - start
            within = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
            found = order[np.repeat(start, size) + within]
            asking = np.repeat(mine, size)
            early = found < self._first[before]
            pairs.append((asking[early], found[early]))
        asking, found = (np.concatenate(part) for part in zip(*pairs))
        return asking, found


def _strongest(features: Features) -> NDArray[np.uint8]:
    order = np.argsort(-features.responses, kind='stable')[:_SPEAKERS]
    return features.descriptors[order]
