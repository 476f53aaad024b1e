"""Seeded damage to good inputs, where no coverage-guided fuzzer is at hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import re

import numpy as np

# Numbers in the binary formats, at which sizes and counts go wrong.
EDGES = [value.to_bytes(size, 'little') for size in (1, 2, 4, 8)
         for value in (0, 1, 2**(8 * size - 1) - 1, 2**(8 * size - 1), 2**(8 * size) - 1)]
EDGES += [np.array(value, '<f8').tobytes() for value in (np.nan, np.inf, -1e308, 1e-308)]

# Words that readers of text trip over.
WORDS = [b'nan', b'inf', b'-1', b'0', b'1e400', b'1e308', b'-1e200', b'1e-400', b'9' * 30,
         b'9' * 5000, b'0x1f', b'1_0', b'', b'..', b'/etc/passwd', b'\xff', b'\x00', b'\x1b[2J',
         b'\xe2\x80\xae', b'&a', b'*a', b'<<', b'[', b']', b'{', b'}', b'- ', b': ', b'\n', b'\r',
         b'# ', b'!!int ', b'!!float ', b'!!bool ', b'!!timestamp ', b'!!binary ', b'!!set ',
         b'!!python/name:os.system ', b'"', b"'", b'|', b'%', b'~', b'2001-99-99', b'1:99:99']
TOKEN = re.compile(rb'[^\s,:\[\]{}]+')


def mutations(seeds: Sequence[bytes], count: int, seed: int) -> Iterator[bytes]:
    """Yield damaged seeds: each damaged in one to four ways."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        data = seeds[rng.integers(len(seeds))]
        for _ in range(int(rng.integers(1, 5))):
            data = WAYS[rng.integers(len(WAYS))](data, rng, seeds)
        yield data


def _at(data: bytes, rng: np.random.Generator) -> int:
    """Choose a place, the ends more often: that is where the structures are."""
    if rng.random() < 0.4 and len(data) > 200:
        near = int(rng.integers(0, 200))
        return near if rng.random() < 0.5 else len(data) - near
    return int(rng.integers(0, len(data) + 1))


def _flip(data: bytes, rng: np.random.Generator, _: Sequence[bytes]) -> bytes:
    at = _at(data, rng)
    return data[:at] + bytes(byte ^ 1 << rng.integers(8) for byte in data[at:at + 1]) \
        + data[at + 1:]


def _edge(data: bytes, rng: np.random.Generator, _: Sequence[bytes]) -> bytes:
    at, edge = _at(data, rng), EDGES[rng.integers(len(EDGES))]
    return data[:at] + edge + data[at + len(edge):]


def _word(data: bytes, rng: np.random.Generator, _: Sequence[bytes]) -> bytes:
    """Put a word in the place of one, or before it."""
    found = [match.span() for match in TOKEN.finditer(data[:20_000])]
    word = WORDS[rng.integers(len(WORDS))]
    if not found:
        return word
    begin, end = found[rng.integers(len(found))]
    return data[:begin] + word + data[end if rng.random() < 0.7 else begin:]


def _cut(data: bytes, rng: np.random.Generator, _: Sequence[bytes]) -> bytes:
    return data[:_at(data, rng)]


def _drop(data: bytes, rng: np.random.Generator, _: Sequence[bytes]) -> bytes:
    at = _at(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 40)):]


def _repeat(data: bytes, rng: np.random.Generator, _: Sequence[bytes]) -> bytes:
    begin, end = sorted((_at(data, rng), _at(data, rng)))
    return data[:end] + data[begin:min(end, begin + 4000)] + data[end:]


def _splice(data: bytes, rng: np.random.Generator, seeds: Sequence[bytes]) -> bytes:
    other = seeds[rng.integers(len(seeds))]
    return data[:_at(data, rng)] + other[_at(other, rng):]


WAYS = (_flip, _flip, _edge, _edge, _word, _word, _cut, _drop, _repeat, _splice)
