"""Resolution and remapping of topic and service names, as in ROS."""

from __future__ import annotations

from collections.abc import Sequence
import re

from djet_ros.errors import DjetError

# Valid node names, and valid names in remapping rules.
_TOKEN = r'[A-Za-z_][A-Za-z0-9_]*'
_NAME = re.compile(rf'(~?/)?{_TOKEN}(/{_TOKEN})*|/')


class Names:
    """
    Resolves the names that one node uses.

    rules: remappings 'from:=to', of which the first match applies; __node and __ns set the node
    name and namespace. Raises DjetError on an invalid rule.
    """

    def __init__(self, node: str, rules: Sequence[str] = ()) -> None:
        pairs = [_parse(rule) for rule in rules]
        special = dict(pairs)
        self.node = special.get('__node', node)
        if not re.fullmatch(_TOKEN, self.node):
            raise DjetError(f"'{self.node}' is not a valid node name; use letters, digits and _, "
                            'as in left_vo, and set the namespace with -r __ns:=/NAMESPACE')
        self.namespace = '/' + special.get('__ns', '').strip('/')
        # Launch files pass on unchanged names, which are no remappings.
        self._rules = [(self.expand(old), self.expand(new)) for old, new in pairs
                       if not old.startswith('__') and old != new]

    @property
    def full_node(self) -> str:
        """Return the fully qualified node name."""
        return f'{self.namespace.rstrip("/")}/{self.node}'

    def expand(self, name: str) -> str:
        """Return the fully qualified name, without remapping."""
        if name.startswith('/'):
            return name
        if name.startswith('~'):
            return self.full_node + name[1:]
        return f'{self.namespace.rstrip("/")}/{name}'

    def resolve(self, name: str) -> str:
        """Return the fully qualified name, with remapping."""
        full = self.expand(name)
        return next((new for old, new in self._rules if old == full), full)

    def is_remapped(self, name: str) -> bool:
        """Return whether a rule remaps a name, even to its default."""
        return self.expand(name) in (old for old, _ in self._rules)


def _parse(rule: str) -> tuple[str, str]:
    old, mark, new = rule.partition(':=')
    if not (mark and _NAME.fullmatch(old) and _NAME.fullmatch(new)):
        raise DjetError(f"'{rule}' is not a remapping; use the form image:=/camera/image_raw")
    return old, new
