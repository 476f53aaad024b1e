"""Image messages to undistorted gray images and views, in parallel ahead of their turn."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from djet_ros.core.estimator import TwoViewEstimator
from djet_ros.core.parallel import start_in_background
from djet_ros.core.types import View
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.images import few_levels, FewLevels, Gray, gray_image

# Images that are prepared ahead.
_AHEAD = 2


class Preprocessed(NamedTuple):
    """
    An undistorted gray image.

    shape: of the image before undistortion; view: without the pixels that the camera does not
    see, None if it was not prepared; few_levels: of a 16-bit image with few gray levels.
    """

    gray: Gray
    shape: tuple[int, ...]
    view: View | None
    few_levels: FewLevels | None


class Settings(NamedTuple):
    """What an image is prepared with; limits: see ``gray_image``."""

    camera: Camera
    estimator: TwoViewEstimator
    limits: tuple[int, int]


class _Ahead(NamedTuple):
    """An image that is being prepared; result: waits for it."""

    message: Any
    settings: Settings
    result: Callable[[], Preprocessed]


class Preprocessor:
    """Prepares images; the result does not depend on whether that began ahead of their turn."""

    def __init__(self) -> None:
        self._ahead: deque[_Ahead] = deque(maxlen=_AHEAD)

    def start(self, message: Any, settings: Settings, with_view: bool) -> None:
        """Begin to prepare an image in parallel, unless that has begun."""
        if any(one.message is message for one in self._ahead):
            return
        self._ahead.append(_Ahead(message, settings, start_in_background(
            lambda: _preprocessed(message, settings, with_view))))

    def image(self, message: Any, settings: Settings) -> Preprocessed:
        """Return an image, as it was prepared ahead with the same settings; raises BadMessage."""
        for one in self._ahead:
            if one.message is message:
                self._ahead.remove(one)
                if one.settings == settings:
                    return one.result()
                break
        return _preprocessed(message, settings, with_view=False)


def _preprocessed(message: Any, settings: Settings, with_view: bool) -> Preprocessed:
    camera, estimator, limits = settings
    raw = gray_image(message, limits)
    gray = camera.corrected(raw)
    view = estimator.view(gray, camera.K, left_out=camera.unseen(raw.shape)) if with_view else None
    return Preprocessed(gray, raw.shape, view, few_levels(message, raw))
