"""What each part of D-JET contributes: the paper's Table 2, and single changes of a preset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from djet_ros.core.estimator_config import EstimatorConfig, PRESETS
from djet_ros.errors import DjetError
from djet_ros.lab.methods import check_names, configured, Method

# Parameters that re-projection error has as well: a change of these is tried on both.
_OF_BOTH = {'starts', 'loss', 'search_radius'}

# Keypoints that go only part of the way need more rounds to arrive.
_ROUNDS = 20


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
                 Change('step: 1 px at most', {'step': 'pixel', 'max_iterations': _ROUNDS}),
                 *(Change(f'step: {share:.0%} of the way', {
                     'step': 'share', 'step_share': share, 'max_iterations': _ROUNDS})
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

    Beside them start RP-E, with the changes that it knows too, and the 5-point method.
    good_start: see Method; presets with the 5-point start take it among several then. Raises
    DjetError on unknown names and on windows that can't be.
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
    return competing


def _changed(method: Method, change: Change) -> Method:
    try:
        return replace(method, config=replace(method.config, **change.values),
                       change=change.text)
    except ValueError as error:
        raise DjetError(str(error)) from None
