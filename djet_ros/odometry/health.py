"""Problems that would go unnoticed, such as unusable images and unknown lengths, and remedies."""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.self_calibration import SelfCalibration
from djet_ros.core.types import Array, Status, TRACKED
from djet_ros.odometry.images import FewLevels
from djet_ros.odometry.masks import FREE
from djet_ros.odometry.messages import camera_frame, mounted_frame, seconds_text
from djet_ros.odometry.result import OdometryResult
from djet_ros.odometry.scale import Scale, ScaleSource
import numpy as np
from numpy.typing import NDArray

# Newest images over which shares are taken, and the number below which they are zero.
_WINDOW, _FEW = 100, 20

# Least share of unusable images that is a problem.
_SHARE = 0.1

# Images or pairs in a row from which on something is a problem.
_IN_A_ROW = 5

# Share of the pixels from which on a mask is hardly meant.
_MASKED = 0.9

# Remedies for a scale source without measurements.
_REMEDIES = {
    'speed': 'publish it on {topics}, stamped by the clock of the images (use_sim_time on both '
             'sides or on none), or choose another odometry.scale',
    'camera_height': 'check odometry.camera_height and odometry.camera_pitch, or choose another '
                     'odometry.scale'}

# The same for a recording.
_REMEDIES_RECORDED = {
    **_REMEDIES,
    'speed': 'give speeds that are stamped by the clock of the images, or choose another '
             'odometry.scale'}

# Remedy for more images than can be processed.
REDUCE_LOAD = ('lower the rate (that of a bag player, too), the image size or '
               'estimator.max_features')

# Remedy for a camera matrix that changes, as with autofocus.
ONE_CAMERA_MATRIX = 'with autofocus and zoom off and one CameraInfo for all images'


class Complaint(NamedTuple):
    """A problem: its short name, its level WARN or ERROR, and a text with the remedy."""

    name: str
    level: str
    text: str


