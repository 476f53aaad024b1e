"""Ablation of D-JET: single changes of a preset, as in the paper's Table 2."""

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

# Parameters that RP-E has too; changes of these are applied to both.
_SHARED_WITH_RPE = {'starts', 'loss', 'search_radius'}

# Limited steps need more iterations, and a smaller threshold of convergence, because each of them
# moves the pose little.
_ROUNDS = 20
_SMALL_STEPS: dict[str, Any] = {'max_iterations': _ROUNDS, 'epsilon': 1e-9}

# RP-E on matches refined by D-JET's gray-level alignment: all that joining adds except for the
# surfaces. The refinement uses the warps of D-JET's pose.
ON_PLACES = 'on places by gray levels'
WEIGHED = f'{ON_PLACES}, weighed by them'

# Resamples of the bootstrap.
_DRAWS = 2000


@dataclass(frozen=True)
class Change:
    """Changed parameters, and their description."""

    text: str
    values: Mapping[str, Any]

    def is_in(self, config: EstimatorConfig) -> bool:
        """Return whether a configuration has these values already."""
        return all(getattr(config, name) == value for name, value in self.values.items())


def changes(windows: Sequence[int]) -> dict[str, list[Change]]:
    """Return all changes by the part of the method that they affect; windows: sides in pixels."""
    return {
        'window': [Change(f'window {side}×{side}', {'window': side}) for side in windows],
        'weights': [Change('all samples weigh alike', {'window_sigma': 0.0}),
                    Change('samples weighed, sigma 1 px', {'window_sigma': 1.0})],
        'step': [Change('step: full', {'step': 'full'}),
                 Change(f'step: 1 px at most, {_ROUNDS} rounds', {
                     'step': 'pixel', **_SMALL_STEPS}),
                 *(Change(f'step: {share:.0%} of the way, {_ROUNDS} rounds', {
                     'step': 'share', 'step_share': share, **_SMALL_STEPS})
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
    Return D-JET with each preset and with each single change of it, and methods to compare.

    These are RP-E, with the changes that apply to it, and the 5-point method; if joining is
    varied, also RP-E on matches refined by gray levels, with equal weights and weighted by their
    covariances. good_start: see Method; it sets 'starts' to 'several', so that the given pose is
    one of them. Raises DjetError on unknown names and invalid windows.
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
            if change.values.keys() <= _SHARED_WITH_RPE:
                competing.append(_changed(base['rpe'], change))
        if 'joining' in parts and base['djet'].config.join_matches:
            competing += [replace(base['rpe'], change=change, on_places=True, weighed=weighed)
                          for change, weighed in ((ON_PLACES, False), (WEIGHED, True))]
    return competing


@dataclass(frozen=True)
class Ratio:
    """Ratio of two errors on the same pairs, and the bounds of its 95 % confidence interval."""

    value: float
    least: float
    most: float

    @property
    def significant(self) -> bool:
        """Return whether the interval excludes 1, so that one of the two is better."""
        return self.least > 1 or self.most < 1


def ratio_of(errors: Sequence[float] | Array, base: Sequence[float] | Array,
             statistic: Callable[..., Array] = np.mean) -> Ratio:
    """
    Return the mean or median of errors over that of base, on the pairs where both are finite.

    errors, base: (N,), of the same pairs. The interval is that of the percentile bootstrap over
    pairs (Efron and Tibshirani, An Introduction to the Bootstrap, chapter 13), with a fixed seed.
    All NaN if there is no such pair, or a resample of base is zero.
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
    """Return error ratios on common pairs, by 'rotation', 'direction' and 'mean', 'median'."""
    return {what: {kind: ratio_of(errors[:, 0], errors[:, 1], statistic)
                   for kind, statistic in (('mean', np.mean), ('median', np.median))}
            for what, errors in common_errors(records, base).items()}


def _changed(method: Method, change: Change) -> Method:
    try:
        return replace(method, config=replace(method.config, **change.values),
                       change=change.text)
    except ValueError as error:
        raise DjetError(str(error)) from None
