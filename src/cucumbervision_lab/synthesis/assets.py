"""Richer pictures to paint with, taken from a folder of the user's: skins, backgrounds, lights."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["SHOWS_FRUIT", "Assets", "load_assets"]

SHOWS_FRUIT = ("fruit", "rot_")

_PICTURES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
_LIGHTS = {".hdr", ".exr"}
_SKIN_PX = 512
_LEAF_PX = 512
_BACKGROUND_PX = 1600
_LIGHT_SIZE = (128, 64)


@dataclass(frozen=True, eq=False)
class Assets:
    """Pictures to paint with; all may be empty, then everything is drawn.

    Parameters
    ----------
    skins : tuple of ndarray of uint8, shape (H, W, 3)
        Close-ups of skin, RGB, the longer side at most 512 px.
    backgrounds : tuple of ndarray of uint8, shape (H, W, 3)
        What may stand far behind, RGB, the longer side at most 1600 px.
    environments : tuple of ndarray of float32, shape (64, 128, 3)
        Light from all around, linear RGB, equirectangular, the top row up.
    leaves : tuple of ndarray of uint8, shape (H, W, 3)
        Close-ups of leaves, RGB, the longer side at most 512 px.
    """

    skins: tuple[NDArray[np.uint8], ...] = ()
    backgrounds: tuple[NDArray[np.uint8], ...] = ()
    environments: tuple[NDArray[np.float32], ...] = ()
    leaves: tuple[NDArray[np.uint8], ...] = ()


def load_assets(folder: Path | None, without: Sequence[str] = SHOWS_FRUIT) -> Assets:
    """Find pictures by the names of the folders they lie in.

    Pictures below `textures` are skins, those below `backgrounds` backgrounds, those in a folder
    named `leaves` leaves as well, and `.hdr` files below a folder whose name begins with `hdri`
    environments. Each kind comes in the order of its paths.

    Parameters
    ----------
    folder : Path, optional
        Where to look; nothing is loaded without one.
    without : sequence of str
        Backgrounds and leaves whose file names hold one of these, in whatever case, are passed
        over: by default those that say they show fruit, which would stand behind a scene without
        a label.

    Returns
    -------
    Assets
        Downscaled. A file that cannot be read is left out, with one warning that names them all.

    Raises
    ------
    CaptureError
        If the folder is missing or holds none of these.

    Examples
    --------
    >>> load_assets(None)
    Assets(skins=(), backgrounds=(), environments=(), leaves=())
    """
    if folder is None:
        return Assets()
    if not folder.is_dir():
        raise CaptureError(
            "there is no such folder", source=folder, remedy="give a folder of assets, or none"
        )
    bad: list[str] = []
    assets = Assets(
        _pictures(folder, "textures/**/*", _SKIN_PX, (), bad),
        _pictures(folder, "backgrounds/**/*", _BACKGROUND_PX, without, bad),
        _environments(folder, bad),
        _pictures(folder, "**/leaves/**/*", _LEAF_PX, without, bad),
    )
    if bad:
        names = ", ".join(sorted(set(bad)))
        warnings.warn(f"{folder}: pictures left out, unreadable: {names}", stacklevel=2)
    if not (assets.skins or assets.backgrounds or assets.environments or assets.leaves):
        raise CaptureError(
            "holds no textures, backgrounds or environment maps",
            source=folder,
            remedy="put pictures below textures/, backgrounds/ or hdri/",
        )
    return assets


def _files(folder: Path, pattern: str, endings: set[str]) -> list[Path]:
    return sorted(p for p in set(folder.glob(pattern)) if p.suffix.lower() in endings)


def _pictures(
    folder: Path, pattern: str, longest_px: int, without: Sequence[str], bad: list[str]
) -> tuple[NDArray[np.uint8], ...]:
    found = []
    for path in _files(folder, pattern, _PICTURES):
        if any(word.lower() in path.name.lower() for word in without):
            continue
        picture = _read(path, cv2.IMREAD_COLOR)
        if picture is None:
            bad.append(str(path.relative_to(folder)))
            continue
        scale = min(longest_px / max(picture.shape[:2]), 1.0)
        if scale < 1:
            picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found.append(np.ascontiguousarray(picture[..., ::-1], np.uint8))
    return tuple(found)


def _environments(folder: Path, bad: list[str]) -> tuple[NDArray[np.float32], ...]:
    found = []
    for path in _files(folder, "**/hdri*/**/*", _LIGHTS):
        light = _read(path, cv2.IMREAD_UNCHANGED)
        if light is None or light.ndim != 3 or not np.isfinite(light).all():
            bad.append(str(path.relative_to(folder)))
            continue
        small = cv2.resize(
            light[..., :3].astype(np.float32), _LIGHT_SIZE, interpolation=cv2.INTER_AREA
        )
        found.append(np.ascontiguousarray(small[..., ::-1], np.float32))
    return tuple(found)


def _read(path: Path, flag: int) -> NDArray[Any] | None:
    # An empty file makes OpenCV raise, a broken one makes it give nothing.
    try:
        picture = cv2.imdecode(np.fromfile(path, np.uint8), flag)
    except (OSError, cv2.error):
        return None
    return None if picture is None or picture.size == 0 else np.asarray(picture)
