"""Static masks, read from image files."""

from __future__ import annotations

from pathlib import Path

from djet_ros.core.masks import blocked
from djet_ros.errors import DjetError
from djet_ros.odometry.masks import FREE, left_out
from djet_ros.recordings.frame_sequence import ImageFiles
import numpy as np
from numpy.typing import NDArray


def static_mask(path: str) -> NDArray[np.bool_] | None:
    """
    Return the excluded pixels (H, W) of a mask file, None for no file.

    Raises DjetError if there is no such file, or if it leaves no place for a feature.
    """
    if not path:
        return None
    gray = ImageFiles([Path(path)]).gray(0)
    excluded = left_out(gray)
    if blocked(excluded).all():
        raise DjetError(f'{path} excludes the whole image, or leaves no place for a feature: '
                        f'pixels below {FREE} are excluded, and its values are {gray.min()} to '
                        f'{gray.max()}; make 255 what is to be used')
    return excluded
