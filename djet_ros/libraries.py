"""Which libraries can be had how, for whoever finds one missing."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
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


def gtsam_problem() -> str:
    """Return why the installed GTSAM would crash with the installed NumPy, '' if it does not."""
    try:
        gtsam, numpy = version('gtsam'), version('numpy')
    except PackageNotFoundError:
        return ''
    # Wheels of 4.2 are built for NumPy 1; with NumPy 2 they crash with a segmentation fault.
    if not gtsam.startswith('4.2') or numpy.startswith('1.'):
        return ''
    return (f"gtsam {gtsam} does not work with NumPy {numpy}: pip install 'numpy<2', or install "
            "all extras in one call, such as pip install './djet_ros[slam,peers]'")
