"""Static masks, read from image files."""

from __future__ import annotations

from pathlib import Path

from djet_ros.odometry.masks import left_out
from djet_ros.recordings.frame_sequence import ImageFiles
import numpy as np
from numpy.typing import NDArray


def static_mask(path: str) -> NDArray[np.bool_] | None:
    """Return the excluded pixels (H, W) of a mask file, None for no file. Raises DjetError."""
    return left_out(ImageFiles([Path(path)]).gray(0)) if path else None
