"""VAROS folders, in the layout that public programs read (not the data set itself)."""

from pathlib import Path
import re

import cv2
from djet_ros.errors import DjetError
from djet_ros.recordings.datasets import open_sequence
from djet_ros.recordings.kitti import STAMP_OFFSET_NS
from djet_ros.recordings.varos import SIZE
import numpy as np
import pytest

STAMPS = [4999936, 104999936, 205000000]


@pytest.fixture
def varos(tmp_path: Path) -> Path:
    """Write three frames of a camera that looks along the world's x axis and flies along it."""
    folder = tmp_path / '2021-08-17_SEQ1'
    camera = folder / 'vehicle0' / 'cam0'
    (camera / 'A').mkdir(parents=True)
    (camera / 'camM0_poses').mkdir()
    for index in range(3):
        image = np.full((SIZE[1], SIZE[0], 3), (0, 50 * index, 0), np.uint8)
        cv2.imwrite(str(camera / 'A' / f'seq01_veh0_camM0_A-{index:08d}.png'), image)
    (camera / 'camM0_timestamps.csv').write_text('# timestamp [ns],A,B,C,D\n' + ''.join(
        f'{stamp},a.png,b.png,c.png,d.png\n' for stamp in STAMPS))
    (camera / 'camM0_poses' / 'camM0_poses_transformation_matrix.csv').write_text(
        '# timestamp [ns],r11,r12,r13,s_x_vw,r21,r22,r23,s_y_vw,r31,r32,r33,s_z_vw\n' + ''.join(
            f'{stamp},0,0,1,{0.5 * index},-1,0,0,2,0,-1,0,3\n'
            for index, stamp in enumerate(STAMPS[:2])))
    return folder


@pytest.mark.parametrize('inner', ['.', 'vehicle0', 'vehicle0/cam0'])
def test_a_varos_folder_is_recognised_by_its_contents(varos, inner):
    sequence = open_sequence(varos / inner)
    assert sequence.name.startswith('VAROS ')
    assert len(sequence) == 3
    assert sequence.size == SIZE
    # The optical axis goes through the middle of the image, with pixel centres at integers.
    assert sequence.K[:2, 2].tolist() == [639.5, 359.5]
    assert sequence.stamps_ns.tolist() == [stamp + STAMP_OFFSET_NS for stamp in STAMPS]
    assert sequence.image(1).shape == SIZE[::-1]
    assert 0 < sequence.image(1)[0, 0] < sequence.image(2)[0, 0]


def test_truth_is_that_of_the_camera_and_unknown_where_no_pose_has_the_stamp(varos):
    poses = open_sequence(varos).poses
    assert np.allclose(poses[0], np.eye(4))
    # Along the camera's own z axis.
    assert np.allclose(poses[1, :3, 3], [0, 0, 0.5])
    assert np.isnan(poses[2]).all()


def test_truth_is_found_at_stamps_of_more_digits_than_a_double_has(varos):
    since_1970 = 1_629_158_404_000_000_001
    for file in (varos / 'vehicle0' / 'cam0').rglob('*.csv'):
        file.write_text(re.sub(r'^\d+', lambda stamp: str(int(stamp[0]) + since_1970),
                               file.read_text(), flags=re.MULTILINE))
    sequence = open_sequence(varos)
    assert sequence.stamps_ns[0] == STAMPS[0] + since_1970 + STAMP_OFFSET_NS
    assert np.isfinite(sequence.poses[:2]).all()


def test_a_missing_stamp_is_named(varos):
    file = varos / 'vehicle0' / 'cam0' / 'camM0_timestamps.csv'
    file.write_text(file.read_text().rpartition('205000000')[0])
    with pytest.raises(DjetError, match='camM0_timestamps.csv has 2 lines for 3 images'):
        open_sequence(varos)


def test_images_of_another_camera_are_refused(varos):
    for image in (varos / 'vehicle0' / 'cam0' / 'A').glob('*.png'):
        cv2.imwrite(str(image), np.zeros((60, 80), np.uint8))
    with pytest.raises(DjetError, match='80x60, but the calibration of VAROS is for 1280x720'):
        open_sequence(varos)
