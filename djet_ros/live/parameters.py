"""What a live node makes of its parameters, before ROS or a command line declares them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import difflib
from typing import Any

from djet_ros.config.flat import flat, from_flat
from djet_ros.config.sections import Config
from djet_ros.errors import DjetError

# What a subscription or the queue was made with holds for its life.
FIXED = ('ros.image_transport', 'ros.qos_reliability', 'ros.qos_depth', 'ros.queue_policy',
         'ros.queue_size')

# Of the odometry's parameters, those that a pose graph goes by too, beside the estimator's.
SHARED = ('preset', 'odometry.scale_uncertainty', 'odometry.rectified',
          'odometry.frame_convention', 'ros.image_transport', 'ros.qos_reliability',
          'ros.queue_policy')

KNOWN = flat(Config())


def known(values: Mapping[str, Any]) -> dict[str, Any]:
    """Give those values that are parameters of the configuration."""
    return {name: value for name, value in values.items() if name in KNOWN}


def for_a_live_graph(config: Config) -> Config:
    """Refuse what can't be had on a live graph."""
    if config.odometry.scale == 'ground_truth':
        raise DjetError("odometry.scale is 'ground_truth', which only a recording has; choose "
                        'none, constant, speed or camera_height')
    return config


def unknown_parameter(name: str, own: Iterable[str] = ()) -> str:
    """Word why an unknown name is unknown; own: names beside those of the configuration."""
    if near := difflib.get_close_matches(name, own, n=1, cutoff=0.8):
        return f"unknown parameter '{name}'; did you mean '{near[0]}'?"
    try:
        from_flat({name: None})
    except DjetError as error:
        return str(error)
    raise ValueError(f'{name} is a parameter')
