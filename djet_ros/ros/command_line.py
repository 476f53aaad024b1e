"""ROS arguments of the command line, which rclpy parses but does not expose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise


def option_values(words: Sequence[str], *options: str) -> Iterator[str]:
    """Yield the values of ROS options such as --params-file, after --ros-args."""
    for_ros = False
    for word, following in pairwise(words):
        for_ros = word == '--ros-args' or (for_ros and word != '--')
        if for_ros and word in options:
            yield following


def topic_remappings(words: Sequence[str], node: str) -> Iterator[tuple[str, str]]:
    """Yield the topic remappings (from, to) that apply to a node, as given."""
    for rule in option_values(words, '-r', '--remap'):
        old, _, new = rule.partition(':=')
        whose, _, old = old.replace('rostopic://', '').rpartition(':')
        if whose in ('', node) and not old.startswith('__'):
            yield old, new
