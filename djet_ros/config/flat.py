"""
All parameters by flat name, as in ROS: ``estimator.window``, ``odometry.max_gap``.

ROS parameters, YAML files and command-line flags are all derived from these.
"""

from __future__ import annotations

from array import array
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

# difflib ratio above which an unknown name is taken for a misspelling.
_MISSPELLING_RATIO = 0.75


@dataclass(frozen=True)
class FlatParameter:
    """A parameter with its flat name, value, type (kind) and description."""

    name: str
    value: Value
    kind: type
    description: Description


def flat(config: Config) -> dict[str, FlatParameter]:
    """Return all parameters of a configuration by flat name, in order of declaration."""
    return {item.name: item for name in ('', *SECTIONS) for item in section(config, name)}


def section(config: Config, part: str) -> Iterator[FlatParameter]:
    """Yield the parameters of a section; '' is the top level."""
    owner = getattr(config, part) if part else config
    for name, description in describe(owner).items():
        value = getattr(owner, name)
        yield FlatParameter(f'{part}.{name}' if part else name, value, type(value),
                            description)


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """
    Return the configuration with some parameters changed, by flat name.

    A preset among the values is applied first, to the whole estimator; the other values override
    it. An int is accepted for a float, and a list of numbers for a string of numbers. Raises
    DjetError on an unknown name (suggesting the most similar one), a wrong type, and a value
    outside its described range.
    """
    known = flat(config)
    if strange := [name for name in values if name not in known]:
        raise DjetError(why_unknown(strange[0]))
    checked = {name: _typed(known[name], value) for name, value in values.items()}
    mark = ''
    try:
        if 'preset' in checked:
            name = str(checked.pop('preset'))
            config = replace(config, preset=name, estimator=preset(name))
        for part in SECTIONS:
            mark = f'{part}.'
            changes = {name.removeprefix(mark): value for name, value in checked.items()
                       if name.startswith(mark)}
            if changes:
                changed = replace(getattr(config, part), **changes)
                mark = ''  # checks across sections use full names in their messages
                config = replace(config, **{part: changed})
    except ValueError as error:
        raise DjetError(f'{mark}{error}') from None
    return config


def from_flat(values: Mapping[str, Any]) -> Config:
    """Return the default configuration with some values changed; see ``with_values``."""
    return with_values(Config(), values)


def why_unknown(name: str) -> str:
    """Return the error text for an unknown parameter, suggesting the most similar name."""
    if name in SECTIONS:
        of_it = next(one for one in flat(Config()) if one.startswith(f'{name}.'))
        return f"'{name}' is a section and has no value; set its parameters, such as {of_it}"
    return f"unknown parameter '{name}'{_hint(name)}"


def _hint(name: str) -> str:
    """Return what was probably meant by the name of an unknown parameter, or ''."""
    def similarity(full: str) -> tuple[float, float]:
        return _ratio(full.rpartition('.')[2], last), _ratio(full, name)

    first, last = name.partition('.')[0], name.rpartition('.')[2]
    nearest = max(flat(Config()), key=similarity)
    if similarity(nearest)[0] > _MISSPELLING_RATIO:
        return f"; did you mean '{nearest}'?"
    if last in SECTIONS:
        return f"; a file with names of nodes needs ros__parameters between them and '{last}'"
    part = max(SECTIONS, key=lambda one: _ratio(one, first))
    if first not in SECTIONS and _ratio(part, first) > _MISSPELLING_RATIO:
        return f"; did you mean the section '{part}'?"
    return ''


def _ratio(a: str, b: str) -> float:
    return difflib.SequenceMatcher(None, a, b).ratio()


def _typed(item: FlatParameter, value: Any) -> Value:
    """Check the type of a value, converting int to float and YAML's true to 'true'."""
    # YAML 1.1 reads 1e-4 as a string.
    if item.kind is float and type(value) in (int, float, str):
        return _finite(item, value)
    if item.kind is str and type(value) is bool and str(value).lower() in item.description.choices:
        return str(value).lower()
    # rclpy turns lists of numbers into arrays.
    if item.description.numbers and isinstance(value, (list, tuple, array)) \
            and all(type(one) in (int, float) for one in value):
        return ' '.join(map(str, value))
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
    """Return a value as shown in error messages, shortened."""
    try:
        return f'{value!r:.80}'
    except ValueError:
        # Python refuses to convert integers of thousands of digits to text.
        return 'a huge number'


def parse_value(item: FlatParameter, text: str) -> Value:
    """Parse a value of the parameter's type from a command line; DjetError if it is not one."""
    try:
        if item.kind is bool:
            return {'true': True, 'false': False}[text.lower()]
        if item.kind is int:
            return int(text)
    except (ValueError, KeyError):
        raise _wrong_type(item, text) from None
    return _finite(item, text) if item.kind is float else text
