"""Which libraries cannot be used, and how to install them."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
import shlex

# Requirements of pip that are not the module's name: its distribution, or a bound that an
# installation from Ubuntu's packages would lack.
REQUIREMENTS = {
    'backports': 'backports.zstd',
    'cv2': 'opencv-python-headless',
    'rosbags': 'rosbags>=0.11,<0.12',
    'yaml': 'PyYAML',
}

# The extra of this package that installs a module, within the bounds of setup.py.
EXTRAS = {
    'cyclonedds': 'dds',
    'distributed': 'cluster',
    'evo': 'peers',
    'gtsam': 'slam',
    'poselib': 'peers',
}


def how_to_get(module: str) -> str:
    """Return the command that installs a module: with an extra of this package, or by itself."""
    if module in EXTRAS:
        return f"pip install './djet_ros[{EXTRAS[module]}]' (the folder with the README)"
    requirement = REQUIREMENTS.get(module, module)
    return f'pip install {shlex.quote(requirement)}'


def problem_of(module: str) -> str:
    """Return why a module cannot be used, and the remedy; '' if it can."""
    if find_spec(module) is None:
        return f'{module} is missing: {how_to_get(module)}'
    if module != 'gtsam':
        return ''
    # Wheels of 4.2 are built for NumPy 1; with NumPy 2 they crash with a segmentation fault.
    numpy = version('numpy')
    try:
        gtsam = version('gtsam')
    except PackageNotFoundError:  # built from source, for the NumPy there is
        return ''
    if not gtsam.startswith('4.2') or numpy.startswith('1.'):
        return ''
    return (f"gtsam {gtsam} does not work with NumPy {numpy}: pip install 'numpy<2', or install "
            "all extras in one call, such as pip install './djet_ros[slam,peers]'")
