"""Installs djet_ros, with pip as well as with colcon (build type ament_python)."""

from glob import glob
from pathlib import Path

from setuptools import Extension
from setuptools import find_packages
from setuptools import setup

package_name = 'djet_ros'

setup(
    name=package_name,
    description='Monocular visual odometry by D-JET: pose optimisation in descriptor space',
    # With colcon's --symlink-install this file is a link into the sources.
    long_description=Path(__file__).resolve().with_name('README.md').read_text('utf-8'),
    long_description_content_type='text/markdown',
    classifiers=[
        'Development Status :: 4 - Beta',
        'Environment :: Console',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: C',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Topic :: Scientific/Engineering :: Image Recognition',
    ],
    maintainer='The djet_ros maintainers',
    maintainer_email='maintainers@djet-ros.invalid',
    license='Apache-2.0',
    packages=find_packages(exclude=['test']),
    package_data={package_name: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (f'share/{package_name}', ['package.xml']),
        # Files, but not __pycache__, which a launch file leaves when it is run from here.
        (f'share/{package_name}/config', glob('config/*.*')),
        (f'share/{package_name}/launch', glob('launch/*.*')),
    ],
    # Inner loops, optional: without a C compiler those in NumPy run, and a frame takes 1.5 times
    # as long. -fno-wrapv: no index overflows, and Python's own -fwrapv prevents optimisations.
    ext_modules=[Extension(
        f'{package_name}.compiled._loops', sorted(glob(f'{package_name}/compiled/*.c')),
        depends=glob(f'{package_name}/compiled/*.h'), optional=True,
        extra_compile_args=['-O3', '-ffp-contract=off', '-fno-math-errno', '-fno-trapping-math',
                            '-fno-wrapv', '-Wno-psabi'])],
    zip_safe=False,
    python_requires='>=3.11',
    # Lower bounds: the versions of Ubuntu 24.04 (ROS Jazzy), if the registry has them for Python
    # 3.12; `make lowest` tests them.
    install_requires=[
        'backports.zstd>=1.0,<2; python_version < "3.14"',
        'lz4>=4.3.2,<5',
        'matplotlib>=3.8,<4',
        'numpy>=1.26,<3',
        'opencv-python-headless>=4.6.0.66,<6',
        'PyYAML>=6.0.1,<7',
        'rich>=13.7,<16',
        'rosbags>=0.11,<0.12',
        'scipy>=1.11.2,<2',
    ],
    extras_require={
        # `make audit`
        'audit': [
            'pip-audit>=2.9,<3',
        ],
        # `djet lab evaluate --scheduler`
        'cluster': [
            'distributed>=2024.5,<2027',
        ],
        # `djet live`, `djet play`, `djet echo`
        'dds': [
            'cyclonedds>=11.0.1,<12',
        ],
        # `make fuzz`
        'fuzz': [
            'atheris>=3.0,<4',
        ],
        # methods compared with in `djet lab evaluate`
        'peers': [
            'evo>=1.38,<2',
            'poselib>=2.0.5,<3',
        ],
        # `djet slam`
        'slam': [
            'gtsam>=4.2.1,<4.3',
        ],
        'test': [
            'colcon-common-extensions>=0.3,<0.4',
            'cyclonedds>=11.0.1,<12',
            # newer than 'slam' allows: 4.3 needs a pytest that Jazzy does not have; 4.2 refuses
            # NumPy 2
            'gtsam>=4.2.1,<5',
            'hypothesis>=6.98,<7',
            'pytest>=7.4,<10',
            'pytest-xdist>=3.7,<4',
            # the oldest that builds wheels by itself, the newest that colcon accepts
            'setuptools>=70.1,<80',
        ],
        'lint': [
            # the plugins are those of ament_flake8
            'flake8>=7,<8',
            'flake8-blind-except>=0.2,<1',
            'flake8-builtins>=2.1,<4',
            'flake8-class-newline>=1.6,<2',
            'flake8-comprehensions>=3.14,<4',
            'flake8-deprecated>=2.2,<3',
            'flake8-docstrings>=1.6,<2',
            'flake8-import-order>=0.19,<1',
            'flake8-quotes>=3.3,<4',
            'mypy>=1.18,<3',
            'ruff>=0.14,<0.18',
        ],
    },
    entry_points={
        'console_scripts': [
            'djet = djet_ros.cli.main:main',
            'pose_graph_node = djet_ros.cli.nodes:pose_graph_node',
            'vo_node = djet_ros.cli.nodes:vo_node',
        ],
    },
)
