"""A small world of textured cards at several depths: exact views of it, made in milliseconds."""

from collections.abc import Sequence
import os
from pathlib import Path

import cv2
from djet_ros.odometry.frame import Frame
import numpy as np

SIZE = (320, 240)
K = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])
DEPTHS = (12.0, 7.0, 4.0)
REST = np.eye(4)


class Cards:
    """Cards that face the initial camera, each with holes that show the next one."""

    def __init__(self, seed: int = 5) -> None:
        rng = np.random.default_rng(seed)
        side = 900
        self._cards = []
        for layer, depth in enumerate(DEPTHS):
            coarse = rng.uniform(0, 255, (side // 9, side // 9)).astype(np.float32)
            texture = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
            texture += cv2.GaussianBlur(rng.normal(0, 90, (side, side)).astype(np.float32),
                                        (0, 0), 1.2)
            holes = rng.uniform(0, 1, (6, 6)).astype(np.float32) < (0.0, 0.55, 0.75)[layer]
            mask = cv2.resize(1 - holes.astype(np.float32), (side, side),
                              interpolation=cv2.INTER_NEAREST)
            self._cards.append((depth, np.clip(texture, 0, 255), mask))
        self._centre = np.array([[1, 0, (SIZE[0] - side) / 2], [0, 1, (SIZE[1] - side) / 2],
                                 [0, 0, 1]])

    def gray(self, pose: np.ndarray = REST, noise: int | None = None) -> np.ndarray:
        """Render the cards from a pose (4, 4), camera in the world; noise: a seed."""
        R, t = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        image = np.zeros(SIZE[::-1], np.float32)
        for depth, texture, mask in self._cards:
            H = K @ (R + np.outer(t, [0, 0, 1 / depth])) @ np.linalg.inv(K) @ self._centre
            seen, alpha = (cv2.warpPerspective(layer, H, SIZE) for layer in (texture, mask))
            image = image * (1 - alpha) + seen * alpha
        if noise is not None:
            image += np.random.default_rng(noise).normal(0, 2, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def frame(self, seconds: float, pose: np.ndarray = REST, **more) -> Frame:
        """Render the cards as a frame."""
        return Frame(self.gray(pose, **more), K, round(seconds * 1e9), 'camera')


def filmed(folder: Path, poses: Sequence[np.ndarray], frames: int = 0, noise: bool = False
           ) -> Path:
    """
    Write the cards from some poses as a KITTI sequence with its ground truth; return its folder.

    If more frames are wanted, the camera goes to and fro, and their images are links.
    """
    images, cards = folder / 'image_0', Cards()
    truth = folder.parents[1] / 'poses' / f'{folder.name}.txt'
    images.mkdir(parents=True)
    truth.parent.mkdir(exist_ok=True)
    for i, here in enumerate(poses):
        cv2.imwrite(str(images / f'{i:06d}.png'), cards.gray(here, i if noise else None))
    last = len(poses) - 1
    places = [last - abs(last - i % (2 * last)) for i in range(max(frames, len(poses)))]
    for i, place in enumerate(places[len(poses):], len(poses)):
        os.link(images / f'{place:06d}.png', images / f'{i:06d}.png')
    row = ' '.join(str(v) for v in np.hstack([K, np.zeros((3, 1))]).ravel())
    (folder / 'calib.txt').write_text(f'P0: {row}\n')
    (folder / 'times.txt').write_text(''.join(f'{0.1 * i:.6e}\n' for i in range(len(places))))
    np.savetxt(truth, [poses[place][:3].ravel() for place in places])
    return folder


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Camera in the world: metres, and radians about the camera's y axis."""
    result = np.eye(4)
    result[:3, :3] = cv2.Rodrigues(np.array([0.0, yaw, 0.0]))[0]
    result[:3, 3] = x, y, z
    return result
