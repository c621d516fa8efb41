"""Draw swept balls exactly: depth, which fruit, and where on it, by ray-sphere intersection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_lab.synthesis.raycast import cast_tube, ray_grid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision_lab.synthesis.bodies import Tube

__all__ = ["Rendering", "render"]


@dataclass(frozen=True, eq=False)
class Rendering:
    """What each pixel's ray meets first.

    Parameters
    ----------
    depth_m : ndarray of float64, shape (H, W)
        Exact depth along z in metres; the backdrop's where no fruit is, 0 where nothing is.
    fruit : ndarray of int32, shape (H, W)
        Index of the fruit; -1 where none is.
    share : ndarray of float32, shape (H, W)
        Where along the fruit's run of balls, 0 (blossom end) to 1 (stem end).
    normal : ndarray of float32, shape (H, W, 3)
        Outward unit normal, camera coordinates; zero where no fruit is.
    """

    depth_m: NDArray[np.float64]
    fruit: NDArray[np.int32]
    share: NDArray[np.float32]
    normal: NDArray[np.float32]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """Give the visible pixels of one fruit, shape (H, W)."""
        return np.asarray(self.fruit == index)


def render(
    tubes: Sequence[Tube], camera: Intrinsics, backdrop_m: NDArray[np.float64] | float = 0.0
) -> Rendering:
    """Draw tubes before a backdrop.

    Parameters
    ----------
    tubes : sequence of Tube
        Bodies in camera coordinates, all before the camera.
    camera : Intrinsics
        The camera that looks; its lens distortion counts.
    backdrop_m : float or ndarray of float, shape (H, W)
        Depth of what lies behind, metres; 0 for empty space.

    Returns
    -------
    Rendering
        Exact to the tubes' own ripple (below a micrometre).

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
    >>> tube = arc_tube(0.2, 0.02).moved(rotation(), (0.0, 0.0, 0.5))
    >>> seen = render([tube], Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0))
    >>> round(float(seen.depth_m[120, 160]), 6)  # 0.5 m less the radius
    0.48
    """
    height, width = camera.height, camera.width
    nearest = np.full((height, width), np.inf)
    fruit = np.full((height, width), -1, np.int32)
    ball = np.zeros((height, width), np.int32)
    for index, tube in enumerate(tubes):
        hit = cast_tube(tube, camera)
        if hit is not None:
            closer = hit.depth_m < nearest[hit.window]
            nearest[hit.window][closer] = hit.depth_m[closer]
            fruit[hit.window][closer] = index
            ball[hit.window][closer] = hit.part[closer]
    backdrop = np.broadcast_to(np.asarray(backdrop_m, dtype=float), (height, width))
    hidden = (backdrop > 0) & (backdrop < nearest)
    fruit[hidden] = -1
    depth = np.where(fruit >= 0, nearest, backdrop)
    grid = ray_grid(camera)
    share, normal = _surface(tubes, fruit, ball, depth, (grid.x, grid.y))
    return Rendering(depth, fruit, share, normal)


def _surface(
    tubes: Sequence[Tube],
    fruit: NDArray[np.int32],
    ball: NDArray[np.int32],
    depth_m: NDArray[np.float64],
    rays: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    share = np.zeros(fruit.shape, np.float32)
    normal = np.zeros((*fruit.shape, 3), np.float32)
    for index, tube in enumerate(tubes):
        seen = fruit == index
        k, z = ball[seen], depth_m[seen]
        points = np.stack([rays[0][seen] * z, rays[1][seen] * z, z], axis=1)
        share[seen] = k / (len(tube.radii_m) - 1)
        normal[seen] = (points - tube.centres_m[k]) / tube.radii_m[k, None]
    return share, normal
