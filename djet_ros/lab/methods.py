"""Who takes part in an evaluation: our methods and their peers, each with its parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from typing import Any

from djet_ros.core.estimator_config import EstimatorConfig, METHODS, preset, PRESETS
from djet_ros.errors import DjetError
from djet_ros.libraries import how_to_get

# Methods of other libraries, and the module that each needs.
PEERS = {'opencv_ransac': 'cv2', 'usac_magsac': 'cv2', 'poselib': 'poselib',
         'sift_poselib': 'poselib', 'klt_poselib': 'poselib'}

# All methods in the order of tables, and what people call them.
TITLES = {'djet': 'D-JET', 'rpe': 'RP-E', 'pjet': 'P-JET', 'five_point': '5-P',
          'opencv_ransac': 'RANSAC', 'usac_magsac': 'MAGSAC++',
          'poselib': 'PoseLib', 'sift_poselib': 'SIFT+PL', 'klt_poselib': 'KLT+PL'}


@dataclass(frozen=True)
class Method:
    """
    A method with all of its parameters.

    name: one of TITLES; preset: where the parameters come from; change: what differs from it, in
    words, empty if nothing does; good_start: whether the pose of RP-E, preset best, is given as
    one more start, and only the matches that agree with it; on_places: whether matches begin where
    D-JET's gray levels have them, seen through the warps of its pose; weighed: whether these count
    as exact as gray levels say. Peers take their matches and their RANSAC threshold from config,
    but for those that are whole chains (see chains), which take nothing.
    """

    name: str
    preset: str
    config: EstimatorConfig
    change: str = ''
    good_start: bool = False
    on_places: bool = False
    weighed: bool = False

    def settings(self) -> dict[str, Any]:
        """Everything that decides the results, as plain values."""
        values = asdict(self)
        return {'method': values.pop('name'), **values}


def default_methods() -> tuple[str, ...]:
    """Give our methods and those of the peers that are installed."""
    return tuple(name for name in TITLES if name not in PEERS or find_spec(PEERS[name]))


def make_methods(names: Sequence[str], presets: Sequence[str],
                 values: Mapping[str, Any]) -> list[Method]:
    """
    Let every method start with every preset, with some values of both changed.

    Raises DjetError on unknown names and on peers that are not installed.
    """
    check_methods(names)
    check_names('preset', presets, PRESETS)
    return [Method(name, preset_name, configured(name, preset_name, values))
            for preset_name in presets for name in names]


def configured(method: str, preset_name: str, values: Mapping[str, Any]) -> EstimatorConfig:
    """Parameters of a method; peers have those of the 5-point method. DjetError on bad values."""
    own = method if method in METHODS else 'five_point'
    try:
        return preset(preset_name, **{**values, 'method': own})
    except ValueError as error:
        raise DjetError(str(error)) from None


def check_methods(methods: Sequence[str]) -> None:
    """Raise DjetError on unknown, repeated or missing methods."""
    check_names('method', methods, TITLES)
    for method in methods:
        if method in PEERS and find_spec(PEERS[method]) is None:
            raise DjetError(f"method '{method}' needs the module '{PEERS[method]}', which is not "
                            f'installed: {how_to_get(PEERS[method])}')


def check_names(what: str, given: Sequence[str], known: Iterable[str]) -> None:
    """Raise DjetError on the first name that is not known or comes twice, or if none is given."""
    choices = list(known)
    for index, name in enumerate(given):
        if name not in choices:
            raise DjetError(f"there is no {what} '{name}'; choose from {', '.join(choices)}")
        if name in given[:index]:
            raise DjetError(f"{what} '{name}' is given twice; name each once")
    if not given:
        raise DjetError(f'no {what} is given; choose from {", ".join(choices)}')
