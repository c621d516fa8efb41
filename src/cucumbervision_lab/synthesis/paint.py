"""Colours for drawn scenes: skin with stripes and warts, a leafy backdrop, plain light."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_lab.synthesis.scene import View

__all__ = ["bench_backdrop", "leafy_backdrop", "paint"]

LIGHT = np.array([-0.35, -0.75, -0.55]) / np.linalg.norm([-0.35, -0.75, -0.55])
SKIN = np.array([[46, 92, 38], [38, 80, 34], [60, 106, 44], [52, 98, 50]], np.float64)
LEAVES = 260


def leafy_backdrop(width: int, height: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Generate leaves over one another, far ones dark, with a string or two.

    Parameters
    ----------
    width, height : int
        Size in pixels.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        RGB.

    Examples
    --------
    >>> leafy_backdrop(64, 48, np.random.default_rng(1)).shape
    (48, 64, 3)
    """
    picture = np.full((height, width, 3), (96, 104, 84), np.uint8)
    for k in range(LEAVES):
        near = k / LEAVES
        at = rng.uniform([0, 0], [width, height]).astype(int)
        size = rng.uniform(0.04, 0.10, 2) * width * (0.6 + 0.6 * near)
        green = np.array([92, 128, 70]) * (0.45 + 0.75 * near) * rng.uniform(0.85, 1.15)
        color = tuple(int(c) for c in np.clip(green + rng.normal(0, 5, 3), 0, 255))
        angle = float(rng.uniform(0, 180))
        axes = (int(size[0]), int(0.6 * size[1]))
        cv2.ellipse(picture, tuple(int(x) for x in at), axes, angle, 0, 360, color, -1, cv2.LINE_AA)
        vein = np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))]) * size[0]
        ends = [tuple(int(x) for x in at + s * vein) for s in (-0.9, 0.9)]
        pale = tuple(min(255, c + 14) for c in color)
        cv2.line(picture, ends[0], ends[1], pale, 1, cv2.LINE_AA)
    for _ in range(2):
        x = int(rng.uniform(0.1, 0.9) * width)
        cv2.line(picture, (x, 0), (x + int(rng.normal(0, 8)), height), (196, 190, 170), 2)
    return cv2.GaussianBlur(picture, (0, 0), 1.2).astype(np.uint8)


def bench_backdrop(width: int, height: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Generate boards with their grain.

    Parameters
    ----------
    width, height : int
        Size in pixels.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        RGB.

    Examples
    --------
    >>> bench_backdrop(64, 48, np.random.default_rng(1)).shape
    (48, 64, 3)
    """
    grain = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), sigmaX=24, sigmaY=1.2)
    tone = 1 + 0.9 * grain
    board = np.arange(height) * 5 // height
    tone *= rng.uniform(0.85, 1.1, 5)[board][:, None]
    tone[np.flatnonzero(np.diff(board))] *= 0.55
    wood: NDArray[np.float64] = np.array([176.0, 152.0, 122.0]) * tone[..., None]
    return np.clip(wood, 0, 255).astype(np.uint8)


def paint(scene: View, backdrop: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the scene's colours under one light from above left.

    Parameters
    ----------
    scene : View
        What each pixel sees.
    backdrop : ndarray of uint8, shape (H, W, 3)
        RGB of what lies behind.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB, without noise.
    """
    picture = backdrop.astype(np.float64)
    grain = cv2.GaussianBlur(rng.standard_normal(scene.kind.shape), (0, 0), 1.6)
    for index in range(len(scene.amodal)):
        seen = scene.mask(index)
        normal, share = scene.normal[seen].astype(np.float64), scene.share[seen]
        around = np.arctan2(normal[:, 1], -normal[:, 2])
        stripes = 1 + 0.10 * np.cos(9 * around + 2 * rng.uniform()) * (0.4 + 0.6 * share)
        pale_tip = np.clip(1 - 6 * share, 0, 1)[:, None] * np.array([26, 24, 6])
        skin = SKIN[rng.integers(len(SKIN))] * (stripes + 0.35 * grain[seen])[:, None] + pale_tip
        lit = np.clip(-normal @ -LIGHT, 0, 1)
        shine = np.clip(normal @ _halfway(), 0, 1) ** 40
        picture[seen] = skin * (0.45 + 0.95 * lit)[:, None] + 95 * shine[:, None]
    return np.clip(picture, 0, 255).astype(np.uint8)


def _halfway() -> NDArray[np.float64]:
    half = LIGHT + np.array([0.0, 0.0, -1.0])
    return np.asarray(half / np.linalg.norm(half))
