"""Names of topics and services, resolved and remapped as ROS does for a node."""

from __future__ import annotations

from collections.abc import Sequence
import re

from djet_ros.errors import DjetError

# What ROS takes as the name of a node, and of anything.
_TOKEN = r'[A-Za-z_][A-Za-z0-9_]*'
_NAME = re.compile(rf'(~?/)?{_TOKEN}(/{_TOKEN})*|/')


class Names:
    """
    Resolves the names that one node uses.

    rules: remappings 'from:=to', of which the first that fits counts; __node and __ns name the
    node and its namespace. Raises DjetError on what is no such rule.
    """

    def __init__(self, node: str, rules: Sequence[str] = ()) -> None:
        pairs = [_parse(rule) for rule in rules]
        special = dict(pairs)
        self.node = special.get('__node', node)
        if not re.fullmatch(_TOKEN, self.node):
            raise DjetError(f"'{self.node}' is no name of a node; give letters, digits and _, as "
                            'in left_vo, and its namespace by -r __ns:=/NAMESPACE')
        self.namespace = '/' + special.get('__ns', '').strip('/')
        # What a launch file hands on as it stands says nothing.
        self._rules = [(self.expand(old), self.expand(new)) for old, new in pairs
                       if not old.startswith('__') and old != new]

    @property
    def full_node(self) -> str:
        """Name of the node with its namespace."""
        return f'{self.namespace.rstrip("/")}/{self.node}'

    def expand(self, name: str) -> str:
        """Give the full name, without remapping."""
        if name.startswith('/'):
            return name
        if name.startswith('~'):
            return self.full_node + name[1:]
        return f'{self.namespace.rstrip("/")}/{name}'

    def resolve(self, name: str) -> str:
        """Give the full name, remapped."""
        full = self.expand(name)
        return next((new for old, new in self._rules if old == full), full)

    def is_remapped(self, name: str) -> bool:
        """Tell whether a rule says what a name stands for, be it what it would be anyway."""
        return self.expand(name) in (old for old, _ in self._rules)


def _parse(rule: str) -> tuple[str, str]:
    old, mark, new = rule.partition(':=')
    if not (mark and _NAME.fullmatch(old) and _NAME.fullmatch(new)):
        raise DjetError(f"'{rule}' is no remapping; write it as image:=/camera/image_raw")
    return old, new
