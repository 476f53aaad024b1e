"""Building blocks of plots of Hamming surfaces: patches, heat maps, paraboloids."""

from __future__ import annotations

from typing import Any

from djet_ros.core.paraboloid import indefinite, Paraboloids
from djet_ros.core.types import Array
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
import numpy as np
from numpy.typing import NDArray

# Warm colours are small distances, as in the paper. The scale ends at 128 of 256 bits, the
# expectation for unrelated points.
_COLOURS = 'inferno_r'
_BITS = Normalize(0, 128)
_MARK: dict[str, Any] = {'ls': 'none', 'markeredgecolor': 'black', 'zorder': 5}


def draw_patch(axes: Axes, gray: NDArray[np.uint8], centre: NDArray[np.int64],
               radius: int) -> None:
    """Draw the image (H, W) around a pixel, with stretched contrast, in image coordinates."""
    x, y = centre.tolist()
    patch = gray[y - radius:y + radius + 1, x - radius:x + radius + 1]
    axes.imshow(patch, cmap='gray', extent=_extent(centre, radius))
    axes.grid(False)
    axes.set_xticks([])
    axes.set_yticks([])


def draw_heat(axes: Axes, surface: NDArray[np.uint16], centre: NDArray[np.int64],
              opacity: float) -> None:
    """Overlay a Hamming surface (P, P) in bits, sampled around a pixel."""
    axes.imshow(surface, cmap=_COLOURS, norm=_BITS, alpha=opacity,
                extent=_extent(centre, len(surface) // 2))


def draw_paraboloid(axes: Axes, fits: Paraboloids, index: int, window: int) -> None:
    """Draw the contours of a paraboloid in its window, and its minimum if it has one."""
    radius, centre = window / 2, fits.centres[index]
    axes.add_patch(Rectangle((centre[0] - radius, centre[1] - radius), window, window,
                             fill=False, edgecolor='white', lw=1.2, ls=(0, (3, 2))))
    steps = np.linspace(-radius, radius, 41)
    grid = centre + np.stack(np.meshgrid(steps, steps), axis=-1)
    values = paraboloid_values(fits, index, grid.reshape(-1, 2)).reshape(41, 41)
    axes.contour(grid[..., 0], grid[..., 1], values, levels=4, colors='white', linewidths=0.9)
    if not indefinite(fits)[index]:
        x, y = fits.minima()[index]
        if max(abs(x - centre[0]), abs(y - centre[1])) <= radius:
            axes.plot(x, y, marker='P', ms=8, color='#56B4E9', **_MARK)


def draw_point(axes: Axes, place: Array, marker: str, colour: str, size: float = 8) -> None:
    """Mark a point (2,) in pixels."""
    axes.plot(place[0], place[1], marker=marker, ms=size, color=colour, **_MARK)


def paraboloid_values(fits: Paraboloids, index: int, places: Array) -> Array:
    """Return the values (M,) of one paraboloid at points (M, 2)."""
    times = np.full(len(places), index)
    one = Paraboloids(fits.centres[times], fits.A[times], fits.b[times], fits.c[times],
                      fits.usable[times])
    return one.values(places)


def limit(axes: Axes, centre: Array, radius: float) -> None:
    """Limit the axes to the square around a point, y downwards."""
    axes.set_xlim(centre[0] - radius - 0.5, centre[0] + radius + 0.5)
    axes.set_ylim(centre[1] + radius + 0.5, centre[1] - radius - 0.5)


def add_scale(drawing: Figure, panels: Any) -> None:
    """Add the colour bar of the heat maps."""
    drawing.colorbar(ScalarMappable(_BITS, _COLOURS), ax=panels, extend='max', shrink=0.8,
                     label='Hamming distance, bits')


def _extent(centre: NDArray[np.int64], radius: int) -> tuple[float, float, float, float]:
    x, y = centre.tolist()
    return x - radius - 0.5, x + radius + 0.5, y + radius + 0.5, y - radius - 0.5
