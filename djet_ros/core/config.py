"""Parameters of the two-view estimator and its two presets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from djet_ros.core.parameter import check, parameter

METHODS = ('djet', 'pjet', 'rpe', 'five_point')
PRESETS = ('best', 'paper')


@dataclass(frozen=True)
class EstimatorConfig:
    """
    Everything that somebody would turn on the way from two images to a pose.

    The defaults are the preset ``best`` (everything known to help); ``preset('paper')`` gives
    the algorithm as printed. Raises ValueError on a value outside its described range.
    """

    method: str = parameter(
        'djet', 'residual surface: djet (descriptors), pjet (intensities), rpe (re-projection), '
        'or five_point (the start alone)', choices=METHODS)
    max_features: int = parameter(
        2000, 'ORB features detected per image', minimum=8, maximum=20000)
    min_matches: int = parameter(
        20, 'fewer matches than this give status TOO_FEW_MATCHES', minimum=8, maximum=10000)
    window: int = parameter(
        7, 'side of the square in which a residual surface is sampled, in pixels',
        minimum=3, maximum=15, odd=True)

    def __post_init__(self) -> None:
        """Refuse values outside their described range."""
        check(self)


def preset(name: str, **changes: Any) -> EstimatorConfig:
    """Give the preset 'best' or 'paper', with some parameters changed."""
    if name not in PRESETS:
        raise ValueError(f"preset is '{name}'; choose from {', '.join(PRESETS)}")
    printed: dict[str, Any] = {} if name == 'best' else {}
    return replace(EstimatorConfig(), **{**printed, **changes})
