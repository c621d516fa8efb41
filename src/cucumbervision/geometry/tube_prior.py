"""Priors of a fruit's shape and of the measurement errors."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.pixels import median_of
from cucumbervision.geometry.tube import BEND_SEGMENTS, TubeShape, bases
from cucumbervision.geometry.tube_evidence import BODY, SLIPS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.geometry.tube_evidence import Evidence

# In shares of the length L and the radius r.
_TWIST_SD = 1.0  # the curvature's change k' over the length: k' L^2
_BEND_SD, _BEND_CHANGE_SD = 8.0, 100.0  # curvature k, 1/m, and its change along the fruit, 1/m^2
_TILT_SD = 0.6  # the far end beyond the near one, along the view
_SPEED_SD = 0.02  # a control point's distance to the next, from one to the next
_WIDTH_SD = 0.05  # the radius' second difference; with heavy tails, so that shoulders may stand
_WIDTH_TAIL = 1.0
# How far, in radii, an end may be from where it was guessed: one that the outline shows (where
# this must not matter), and one that a leaf or the picture's edge hides.
_ANCHOR_SD, _HIDDEN_ANCHOR_SD = 1.5, 0.15
# Colour and depth are registered to about a pixel; masks are drawn too wide or too narrow. More
# room for the latter would win on masks 3 px too wide, but a real sensor's depth does not know a
# body's roundness well enough: the length of rigid bodies then varies between captures.
_SLIP_SD_PX = (1.0, 1.0, 0.1)


def end_hold(visible: tuple[bool, bool]) -> NDArray[np.float64]:
    """Return how far each end may be from where it was guessed, radii, shape (2,)."""
    return np.where(visible, _ANCHOR_SD, _HIDDEN_ANCHOR_SD)


def add_shape_prior(
    normal: NDArray[np.float64],
    target: NDArray[np.float64],
    shape: TubeShape,
    anchors_m: NDArray[np.float64],
    anchors_sd: NDArray[np.float64],
) -> None:
    """Add to normal equations, in place, how a fruit bends, tilts and grows thick.

    Its bending changes slowly along it and is not strong, its control points keep their
    distances, it rather lies across the view than along it, and its radius changes smoothly.

    Parameters
    ----------
    normal : ndarray of float64, shape (K, K)
        1/m²; the first `SHAPE` unknowns are changed.
    target : ndarray of float64, shape (K,)
        1/m.
    shape : TubeShape
        The present body, camera coordinates.
    anchors_m : ndarray of float64, shape (2, 3)
        Where the ends were guessed.
    anchors_sd : ndarray of float64, shape (2,)
        How far from there they may be, radii (`end_hold`).
    """
    bend, width = shape.bend_m, shape.width_m
    count, split = len(bend), bend.size
    steps = bend[1:] - bend[:-1]
    step = float(np.sqrt(np.einsum("ij,ij->i", steps, steps)).mean())
    radius = max(median_of(width), 0.002)
    second, smooth, twist = _differences(count)
    twist_sd = min(_TWIST_SD * step / BEND_SEGMENTS**2, _BEND_CHANGE_SD * step**3)
    ends = bases(2)[0]
    hold = ends / (anchors_sd * radius)[:, None]
    # For each coordinate alike.
    same = twist / twist_sd**2 + smooth / (_BEND_SD * step**2) ** 2 + hold.T @ hold
    # Control points keep their distances: nothing else tells where along the curve they sit.
    tangent = bend[2:] - bend[:-2]
    tangent /= np.maximum(np.sqrt(np.einsum("ij,ij->i", tangent, tangent)), 1e-9)[:, None]
    even = np.empty((count - 1, split))
    by_axis = even.reshape(count - 1, count, 3)
    np.multiply(second[:, :, None], tangent[:, None, :] / (_SPEED_SD * step), out=by_axis[:-1])
    # Where depth hardly tells, a fruit rather lies across the view than along it.
    middle = bend.mean(axis=0)
    middle /= np.sqrt(middle @ middle) * _TILT_SD * step * BEND_SEGMENTS
    np.multiply((ends[1] - ends[0])[:, None], middle, out=by_axis[-1])
    normal[:split, :split] += even.T @ even
    for axis in range(3):
        normal[axis:split:3, axis:split:3] += same
    pull = same @ bend - hold.T @ (anchors_m / (anchors_sd * radius)[:, None])
    target[:split] -= pull.ravel() + even.T @ (even @ bend.ravel())
    rough = _differences(len(width))[0] / (_WIDTH_SD * radius)
    rough = rough / np.sqrt(1 + (rough @ width / _WIDTH_TAIL) ** 2)[:, None]
    widths = slice(split, split + len(width))
    normal[widths, widths] += rough.T @ rough
    target[widths] -= rough.T @ (rough @ width)


@lru_cache(maxsize=4)
def _differences(
    count: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    # The second differences' matrix; its square, and the third differences'.
    second, third = (np.diff(np.eye(count), order, axis=0) for order in (2, 3))
    return second, second.T @ second, third.T @ third


def add_nuisance_prior(
    normal: NDArray[np.float64],
    target: NDArray[np.float64],
    nuisance: NDArray[np.float64],
    evidence: Evidence,
) -> None:
    """Add to normal equations, in place, how far the outline may slip and how strong waves are.

    Parameters
    ----------
    normal : ndarray of float64, shape (BODY + W, BODY + W)
        1/m² for the slips, 1 for the waves.
    target : ndarray of float64, shape (BODY + W,)
        1/m, and 1.
    nuisance : ndarray of float64, shape (SLIPS + W,)
        The present slips, metres, and waves.
    evidence : Evidence
        What was seen: a pixel's size at its distance.
    """
    slips = 1 / (np.array(_SLIP_SD_PX) * evidence.pixel_rad * evidence.far_m) ** 2
    weight = np.concatenate([slips, np.ones(evidence.waves)])
    last = np.arange(BODY - SLIPS, len(target))
    normal[last, last] += weight
    target[last] -= weight * nuisance
