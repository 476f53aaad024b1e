"""What a command line has for ROS, which rclpy reads and does not show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise


def values_after(words: Sequence[str], *options: str) -> Iterator[str]:
    """Give the values of options such as --params-file that are meant for ROS."""
    for_ros = False
    for word, following in pairwise(words):
        for_ros = word == '--ros-args' or (for_ros and word != '--')
        if for_ros and word in options:
            yield following


def topic_rules(words: Sequence[str], node: str) -> Iterator[tuple[str, str]]:
    """Give the remappings (from, to) of topics that hold for a node, as they are written."""
    for rule in values_after(words, '-r', '--remap'):
        old, _, new = rule.partition(':=')
        whose, _, old = old.replace('rostopic://', '').rpartition(':')
        if whose in ('', node) and not old.startswith('__'):
            yield old, new
