"""What each part of D-JET contributes: the paper's Table 2, and single changes of a preset."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from djet_ros.core.estimator_config import EstimatorConfig, PRESETS
from djet_ros.core.types import Array
from djet_ros.errors import DjetError
from djet_ros.lab.methods import check_names, configured, Method
from djet_ros.lab.pairs import PairRecord
from djet_ros.lab.summary import common_errors
import numpy as np

# Parameters that re-projection error has as well: a change of these is tried on both.
_OF_BOTH = {'starts', 'loss', 'search_radius'}

# Keypoints that go only part of the way need more rounds to arrive, and each moves the pose by so
# little that it would be taken to rest.
_ROUNDS = 20
_UNHURRIED: dict[str, Any] = {'max_iterations': _ROUNDS, 'epsilon': 1e-9}

# Re-projection error where D-JET's gray levels have the matches: all that joining adds but for the
# surfaces. The places themselves are seen through the warps of D-JET's pose.
ON_PLACES = 'on places by gray levels'
WEIGHED = f'{ON_PLACES}, weighed by them'

# Of the bootstrap.
_DRAWS = 2000


@dataclass(frozen=True)
class Change:
    """Some parameters that are set otherwise, and what that is in words."""

    text: str
    values: Mapping[str, Any]

    def is_in(self, config: EstimatorConfig) -> bool:
        """Tell whether a configuration has these values already."""
        return all(getattr(config, name) == value for name, value in self.values.items())


def changes(windows: Sequence[int]) -> dict[str, list[Change]]:
    """Give all changes by the part of the method that they concern."""
    return {
        'window': [Change(f'window {side}×{side}', {'window': side}) for side in windows],
        'weights': [Change('all samples weigh alike', {'window_sigma': 0.0}),
                    Change('samples weighed, sigma 1 px', {'window_sigma': 1.0})],
        'step': [Change('step: full', {'step': 'full'}),
                 Change(f'step: 1 px at most, {_ROUNDS} rounds', {'step': 'pixel', **_UNHURRIED}),
                 *(Change(f'step: {share:.0%} of the way, {_ROUNDS} rounds', {
                     'step': 'share', 'step_share': share, **_UNHURRIED})
                   for share in (0.1, 0.2, 0.3))],
        'loss': [Change(f'loss: {word}', {'loss': name})
                 for name, word in (('none', 'squares'), ('huber', 'Huber'), ('cauchy', 'Cauchy'),
                                    ('geman_mcclure', 'Geman-McClure'))],
        'patch': [Change("patches of ORB's size", {'patch_scale': 1.0}),
                  Change('patches of half the size', {'patch_scale': 0.5})],
        'grading': [Change('bits, as in ORB', {'grading': 0.0}),
                    Change('graded tests', {'grading': EstimatorConfig.grading})],
        'tests': [Change('all 256 tests', {'binary_tests': 256}),
                  Change('128 tests', {'binary_tests': 128})],
        'warp': [Change('patches not warped', {'warp_reference': False}),
                 Change('patches warped', {'warp_reference': True})],
        'joining': [Change('surfaces alone', {'join_matches': False}),
                    Change('surfaces and matches', {'join_matches': True})],
        'recentring': [Change('window not re-centred', {'max_iterations': 1})],
        'indefinite': [Change(f'indefinite fits: {word}', {'indefinite': name})
                       for name, word in (('keep', 'kept'), ('drop', 'dropped'),
                                          ('project', 'projected'))],
        'culling': [Change('minima outside: believed', {'cull_outside': False}),
                    Change('minima outside: culled', {'cull_outside': True})],
        'starts': [Change('start: 5-point only', {'starts': 'five_point'}),
                   Change('starts: several', {'starts': 'several'})],
        'matching': [Change('matches: whole image', {'search_radius': 1.0}),
                     Change('matches: nearby', {'search_radius': EstimatorConfig.search_radius})],
    }


PARTS = tuple(changes(()))


def ablation_methods(presets: Sequence[str], parts: Sequence[str], windows: Sequence[int],
                     values: Mapping[str, Any], *, good_start: bool = False) -> list[Method]:
    """
    Let D-JET start with each preset and with each single change of it.

    Beside them start RP-E, with the changes that it knows too, and the 5-point method; where
    joining is changed, RP-E on the places that gray levels give as well, all alike and each as
    exact as these say. good_start: see Method; presets with the 5-point start take it among
    several then. Raises DjetError on unknown names and on windows that can't be.
    """
    check_names('preset', presets, PRESETS)
    check_names('part', parts, PARTS)
    chosen = changes(windows)
    if good_start:
        values = {**values, 'starts': 'several'}
    competing: list[Method] = []
    for name in presets:
        base = {method: Method(method, name, configured(method, name, values),
                               good_start=good_start)
                for method in ('djet', 'rpe', 'five_point')}
        competing += base.values()
        for change in (change for part in parts for change in chosen[part]):
            if change.is_in(base['djet'].config):
                continue
            competing.append(_changed(base['djet'], change))
            if change.values.keys() <= _OF_BOTH:
                competing.append(_changed(base['rpe'], change))
        if 'joining' in parts and base['djet'].config.join_matches:
            competing += [replace(base['rpe'], change=change, on_places=True, weighed=weighed)
                          for change, weighed in ((ON_PLACES, False), (WEIGHED, True))]
    return competing


@dataclass(frozen=True)
class Ratio:
    """One error over another's on the same pairs, and the bounds of its 95 % interval."""

    value: float
    least: float
    most: float

    @property
    def told(self) -> bool:
        """Whether one is outside: otherwise the pairs do not tell which is better."""
        return self.least > 1 or self.most < 1


def ratio_of(errors: Sequence[float] | Array, base: Sequence[float] | Array,
             statistic: Callable[..., Array] = np.mean) -> Ratio:
    """
    Mean or median of errors over that of base, pair by pair the same ones; of pairs both know.

    The interval is that of the percentile bootstrap over pairs (Efron and Tibshirani, An
    Introduction to the Bootstrap, chapter 13), always by the same draws; all NaN where nothing
    is known, or no error is left to divide by.
    """
    both = np.array([errors, base], dtype=float)
    both = both[:, np.isfinite(both).all(axis=0)]
    count = both.shape[1]
    if not count:
        return Ratio(*[float('nan')] * 3)
    draws = np.random.default_rng(0).integers(count, size=(_DRAWS, count))
    drawn, whole = statistic(both[:, draws], axis=2), statistic(both, axis=1)
    if not drawn[1].all():
        return Ratio(*[float('nan')] * 3)
    least, most = np.percentile(drawn[0] / drawn[1], (2.5, 97.5))
    return Ratio(float(whole[0] / whole[1]), float(least), float(most))


def ratios_to_base(records: Sequence[PairRecord], base: Sequence[PairRecord]
                   ) -> dict[str, dict[str, Ratio]]:
    """Errors over those of base on the same pairs: 'rotation', 'direction'; 'mean', 'median'."""
    return {what: {kind: ratio_of(errors[:, 0], errors[:, 1], statistic)
                   for kind, statistic in (('mean', np.mean), ('median', np.median))}
            for what, errors in common_errors(records, base).items()}


def _changed(method: Method, change: Change) -> Method:
    try:
        return replace(method, config=replace(method.config, **change.values),
                       change=change.text)
    except ValueError as error:
        raise DjetError(str(error)) from None
