"""Methods of an evaluation, ours and those of other libraries, with their parameters."""

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

# All methods in the order of tables, with their printed names.
TITLES = {'djet': 'D-JET', 'rpe': 'RP-E', 'pjet': 'P-JET', 'five_point': '5-P',
          'opencv_ransac': 'RANSAC', 'usac_magsac': 'MAGSAC++',
          'poselib': 'PoseLib', 'sift_poselib': 'SIFT+PL', 'klt_poselib': 'KLT+PL'}


@dataclass(frozen=True)
class Method:
    """
    A method with all of its parameters.

    name: one of TITLES; preset: source of the parameters; change: description of the difference
    to the preset, '' if there is none; good_start: whether to add the pose of RP-E, preset best,
    as an initial pose, and use only its inliers as matches; on_places: whether matches are first
    refined by D-JET's gray-level alignment, with the warps of its pose; weighed: whether they are
    then weighted by the covariances of that alignment. Methods of other libraries take the matches
    of config, except for complete pipelines (see chains), which do not use it.
    """

    name: str
    preset: str
    config: EstimatorConfig
    change: str = ''
    good_start: bool = False
    on_places: bool = False
    weighed: bool = False

    def settings(self) -> dict[str, Any]:
        """Return everything that decides the results, as plain values."""
        values = asdict(self)
        return {'method': values.pop('name'), **values}


def default_methods() -> tuple[str, ...]:
    """Return our methods, and those of the installed other libraries."""
    return tuple(name for name in TITLES if name not in PEERS or find_spec(PEERS[name]))


def make_methods(names: Sequence[str], presets: Sequence[str],
                 values: Mapping[str, Any]) -> list[Method]:
    """
    Return every method with every preset; values: parameters that override the presets.

    Raises DjetError on unknown names and on libraries that are not installed.
    """
    check_methods(names)
    check_names('preset', presets, PRESETS)
    return [Method(name, preset_name, configured(name, preset_name, values))
            for preset_name in presets for name in names]


def configured(method: str, preset_name: str, values: Mapping[str, Any]) -> EstimatorConfig:
    """Return the parameters of a method (other libraries: of the 5-point). Raises DjetError."""
    own = method if method in METHODS else 'five_point'
    try:
        return preset(preset_name, **{**values, 'method': own})
    except ValueError as error:
        raise DjetError(str(error)) from None


def check_methods(methods: Sequence[str]) -> None:
    """Raise DjetError on unknown, repeated or uninstalled methods, or if there is none."""
    check_names('method', methods, TITLES)
    for method in methods:
        if method in PEERS and find_spec(PEERS[method]) is None:
            raise DjetError(f"method '{method}' needs the module '{PEERS[method]}', which is not "
                            f'installed: {how_to_get(PEERS[method])}')


def check_names(what: str, given: Sequence[str], known: Iterable[str]) -> None:
    """Raise DjetError on the first name that is unknown or repeated, or if none is given."""
    choices = list(known)
    for index, name in enumerate(given):
        if name not in choices:
            raise DjetError(f"there is no {what} '{name}'; choose from {', '.join(choices)}")
        if name in given[:index]:
            raise DjetError(f"{what} '{name}' is given twice; name each once")
    if not given:
        raise DjetError(f'no {what} is given; choose from {", ".join(choices)}')
