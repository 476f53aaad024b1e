"""Which libraries can be had how, for whoever finds one missing."""

from __future__ import annotations

import shlex

# What pip is asked for where that is not the module's name: its distribution, or a bound that
# those who have the others from Ubuntu would miss.
REQUIREMENTS = {
    'backports': 'backports.zstd',
    'cv2': 'opencv-python-headless',
    'rosbags': 'rosbags>=0.11,<0.12',
    'yaml': 'PyYAML',
}

# The extra of this package that brings a module, within the bounds of setup.py.
EXTRAS = {
    'cyclonedds': 'dds',
    'distributed': 'cluster',
    'evo': 'peers',
    'gtsam': 'slam',
    'poselib': 'peers',
}


def how_to_get(module: str) -> str:
    """Word how a module is installed: with an extra of this package, or by itself."""
    if module in EXTRAS:
        return f"pip install './djet_ros[{EXTRAS[module]}]' (the folder with the README)"
    requirement = REQUIREMENTS.get(module, module)
    return f'pip install {shlex.quote(requirement)}'