class Health:
    """Monitors the images of one camera and their results; speed_topics: for texts."""

    def __init__(self, config: OdometryConfig, speed_topics: str) -> None:
        self._config = config
        self._speed_topics = speed_topics
        self._fates: deque[str] = deque(maxlen=_WINDOW)
        # The frame_id of the newest image, and for the newest ones whether it changed.
        self._image_frame: str | None = None
        self._changes: deque[bool] = deque(maxlen=_WINDOW)
        self._equal = self._unknown_lengths = self._few_in_a_row = 0
        # Whether there was a translation, and a measured length.
        self._translated, self._measured = False, False
        # The most images in a row with one stamp, and that stamp.
        self._most_equal, self._stood_ns = 0, 0
        self._few_levels: FewLevels | None = None
        # Excluded share of the newest image, and images in a row of which nearly all is.
        self._masked, self._masked_in_a_row = 0.0, 0
        self._last: OdometryResult | None = None

    def configure(self, config: OdometryConfig) -> None:
        """Change the configuration; counts of unknown lengths were of the last one."""
        self._config, self._unknown_lengths = config, 0

    def dropped(self, reason: str, number: int = 1, image_frame: str | None = None) -> None:
        """Count images dropped for a reason; image_frame: the frame_id of one of them."""
        self._fates.extend([reason] * min(number, _WINDOW))
        if image_frame is not None:
            self._note_frame(image_frame)
        self._equal = self._equal + number if reason == 'equal_stamp' else self._equal
        if self._equal > self._most_equal and self._last is not None:
            self._most_equal, self._stood_ns = self._equal, self._last.stamp_ns

    def _note_frame(self, image_frame: str) -> None:
        self._changes.append(self._image_frame not in (None, image_frame))
        self._image_frame = image_frame

    def image(self, few_levels: FewLevels | None, left_out: NDArray[np.bool_] | None) -> None:
        """
        Note an image.

        few_levels: None unless it has few gray levels of its 16 bits; left_out: (H, W) bool, its
        excluded pixels, or None.
        """
        self._few_levels = few_levels
        self._few_in_a_row = 0 if few_levels is None else self._few_in_a_row + 1
        # Without a mask it is the distortion that leaves pixels unseen.
        masked = left_out if self._config.mask or self._config.mask_file else None
        self._masked = 0.0 if masked is None else np.count_nonzero(masked) / masked.size
        self._masked_in_a_row = self._masked_in_a_row + 1 if self._masked > _MASKED else 0

    def processed(self, result: OdometryResult) -> None:
        """Take the result of an image."""
        self._fates.append('')
        self._note_frame(result.frame_id)
        self._equal, self._last = 0, result
        self._translated = self._translated or result.status is Status.OK
        measured = result.scale_kind is Scale.METRIC and result.measured
        self._measured = self._measured or measured
        if measured or not asks_for_metres(self._config):
            self._unknown_lengths = 0
        elif result.status in TRACKED:
            self._unknown_lengths += 1

    def complaints(self, scale: ScaleSource, mounted: bool) -> list[Complaint]:
        """Return the present problems; mounted: whether base_frame is known, if it is needed."""
        return [one for one in (
            self._stamps(), self.few_levels(), self.masked(), self._frame(),
            None if mounted else self._mounting(), self._length(scale), self._load(),
            self._way(), self._order(), self.two_cameras()) if one is not None]

    def _stamps(self) -> Complaint | None:
        return None if self._last is None else _equal_stamps(self._equal, self._last.stamp_ns)

    def stamps_stood(self) -> Complaint | None:
        """Return the problem that several images once had the same stamp."""
        return _equal_stamps(self._most_equal, self._stood_ns)

    def few_levels(self) -> Complaint | None:
        """Return the problem that images of 16 bits become few gray levels."""
        if self._few_in_a_row < _IN_A_ROW or self._few_levels is None:
            return None
        levels, low, high = self._few_levels
        return Complaint('few gray levels', 'WARN', (
            f'{self._few_in_a_row} images of 16 bits in a row became {levels} gray levels with '
            f'odometry.gray_range {self._config.gray_range}; their values lie between {low} and '
            f'{high}: set odometry.gray_range to the range of the camera'))

    def masked(self, least: int = _IN_A_ROW) -> Complaint | None:
        """Return the problem that masks exclude nearly all of at least so many images in a row."""
        if self._masked_in_a_row < least:
            return None
        return Complaint('mask excludes the image', 'WARN', (
            f'the mask (odometry.mask_file or topic mask) excludes {self._masked:.0%} of the '
            f'image: pixels below {FREE} are excluded, so that one of 0 and 1 excludes all; make '
            '255 what is to be used'))

    def _frame(self) -> Complaint | None:
        if self._last is None:
            return None
        odom = self._config.odom_frame
        if self._config.base_frame == odom:
            return Complaint('base_frame is odom_frame', 'ERROR', (
                f"both are called '{odom}', and no pose goes to tf; set odometry.base_frame"))
        if not self._last.frame_id and not self._config.camera_frame:
            return Complaint('no frame_id', 'WARN', (
                'the images have no frame_id, so the poses have no child frame and none goes to '
                'tf; set it in the camera driver, or odometry.camera_frame here'))
        if _named_as_odom(self._config, self._last.frame_id):
            return Complaint('frame_id is odom_frame', 'ERROR', (
                f"the camera's frame is called '{odom}' like odometry.odom_frame, and no pose "
                'goes to tf; set odometry.camera_frame or odometry.odom_frame'))
        return None

    def _mounting(self) -> Complaint | None:
        if self._last is None:
            return None
        base, (camera, _) = self._config.base_frame, mounted_frame(
            self._config, self._last.frame_id)
        return Complaint('no mounting on tf', 'WARN', (
            f'{no_transform(base, camera)}, which the odometry needs; '
            f'{publish_transform(base, camera)}'))

    def _length(self, scale: ScaleSource) -> Complaint | None:
        return (None if self._unknown_lengths < _IN_A_ROW
                else self._no_length(scale, 'is measured', _REMEDIES))

    def never_measured(self, scale: ScaleSource) -> Complaint | None:
        """Return the problem that no length of a recording was measured, though configured."""
        return (None if self._measured or not self._translated or not asks_for_metres(self._config)
                else self._no_length(scale, 'was measured', _REMEDIES_RECORDED))

    def _no_length(self, scale: ScaleSource, what: str, remedies: dict[str, str]
                   ) -> Complaint | None:
        if self._last is None:
            return None
        remedy = remedies.get(self._config.scale, 'choose another odometry.scale')
        return Complaint('no metric length', 'WARN', (
            f'odometry.scale is {self._config.scale}, and no length {what}: '
            f'{scale.why_unknown(self._last.stamp_ns)}; '
            + remedy.format(topics=self._speed_topics)))

    def _share(self, reason: str) -> float:
        few = len(self._fates) < _FEW
        return 0.0 if few else Counter(self._fates)[reason] / len(self._fates)

    def _load(self) -> Complaint | None:
        if (share := self._share('queue_full')) < _SHARE:
            return None
        return Complaint('images dropped under load', 'WARN', (
            f'{share:.0%} of the newest {len(self._fates)} images were dropped: they arrive '
            f'faster than they are processed; {REDUCE_LOAD}'))

    def _way(self) -> Complaint | None:
        if (share := self._share('lost')) < _SHARE:
            return None
        return Complaint('images lost on the way', 'WARN', (
            f'{share:.0%} of the newest {len(self._fates)} images were sent and never received; '
            'lower their rate or compress them, and increase the depth of reliable publishers'))

    def _order(self) -> Complaint | None:
        if (share := self._share('late')) < _SHARE:
            return None
        return Complaint('images out of order', 'WARN', (
            f'{share:.0%} of the newest {len(self._fates)} images were older than one before them '
            'and dropped; do two cameras publish on one topic, or had one image a late stamp?'))

    def two_cameras(self) -> Complaint | None:
        """Return the problem that the frame_id of images alternates."""
        images, changes = len(self._changes), sum(self._changes)
        if images < _FEW or changes < _SHARE * images:
            return None
        return Complaint('images of two cameras', 'WARN', (
            f'{changes} of the newest {images} images had another frame_id than the one before '
            f"them, the newest of all '{self._image_frame}'; two cameras publish on one topic, "
            'and the poses mix both'))


