"""Trajectory metrics by evo's command-line tools."""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory
import zipfile

from djet_ros.errors import DjetError, one_line
from djet_ros.libraries import how_to_get


@dataclass(frozen=True)
class TrajectoryMetrics:
    """
    RMSE of a trajectory: APE of positions after alignment, and RPE from frame to frame.

    ape_m, rpe_m: in metres; rpe_deg: in degrees.
    """

    ape_m: float
    rpe_m: float
    rpe_deg: float


def trajectory_metrics(truth: Path, estimate: Path, metric: bool = True) -> TrajectoryMetrics:
    """
    Compare two TUM files; raise DjetError if evo is missing or fails.

    metric: whether the estimate's scale is known; otherwise it is aligned as well.
    """
    scale = () if metric else ('--align', '--correct_scale')
    return TrajectoryMetrics(
        _rmse('evo_ape', truth, estimate, *(scale or ['--align'])),
        _rmse('evo_rpe', truth, estimate, '--pose_relation', 'trans_part', *scale),
        _rmse('evo_rpe', truth, estimate, '--pose_relation', 'angle_deg', *scale))


def find_tool(name: str) -> str:
    """Return the path of a command of evo, next to this Python or on PATH; raise DjetError."""
    in_environment = Path(sys.executable).parent / name
    found = str(in_environment) if in_environment.exists() else shutil.which(name)
    if found is None:
        raise DjetError(f"the command '{name}' is not installed: {how_to_get('evo')}")
    return found


def _rmse(tool: str, truth: Path, estimate: Path, *options: str) -> float:
    with TemporaryDirectory(prefix='djet-') as folder:
        results = Path(folder) / 'results.zip'
        answer = subprocess.run(
            [find_tool(tool), 'tum', truth, estimate, *options, '--save_results', results],
            capture_output=True, text=True, check=False)
        if answer.returncode or not results.exists():
            raise DjetError(f'{tool} could not compare {estimate} with {truth}: '
                            f'{one_line(answer.stderr or answer.stdout)}')
        with zipfile.ZipFile(results) as archive:
            return float(json.loads(archive.read('stats.json'))['rmse'])
