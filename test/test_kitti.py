"""KITTI folders: what is read from them, and what is said of a folder that is wrong."""

from fractions import Fraction
from pathlib import Path

import cv2
from djet_ros.errors import DjetError
from djet_ros.recordings.kitti import KittiSequence, read_poses, STAMP_OFFSET_NS
from djet_ros.recordings.text import nanoseconds
from hypothesis import given, strategies as st
import numpy as np
import pytest


def test_a_sequence_gives_images_camera_stamps_and_poses(small_kitti):
    folder = small_kitti(frames=6, size=(64, 48))
    sequence = KittiSequence(folder)
    assert len(sequence) == 6
    assert sequence.size == (64, 48)
    assert sequence.K.tolist() == [[60.5, 0, 32], [0, 60.5, 24], [0, 0, 1]]
    assert (sequence.stamps_ns - STAMP_OFFSET_NS).tolist() == [
        0, 103622300, 207244600, 310866900, 414489200, 518111500]
    assert sequence.poses[3][:3, 3].tolist() == [0, 0, 1.5]
    expected = cv2.imread(str(folder / 'image_0' / '000004.png'), cv2.IMREAD_GRAYSCALE)
    assert (sequence.raw(4) == expected).all()


def test_real_frames_are_read(kitti):
    folder = kitti / 'sequences' / '03'
    sequence = KittiSequence(folder)
    count = len(list((folder / 'image_0').iterdir()))
    assert count == len((folder / 'times.txt').read_text().split()) > 1
    assert len(sequence) == len(sequence.stamps_ns) == count
    assert sequence.poses.shape == (count, 4, 4)
    assert sequence.size == (1242, 375)
    assert sequence.image(count - 1).shape == (375, 1242)
    assert sequence.K[0, 0] == 721.5377


def test_residual_distortion_of_rectified_images_is_undone(small_kitti):
    folder = small_kitti(size=(64, 48))
    rectified = KittiSequence(folder)
    with (folder / 'calib.txt').open('a') as calibration:
        calibration.write('D: 0.2 0 0 0 0\n')
    sequence = KittiSequence(folder)
    assert sequence.distortion.tolist() == [0.2, 0, 0, 0, 0]
    assert (sequence.raw(2) == rectified.image(2)).all()
    undone = cv2.undistort(rectified.image(2), sequence.K, sequence.distortion)
    assert (sequence.image(2) == undone)[4:-4, 4:-4].all()
    assert (sequence.image(2) != rectified.image(2)).any()


def test_a_range_of_frames_starts_its_own_poses(small_kitti):
    folder = small_kitti(frames=6)
    whole, part = KittiSequence(folder), KittiSequence(folder, start=2, end=5)
    assert len(part) == 3
    assert part.frame_paths == whole.frame_paths[2:5]
    assert (part.stamps_ns == whole.stamps_ns[2:5]).all()
    assert np.allclose(part.poses[0], np.eye(4))
    assert np.allclose(whole.poses[2] @ part.poses[2], whole.poses[4])


def test_poses_are_found_next_to_the_sequence_or_given_or_absent(small_kitti, tmp_path):
    folder = small_kitti()
    beside = folder.parent.parent / 'poses' / '07.txt'
    given = beside.rename(tmp_path / 'truth.txt')
    assert KittiSequence(folder).poses is None
    assert KittiSequence(folder, poses=given).poses.shape == (6, 4, 4)


def test_the_folder_may_be_named_from_within(small_kitti, monkeypatch):
    monkeypatch.chdir(small_kitti())
    assert KittiSequence(Path('.')).poses is not None


@given(st.decimals(min_value=0, max_value=10**9, places=12))
def test_stamps_are_rounded_exactly_to_nanoseconds(seconds):
    assert nanoseconds(str(seconds)) == round(Fraction(seconds) * 10**9)


def cut_last_line(path):
    path.write_text(''.join(path.read_text().splitlines(keepends=True)[:-1]))


