"""
Every parameter by its flat name, as in ROS: ``estimator.window``, ``odometry.max_gap``.

ROS parameters, YAML files and command-line flags are all derived from these.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
import difflib
import math
from typing import Any, cast

from djet_ros.config.sections import Config, SECTIONS
from djet_ros.core.estimator_config import preset
from djet_ros.core.parameter import describe, Description
from djet_ros.errors import DjetError

Value = bool | int | float | str


@dataclass(frozen=True)
class FlatParameter:
    """One parameter under its flat name, with its value, its type (kind) and its description."""

    name: str
    value: Value
    kind: type
    description: Description


def flat(config: Config) -> dict[str, FlatParameter]:
    """All parameters of the configuration by flat name, in the order of declaration."""
    return {item.name: item for name in ('', *SECTIONS) for item in section(config, name)}


def section(config: Config, part: str) -> Iterator[FlatParameter]:
    """Parameters of one section, or with '' those that stand in none."""
    owner = getattr(config, part) if part else config
    for name, description in describe(owner).items():
        value = getattr(owner, name)
        yield FlatParameter(f'{part}.{name}' if part else name, value, type(value),
                            description)


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """
    Give the configuration with the values of some parameters changed, by flat name.

    A preset among the values first sets the whole estimator to it; the others come on top.
    Integers are taken for floats. Raises DjetError on an unknown name (naming the nearest), on a
    value of another type, and on one outside its described range.
    """
    known = flat(config)
    checked = {name: _typed(_lookup(name, known), value) for name, value in values.items()}
    try:
        if 'preset' in checked:
            name = str(checked.pop('preset'))
            config = replace(config, preset=name, estimator=preset(name))
        for section in SECTIONS:
            changes = {name.partition('.')[2]: value for name, value in checked.items()
                       if name.startswith(f'{section}.')}
            if changes:
                changed = replace(getattr(config, section), **changes)
                config = replace(config, **{section: changed})
    except ValueError as error:
        raise DjetError(str(error)) from None
    return config


def from_flat(values: Mapping[str, Any]) -> Config:
    """Give the default configuration with some values changed; see ``with_values``."""
    return with_values(Config(), values)


def _lookup(name: str, known: Mapping[str, FlatParameter]) -> FlatParameter:
    if name in known:
        return known[name]
    by_last = {full.rpartition('.')[2]: full for full in known}
    near = difflib.get_close_matches(str(name), [*known, *by_last], n=1, cutoff=0.5)
    hint = f"; did you mean '{by_last.get(near[0], near[0])}'?" if near else ''
    raise DjetError(f"unknown parameter '{name}'{hint}")


def _typed(item: FlatParameter, value: Any) -> Value:
    """Check the type of a value, taking an int for a float and a YAML true for 'true'."""
    # YAML 1.1 takes 1e-4 for a text.
    if item.kind is float and type(value) in (int, float, str):
        return _finite(item, value)
    if item.kind is str and type(value) is bool and str(value).lower() in item.description.choices:
        return str(value).lower()
    if type(value) is not item.kind:
        raise _wrong_type(item, value)
    return cast(Value, value)


def _finite(item: FlatParameter, value: float | str) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    except ValueError:
        raise _wrong_type(item, value) from None
    if not math.isfinite(number):
        raise DjetError(f'{item.name} is {shown(value)}; it must be a finite number')
    return number


def _wrong_type(item: FlatParameter, value: Any) -> DjetError:
    return DjetError(f'{item.name} is {shown(value)}; it must be of type {item.kind.__name__}')


def shown(value: Any) -> str:
    try:
        return f'{value!r:.80}'
    except ValueError:
        # Python refuses to write out integers of thousands of digits.
        return 'a huge number'


def explain(item: FlatParameter) -> str:
    """One line for people: what the parameter means and which values it takes."""
    allowed = item.description
    if allowed.choices:
        return f'{allowed.text} [{" | ".join(allowed.choices)}]'
    if allowed.minimum is not None:
        odd = ', odd' if allowed.odd else ''
        return f'{allowed.text} [{allowed.minimum} to {allowed.maximum}{odd}]'
    return allowed.text


def parse_value(item: FlatParameter, text: str) -> Value:
    """Read a value of the parameter's type from a command line; DjetError where it isn't one."""
    try:
        if item.kind is bool:
            return {'true': True, 'false': False}[text.lower()]
        if item.kind is int:
            return int(text)
    except (ValueError, KeyError):
        raise _wrong_type(item, text) from None
    return _finite(item, text) if item.kind is float else text
