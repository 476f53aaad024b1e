"""
Results published in the paper, for comparison.

Copied from its tables: mean errors over all frames of a sequence, in what the tables call
degrees, and mean Hamming distances in bits.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedRow:
    """Published means of one method; window: side of the sampling window, if varied."""

    method: str
    rotation_deg: float
    translation_deg: float
    hamming: float
    window: int | None = None


_NOT_PRINTED = float('nan')

# Table 1, by row: rotation of D-JET, RP-E, P-JET, 5-P; translation of the same; Hamming distance
# of D-JET, RP-E, 5-P.
_TABLE_1 = """
00 0.094 0.074 0.096 0.119 0.075 0.070  6.749 0.044 19.42 20.46 20.98
01 0.115 0.091 0.253 0.138 0.096 0.075  7.889 0.064 18.58 19.92 19.73
02 0.084 0.059 0.061 0.112 0.110 0.061  1.502 0.030 21.78 21.94 23.44
03 0.073 0.052 0.035 0.101 0.154 0.120  0.981 0.056 17.72 18.42 20.00
04 0.068 0.038 0.045 0.090 0.030 0.013  0.951 0.021 19.22 20.03 21.28
05 0.086 0.062 0.049 0.107 0.099 0.078  1.274 0.076 17.99 18.75 20.04
06 0.072 0.049 0.358 0.100 0.046 0.025 10.765 0.027 21.33 22.04 23.18
07 0.112 0.081 0.152 0.107 0.206 0.177 28.070 0.169 16.93 17.70 18.97
08 0.078 0.060 0.063 0.108 0.092 0.069  9.429 0.064 20.25 20.32 21.78
09 0.087 0.056 0.029 0.109 0.067 0.031  0.676 0.030 20.30 21.21 22.65
10 0.116 0.075 0.131 0.146 0.093 0.072  1.361 0.057 19.97 20.96 22.53
"""


def _table_1() -> dict[str, list[PublishedRow]]:
    table = {}
    for line in _TABLE_1.split('\n')[1:-1]:
        sequence, *words = line.split()
        values = [float(word) for word in words]
        hamming = [values[8], values[9], _NOT_PRINTED, values[10]]
        table[f'KITTI {sequence}'] = [
            PublishedRow(method, values[i], values[4 + i], hamming[i])
            for i, method in enumerate(('djet', 'rpe', 'pjet', 'five_point'))]
    return table


# By the public name of a sequence.
TABLE_1 = _table_1()

TABLE_2 = [
    PublishedRow('five_point', 0.135, 0.256, 22.41),
    PublishedRow('rpe', 0.085, 0.224, 22.18),
    PublishedRow('djet', 0.133, 0.273, 21.92, 3),
    PublishedRow('djet', 0.126, 0.267, 21.84, 5),
    PublishedRow('djet', 0.132, 0.265, 21.99, 7),
    PublishedRow('djet', 0.127, 0.258, 22.31, 15),
]
