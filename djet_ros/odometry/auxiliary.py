"""Inputs other than images, from their messages: a gyro, another odometry and masks."""

from __future__ import annotations

from collections import deque
from typing import Any

from djet_ros.config.sections import OdometryConfig
from djet_ros.core.types import Array
from djet_ros.odometry.camera import Camera
from djet_ros.odometry.frame_guess import FrameGuess
from djet_ros.odometry.guess import Guess
from djet_ros.odometry.health import Complaint, no_transform, publish_transform
from djet_ros.odometry.inertial import Gyro, GyroNoise
from djet_ros.odometry.masks import Masks
from djet_ros.odometry.messages import frame_of, mounted_frame, pose_of, stamp_ns
from djet_ros.odometry.scale import GuessScale, ScaleSource
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

# Newest images by which late inputs are judged, and the number below which they are not.
_WINDOW, _FEW = 30, 5

# Least share of unusable gyro samples that is a problem.
_REFUSED = 0.02

_CLOCKS = ('stamped by the clock of the images (use_sim_time on both sides or on none), and not '
           'later than 0.1 s after them')


class AuxiliaryInputs:
    """
    Passes messages on to the gyro, the other odometry and the masks.

    gyro, guess: None unless configured.
    """

    def __init__(self, config: OdometryConfig, scale: ScaleSource,
                 static_mask: NDArray[np.bool_] | None = None) -> None:
        self.gyro: Gyro | None = None
        self.guess: Guess | None = None
        self._masks = Masks(static_mask)
        self._frames: dict[str, str] = {}
        self._config = config
        self.configure(config, scale)
        self.reset()

    def configure(self, config: OdometryConfig, scale: ScaleSource) -> None:
        """Change the parameters; the state of inputs that stay configured is kept."""
        before, self._config = self._config, config
        noise = GyroNoise(config.imu_noise, config.imu_bias_walk)
        offset = round(config.imu_offset * 1e9)
        if not config.imu:
            self.gyro = None
        elif self.gyro is None:
            self.gyro = Gyro(noise, offset)
        else:
            self.gyro.configure(noise, offset)
        if self.gyro is not None and (quaternion := config.imu_quaternion()) is not None:
            self.gyro.mount(Rotation.from_quat(quaternion).as_matrix())
        elif self.gyro is not None and before.imu_quaternion() is not None:
            # From now on the one of tf counts.
            self.gyro.mount(None)
        fixed = self.guess.fixed if isinstance(self.guess, FrameGuess) else ''
        if not (config.guess or isinstance(scale, GuessScale)):
            self.guess = None
        elif self.guess is None or fixed != config.guess_frame:
            self.guess = FrameGuess(config.guess_frame) if config.guess_frame else Guess()
        if isinstance(scale, GuessScale) and self.guess is not None:
            scale.guess = self.guess

    def reset(self) -> None:
        """Forget all measurements; mountings and the gyro's bias are kept."""
        self._masks.reset()
        self._samples = 0
        # What each of the newest images lacked.
        self._lacking: deque[str] = deque(maxlen=_WINDOW)
        for one in (self.gyro, self.guess):
            if one is not None:
                one.reset()

    # Messages

    def imu(self, message: Any) -> None:
        """Take the rates of an Imu."""
        if self.gyro is None:
            return
        self._samples += 1
        self._frames['imu'] = frame_of(message.header)
        rate = message.angular_velocity
        self.gyro.add(stamp_ns(message.header), np.array([rate.x, rate.y, rate.z], np.float64))

    def other_odometry(self, message: Any) -> None:
        """Take the pose of an Odometry."""
        if self.guess is None or isinstance(self.guess, FrameGuess):
            return
        self._frames['guess'] = message.child_frame_id.lstrip('/')
        self.guess.add(*pose_of(message))

    def tf(self, message: Any, *, static: bool) -> None:
        """Take a TFMessage."""
        if isinstance(self.guess, FrameGuess):
            self.guess.add_message(message, static=static)

    def mask(self, message: Any) -> None:
        """Take the mask of an image."""
        self._masks.add(message)

    # Needs of an image

    def needs(self, stamp: int, image_frame: str) -> str:
        """Return the name of an input that an image still needs, or an empty string."""
        if isinstance(self.guess, FrameGuess):
            camera, axes = mounted_frame(self._config, image_frame)
            self.guess.look_for(camera)
            self.guess.mount(axes)
        if self.gyro is not None and not self.gyro.covers(stamp):
            return 'imu'
        if self.guess is not None and not self.guess.covers(stamp):
            return 'guess'
        return 'mask' if self._config.mask and not self._masks.has(stamp) else ''

    def left_out(self, stamp: int, image_frame: str, shape: tuple[int, ...], camera: Camera
                 ) -> NDArray[np.bool_] | None:
        """Return the mask of the image that is processed now; see ``Masks.of``."""
        self._lacking.append(self.needs(stamp, image_frame))
        return self._masks.of(stamp, shape, camera)

    def missing_mountings(self, image_frame: str) -> dict[str, tuple[str, str]]:
        """Return frames (parent, child) with an unknown transform, keyed by 'imu' or 'guess'."""
        camera, _ = mounted_frame(self._config, image_frame)
        wanted = {}
        if self.gyro is not None and self.gyro.to_camera is None and 'imu' in self._frames:
            wanted['imu'] = camera, self._frames['imu']
        if self.guess is not None and self.guess.mounting is None and 'guess' in self._frames:
            wanted['guess'] = self._frames['guess'], camera
        return wanted

    @property
    def wants_mountings(self) -> bool:
        """Return whether a transform is missing, possibly of frames with yet unknown names."""
        gyro = self.gyro is not None and self.gyro.to_camera is None
        # A guess on tf needs no further transform.
        guess = self.guess is not None and not isinstance(self.guess, FrameGuess) \
            and self.guess.mounting is None
        return gyro or guess

    def mount(self, what: str, mounting: Array) -> None:
        """Take a transform (4, 4) of ``missing_mountings``."""
        # The images' axes in the frame that was looked up.
        _, axes = mounted_frame(self._config, '')
        if what == 'imu' and self.gyro is not None:
            self.gyro.mount((axes.T @ mounting)[:3, :3])
        elif what == 'guess' and self.guess is not None:
            self.guess.mount(mounting @ axes)

    # Diagnostics

    def values(self) -> dict[str, str]:
        """Return the entries in diagnostics messages."""
        if self.gyro is None:
            return {}
        bias, sigma = self.gyro.bias, np.sqrt(np.diag(self.gyro.bias_covariance))
        return {'gyro samples': str(self._samples),
                **{f'gyro samples: {why}': str(n) for why, n in sorted(
                    self.gyro.refused.items())},
                'gyro bias (deg/s)': ' '.join(f'{value:.4f}' for value in np.degrees(bias)),
                'gyro bias, sigma (deg/s)': ' '.join(
                    f'{value:.4f}' for value in np.degrees(sigma))}

    def complaints(self, image_frame: str) -> list[Complaint]:
        """Return the problems."""
        return [one for one in (
            *map(self._late, ('imu', 'guess', 'mask')), *self._mountings(image_frame),
            self._samples_refused(), self._misfit()) if one is not None]

    def _late(self, what: str) -> Complaint | None:
        if len(self._lacking) < _FEW or self._lacking.count(what) * 2 < len(self._lacking):
            return None
        seen = 'no sample was received' if what == 'imu' and not self._samples else (
            f'{self._lacking.count(what)} of the newest {len(self._lacking)} images were '
            'processed without it')
        if what == 'guess' and isinstance(self.guess, FrameGuess):
            return Complaint(f'no {what} in time', 'WARN', (
                f"tf has the transform from '{self.guess.fixed}' (odometry.guess_frame) to "
                f"'{self.guess.camera}' too late or not at all; publish it, {_CLOCKS}"))
        return Complaint(f'no {what} in time', 'WARN', (
            f"the configuration requires '{what}', and {seen}; publish it, {_CLOCKS}"))

    def _mountings(self, image_frame: str) -> list[Complaint]:
        return [Complaint(f'no mounting of {what}', 'WARN', (
            f"{no_transform(parent, child)}, which '{what}' needs; "
            + publish_transform(parent, child)
            + (', or set odometry.imu_rotation' if what == 'imu' else '')))
            for what, (parent, child) in self.missing_mountings(image_frame).items()
            if len(self._lacking) >= _FEW]

    def _samples_refused(self) -> Complaint | None:
        if self.gyro is None:
            return None
        worst = self.gyro.refused.most_common(1)
        if not worst or worst[0][1] < max(_REFUSED * self._samples, _FEW):
            return None
        why, number = worst[0]
        return Complaint('gyro samples of no use', 'WARN', (
            f'{number} of {self._samples} samples: {why}; check the driver of the IMU'))

    def _misfit(self) -> Complaint | None:
        if self.gyro is None or self.gyro.trusted:
            return None
        return Complaint('gyro does not fit', 'WARN', (
            'most of its newest rotations disagree with the images, and it is not used; check '
            'that its rates are in rad/s, how the IMU is mounted (odometry.imu_rotation or tf) '
            'and odometry.imu_offset; djet lab imu-offset estimates the latter two from a '
            'recording'))