def replace(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


DAMAGES = {
    'times.txt has 5 lines for 6 images': lambda f: cut_last_line(f / 'times.txt'),
    '07.txt has 5 lines for 6 images': lambda f: cut_last_line(f / '../../poses/07.txt'),
    "times.txt line 2: 'abc' is not a": lambda f: replace(f / 'times.txt', '1.036223e-01', 'abc'),
    "'nan' is not a stamp": lambda f: replace(f / 'times.txt', '1.036223e-01', 'nan'),
    "'-1' is not a stamp": lambda f: replace(f / 'times.txt', '0.000000e+00', '-1'),
    "'1e300' is not a stamp": lambda f: replace(f / 'times.txt', '1.036223e-01', '1e300'),
    'is not after the one before': lambda f: replace(f / 'times.txt', '1.036223e-01', '0'),
    '07.txt line 1 has 11 numbers; it must have 12':
        lambda f: replace(f / '../../poses/07.txt', ' 0 ', ' '),
    'pose 0 is no rigid transformation': lambda f: replace(f / '../../poses/07.txt', '1', '2'),
    'pose 1 is no rigid transformation (':
        lambda f: replace(f / '../../poses/07.txt', '9.998000066666e-01', '1e300'),
    'pose 0 is at [0.0, 0.0, 1e+300] m, farther than':
        lambda f: replace(f / '../../poses/07.txt', ' 0.000000000000e+00\n', ' 1e300\n'),
    "no line 'P0:'": lambda f: replace(f / 'calib.txt', 'P0:', 'P5:'),
    'P0 has 13 numbers': lambda f: replace(f / 'calib.txt', 'P0:', 'P0: 1'),
    "calib.txt line 1: P0: '60.5x' is not a": lambda f: replace(f / 'calib.txt', '60.5', '60.5x'),
    'P0 is no projection': lambda f: replace(f / 'calib.txt', '60.5', '0'),
    'calib.txt does not exist': lambda f: (f / 'calib.txt').unlink(),
    'times.txt does not exist': lambda f: (f / 'times.txt').unlink(),
    'times.txt is not a text file': lambda f: (f / 'times.txt').write_bytes(b'\xff\xfe\x00'),
    '000003.png is neither a PNG nor a JPEG image':
        lambda f: (f / 'image_0/000003.png').write_text('hello'),
    '000002.png is 8x4, the images before it are 64x48':
        lambda f: cv2.imwrite(str(f / 'image_0/000002.png'), np.zeros((4, 8), np.uint8)),
    'has no images image_0': lambda f: [path.unlink() for path in (f / 'image_0').iterdir()],
}


@pytest.mark.parametrize('message', DAMAGES)
def test_a_wrong_folder_is_named_in_one_line(small_kitti, message):
    folder = small_kitti(frames=6)
    DAMAGES[message](folder)
    with pytest.raises(DjetError) as caught:
        KittiSequence(folder)
    assert message in str(caught.value)
    assert '\n' not in str(caught.value)


def test_the_dataset_folder_lists_its_sequences(small_kitti):
    folder = small_kitti()
    with pytest.raises(DjetError, match='it holds sequences/07: name one of these'):
        KittiSequence(folder.parent.parent)
    with pytest.raises(DjetError, match='it holds 07: name one of these'):
        KittiSequence(folder.parent)


@pytest.mark.parametrize(('start', 'end'), [(-1, 3), (3, 3), (4, 2), (0, 7), (9, None)])
def test_a_range_outside_the_sequence_is_refused(small_kitti, start, end):
    with pytest.raises(DjetError, match=f'--start {start} --end .* is outside of the 6 frames'):
        KittiSequence(small_kitti(frames=6), start=start, end=end)


def test_a_missing_folder_or_poses_file_is_refused(small_kitti, tmp_path):
    with pytest.raises(DjetError, match='nowhere does not exist'):
        KittiSequence(tmp_path / 'nowhere')
    with pytest.raises(DjetError, match=r'absent.txt does not exist'):
        KittiSequence(small_kitti(), poses=tmp_path / 'absent.txt')


def test_a_png_that_declares_a_huge_size_is_not_decoded(small_kitti):
    folder = small_kitti(frames=1)
    path = folder / 'image_0' / '000000.png'
    data = bytearray(path.read_bytes())
    data[16:24] = (2**31 - 1).to_bytes(4, 'big') * 2
    path.write_bytes(data)
    with pytest.raises(DjetError, match='declares 2147483647x2147483647 pixels'):
        KittiSequence(folder)


def test_a_file_of_no_poses_has_no_poses(tmp_path):
    (tmp_path / 'empty.txt').write_text('\n# nothing\n')
    assert read_poses(tmp_path / 'empty.txt').shape == (0, 4, 4)
