"""
The one configuration: everything that somebody would turn, with its meaning and its bounds.

ROS parameters, YAML files and command-line flags are all derived from these dataclasses. A
parameter is addressed by its flat name, as in ROS: ``estimator.window``, ``odometry.max_gap``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
import difflib
import json
import math
from pathlib import Path
import textwrap
from typing import Any, cast

from djet_ros.core.config import EstimatorConfig, preset, PRESETS
from djet_ros.core.parameter import check, describe, Description, parameter
from djet_ros.data.text import read_yaml
from djet_ros.errors import DjetError

Value = bool | int | float | str

NODE_NAME = 'vo_node'

# Parameters that every ROS node may find in its section and that are not ours to judge.
_ROS_OWN = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


@dataclass(frozen=True)
class OdometryConfig:
    """How pairs become a trajectory. Raises ValueError on a value outside its description."""

    max_gap: float = parameter(
        1.0, 'seconds between two frames beyond which they are not related to one another',
        minimum=1e-3, maximum=3600.0)
    max_lost: int = parameter(
        3, 'bad pairs in a row after which the reference frame is given up for the newest frame',
        minimum=1, maximum=1000)
    standstill: float = parameter(
        0.3, 'median displacement of the matches, in pixels, below which the camera stands still '
        'and the reference frame stays', minimum=0.0, maximum=10.0)
    scale: str = parameter(
        'none', 'where the length of a translation comes from: none (unit length), constant '
        '(scale_value), speed (a speed topic), camera_height (the height over the ground that the '
        'images show), ground_truth (offline only)',
        choices=('none', 'constant', 'speed', 'camera_height', 'ground_truth'))
    scale_value: float = parameter(
        1.0, 'length of each translation in metres, for scale constant',
        minimum=1e-6, maximum=1e6)
    scale_uncertainty: float = parameter(
        0.05, 'standard deviation of a known length, as a share of it; for scale camera_height '
        'that of the height, and what the images leave uncertain comes on top',
        minimum=1e-6, maximum=10.0)
    camera_height: float = parameter(
        1.0, 'metres from flat ground up to the camera, for scale camera_height',
        minimum=0.01, maximum=1000.0)
    camera_pitch: float = parameter(
        0.0, 'degrees by which the camera looks down, to within 2, for scale camera_height; it '
        'must not roll', minimum=-30.0, maximum=80.0)
    rectified: str = parameter(
        'auto', 'whether images come rectified: true (camera is P), false (camera is K, D), auto '
        "(true where the image topic's last name has 'rect' in it, else false)",
        choices=('auto', 'true', 'false'))
    frame_convention: str = parameter(
        'optical', 'axes of all poses: optical (z forward, x right, y down) or body (x forward, '
        'y left, z up)', choices=('optical', 'body'))
    camera_frame: str = parameter(
        '', "frame id of the camera in messages; empty takes the image's own")
    odom_frame: str = parameter('odom', 'frame id in which the integrated pose is given')

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)


@dataclass(frozen=True)
class NodeConfig:
    """What is between the odometry and the graph. Raises ValueError like its sisters."""

    image_transport: str = parameter(
        'raw', 'raw (image) or compressed (image/compressed, JPEG or PNG)',
        choices=('raw', 'compressed'))
    qos_reliability: str = parameter(
        'best_effort', 'of the subscriptions; best_effort hears every publisher (queue_policy '
        'every subscribes reliably in any case)', choices=('best_effort', 'reliable'))
    qos_depth: int = parameter(
        5, 'messages that the middleware keeps for each subscription (with queue_policy every: '
        'all)', minimum=1, maximum=1000)
    queue_policy: str = parameter(
        'latest', 'latest (under load old frames are dropped and counted) or every (none is '
        'dropped: for a bag played into the node)', choices=('latest', 'every'))
    queue_size: int = parameter(
        2, 'frames that may wait; beyond it latest drops the oldest, every lets the sender wait',
        minimum=1, maximum=1000)
    publish_tf: bool = parameter(
        False, 'whether the integrated pose is also published as odom_frame -> camera frame on tf')
    publish_path: bool = parameter(
        False, 'whether the integrated poses are also published as a path')
    path_period: float = parameter(
        1.0, 'seconds between two paths', minimum=0.0, maximum=3600.0)
    path_length: int = parameter(
        5000, 'newest poses that a path keeps', minimum=1, maximum=1_000_000)

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)


@dataclass(frozen=True)
class Config:
    """
    All parameters, in the three sections that the flat names begin with.

    ``preset`` names where the values of ``estimator`` started from; ``with_values`` keeps the two
    in step.
    """

    preset: str = parameter(
        'best', 'defaults of the estimator: best (everything known to help) or paper (the '
        'algorithm as printed); values given for the estimator come on top', choices=PRESETS)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    ros: NodeConfig = field(default_factory=NodeConfig)

    def __post_init__(self) -> None:
        """Refuse an unknown preset."""
        check(self)


SECTIONS = ('estimator', 'odometry', 'ros')


@dataclass(frozen=True)
class FlatParameter:
    """One parameter under its flat name, with its value, its type (kind) and its description."""

    name: str
    value: Value
    kind: type
    description: Description


def flat(config: Config) -> dict[str, FlatParameter]:
    """All parameters of the configuration by flat name, in the order of declaration."""
    return {item.name: item for section in ('', *SECTIONS) for item in _section(config, section)}


def _section(config: Config, section: str) -> Iterator[FlatParameter]:
    owner = getattr(config, section) if section else config
    for name, description in describe(owner).items():
        value = getattr(owner, name)
        yield FlatParameter(f'{section}.{name}' if section else name, value, type(value),
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
        raise DjetError(f'{item.name} is {_shown(value)}; it must be a finite number')
    return number


def _wrong_type(item: FlatParameter, value: Any) -> DjetError:
    return DjetError(f'{item.name} is {_shown(value)}; it must be of type {item.kind.__name__}')


def _shown(value: Any) -> str:
    try:
        return f'{value!r:.80}'
    except ValueError:
        # Python refuses to write out integers of thousands of digits.
        return 'a huge number'


def load_yaml(path: Path, base: Config | None = None) -> Config:
    """
    Read a YAML file over the base configuration (by default all defaults).

    Both layouts are read: plain nested sections, and ROS's ``node: ros__parameters:`` with the
    node names ``/**`` and ``vo_node``. Raises DjetError, beginning with the path, on anything
    that is not such a file.
    """
    content = read_yaml(path)
    try:
        return with_values(base or Config(), dict(_flatten(_ours(content))))
    except DjetError as error:
        raise DjetError(f'{path}: {error}') from None


def _ours(content: Any) -> Any:
    """Take this node's parameters out of ROS's layout; a plain layout stays as it is."""
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise DjetError('the file must hold sections with parameters')
    nodes = {name: value['ros__parameters'] for name, value in content.items()
             if isinstance(value, dict) and 'ros__parameters' in value}
    if not nodes:
        return content
    merged: dict[str, Any] = {}
    for name, parameters in nodes.items():
        if str(name).rpartition('/')[2] in ('**', '*', NODE_NAME):
            merged.update((key, value) for key, value in _flatten(parameters)
                          if not is_ros_own(key))
    return merged


def is_ros_own(name: str) -> bool:
    """Tell of a parameter whether every ROS node has it, such as use_sim_time."""
    return name.partition('.')[0] in _ROS_OWN


def _flatten(content: Any) -> Iterator[tuple[str, Any]]:
    """Flat names and values; only our own sections are entered, so the depth is bounded."""
    if not isinstance(content, dict):
        raise DjetError(f'{_shown(content)} stands where parameters were expected')
    for name, value in content.items():
        if name in SECTIONS and isinstance(value, dict):
            yield from ((f'{name}.{inner}', inner_value) for inner, inner_value in value.items())
        elif name not in SECTIONS or value is not None:
            yield str(name), value


_YAML_HEAD = """\
# Parameters of vo_node, also read by `djet replay --config FILE`.
# Made from djet_ros/config.py by its dump_yaml; a test holds that the two agree.
"""

_PRESET_NOTE = """\
# The values that the preset sets are shown as comments; uncomment one to change it.
"""


def dump_yaml(config: Config, *, preset_as_comments: bool = False) -> str:
    """
    Write the configuration as YAML in ROS's layout, each parameter under its description.

    With preset_as_comments the estimator's values that the preset gives anyway are commented
    out, so that the file leaves the choice of preset free.
    """
    silent = set()
    if preset_as_comments:
        given = flat(replace(config, estimator=preset(config.preset)))
        silent = {item.name for item in _section(config, 'estimator')
                  if item.value == given[item.name].value}
    lines = ['/**:', '  ros__parameters:']
    for section in ('', *SECTIONS):
        indent = '    '
        if section:
            lines += ['', f'{indent}{section}:']
            indent = '      '
        for item in _section(config, section):
            lines += textwrap.wrap(explain(item), 97, initial_indent=f'{indent}# ',
                                   subsequent_indent=f'{indent}# ')
            mark = '# ' if item.name in silent else ''
            name = item.name.rpartition('.')[2]
            lines.append(f'{indent}{mark}{name}: {_yaml_scalar(item.value)}')
    if silent.issuperset(item.name for item in _section(config, 'estimator')):
        # A section of comments alone would be null, which ROS refuses.
        lines = [f'    # {line.strip()}' if line == '    estimator:' else line for line in lines]
    return _YAML_HEAD + (_PRESET_NOTE if silent else '') + '\n'.join(lines) + '\n'


def explain(item: FlatParameter) -> str:
    """One line for people: what the parameter means and which values it takes."""
    allowed = item.description
    if allowed.choices:
        return f'{allowed.text} [{" | ".join(allowed.choices)}]'
    if allowed.minimum is not None:
        odd = ', odd' if allowed.odd else ''
        return f'{allowed.text} [{allowed.minimum} to {allowed.maximum}{odd}]'
    return allowed.text


def _yaml_scalar(value: Value) -> str:
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition('e')
        # YAML 1.1 readers take 1e-06 for a string, and 1.0e-06 for the number that it is.
        return f'{mantissa}.0e{exponent}' if e and '.' not in mantissa else repr(value)
    return json.dumps(value)


def add_flags(parser: argparse.ArgumentParser, names: Iterable[str]) -> None:
    """
    Add a command-line flag for each flat name: ``--max-gap`` for ``odometry.max_gap``.

    ``flag_values`` takes what was given out of the parsed arguments.
    """
    known = flat(Config())
    for name in names:
        item = known[name]
        choices = item.description.choices
        parser.add_argument(
            '--' + name.rpartition('.')[2].replace('_', '-'), dest=name, default=None,
            metavar='|'.join(choices) if choices else item.kind.__name__.upper(),
            help=f'{item.description.text} (default: {item.value!r})'.replace('%', '%%'))


def flag_values(args: argparse.Namespace) -> dict[str, Any]:
    """Give the parameters given as flags, by flat name; DjetError where one can't be read."""
    known = flat(Config())
    return {name: parse_value(known[name], text) for name, text in vars(args).items()
            if name in known and text is not None}


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