def asks_for_metres(config: OdometryConfig) -> bool:
    """Return whether the scale is to be metric."""
    return config.scale not in ('none', 'structure')


def no_transform(parent: str, child: str) -> str:
    """Return a text on a transform that is missing on tf."""
    return f"tf has no transform from '{parent}' to '{child}'"


def publish_transform(parent: str, child: str) -> str:
    """Return the remedy for a static transform that is missing on tf."""
    return ('publish it by robot_state_publisher or by tf2_ros static_transform_publisher '
            f'--frame-id {parent} --child-frame-id {child}')


def frame_mismatch(info_frame: str, image_frame: str) -> Complaint | None:
    """Return the problem that CameraInfo and images have different frames, neither empty."""
    if '' in (info_frame, image_frame) or info_frame == image_frame:
        return None
    return Complaint('camera_info of another frame', 'WARN', (
        f"the CameraInfo is of frame '{info_frame}', the images are of '{image_frame}'; if it "
        'is that of another camera, remap camera_info (--info-topic); if not, the driver should '
        'give both one frame_id'))


def arm_without_metres(config: OdometryConfig, mounting: Array | None) -> Complaint | None:
    """Return the problem that lengths of no known unit cannot be added to those of a mounting."""
    metres = 0.0 if mounting is None else float(np.linalg.norm(mounting[:3, 3]))
    if not config.base_frame or asks_for_metres(config) or not metres:
        return None
    return Complaint('base_frame without metres', 'WARN', (
        f"the camera is {metres:.3f} m from '{config.base_frame}', but odometry.scale is "
        f'{config.scale}, whose lengths are not in metres: as the camera turns, the pose of '
        f"'{config.base_frame}' moves wrongly; choose a metric odometry.scale, or leave "
        'odometry.base_frame empty'))


def calibration_off(found: SelfCalibration | None) -> Complaint | None:
    """Return the problem that landmarks show a deviation of the camera from its calibration."""
    if found is None:
        return None
    return Complaint('calibration off', 'WARN', (
        f'landmarks show that the calibration is off by {deviation_text(found)}; this is '
        'corrected from now on, but was not in earlier images: calibrate anew'))


def deviation_text(found: SelfCalibration) -> str:
    """Return the deviation of a camera from its calibration, with standard deviations."""
    value, sigma = found.deviation, found.sigmas
    cx, cy = ((shift * focal, off * focal) for shift, off, focal in
              zip(value[2:], sigma[2:], found.focal))
    return (f'k1 = {value.k1:.4f} +- {sigma.k1:.4f}, focal length {100 * value.focal:.2f} +- '
            f'{100 * sigma.focal:.2f} %, principal point {cx[0]:.1f} +- {cx[1]:.1f} and '
            f'{cy[0]:.1f} +- {cy[1]:.1f} px')


def _equal_stamps(images: int, stamp_ns: int) -> Complaint | None:
    """Return the problem that many images in a row had one stamp."""
    if images < _IN_A_ROW:
        return None
    return Complaint('stamps stand still', 'ERROR', (
        f'{images} images in a row have the stamp {seconds_text(stamp_ns)} and are dropped; the '
        'camera driver has to stamp each image with the time of its exposure'))


def has_frame(config: OdometryConfig, image_frame: str) -> bool:
    """Return whether the frame of the poses has a name that can be published on tf."""
    if config.base_frame:
        return config.base_frame != config.odom_frame
    return bool(config.camera_frame or image_frame) and not _named_as_odom(config, image_frame)


def _named_as_odom(config: OdometryConfig, image_frame: str) -> bool:
    """Return whether the frame of the images or of the poses is named as the odom frame."""
    return config.odom_frame in (config.camera_frame or image_frame,
                                 camera_frame(config, image_frame))


def restart_reason(result: OdometryResult, before_ns: int | None, config: OdometryConfig) -> str:
    """Return a text on why the odometry restarted, an empty one if it did not."""
    if result.status is Status.SIZE_CHANGED:
        return ('another image size or camera matrix; it continues at the last pose, and the '
                f'motion in between is unknown; publish one size, {ONE_CAMERA_MATRIX}')
    if result.status is not Status.TIME_JUMP or before_ns is None:
        return ''
    seconds = (result.stamp_ns - before_ns) * 1e-9
    if seconds < 0:
        return (f'the stamps went back by {-seconds:.3f} s, which is more than '
                f'odometry.max_backwards ({config.max_backwards:g} s), or stayed back; the '
                f'odometry restarts, and {config.odom_frame} jumps to the origin')
    return (f'{seconds:.3f} s without an image (odometry.max_gap is {config.max_gap:g} s); it '
            'continues at the last pose, and the motion in between is unknown')
