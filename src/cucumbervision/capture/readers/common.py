"""What the readers share: the user's intrinsics, and one frame from its files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cucumbervision.capture.intrinsics import Intrinsics, check_intrinsics
from cucumbervision.errors import CaptureError

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.capture.camera_file import CameraFile
    from cucumbervision.capture.source import ReadOptions

__all__ = [
    "aligned_depth",
    "choose_intrinsics",
    "given_calibration",
    "no_intrinsics",
    "require_same_size",
]


def given_calibration(options: ReadOptions) -> CameraFile | None:
    """Read the user's intrinsics file, if one is named."""
    if options.intrinsics is None:
        return None
    from cucumbervision.capture.camera_file import read_camera_file

    return read_camera_file(options.intrinsics)


def choose_intrinsics(
    own: Intrinsics | None,
    given: CameraFile | None,
    width: int,
    height: int,
    *,
    source: object,
) -> Intrinsics:
    """Return the user's intrinsics if they pass the guard, else the source's own.

    Raises
    ------
    IntrinsicsError
        If what is to be used belongs to another stream or size, with the scale error that it
        would cause; or if there are none at all.
    """
    if given is not None:
        return check_intrinsics(given.intrinsics, width, height, known=own, source=given.path)
    if own is not None:
        return check_intrinsics(own, width, height, source=source)
    raise no_intrinsics(source)


def no_intrinsics(source: object) -> CaptureError:
    """Return the error for a source that carries no calibration when the user names none."""
    from cucumbervision.errors import IntrinsicsError

    return IntrinsicsError(
        "carries no camera intrinsics, without which pixels have no lengths",
        source=source,
        remedy="give the colour camera's as an intrinsics file",
    )


def require_same_size(color: NDArray[Any], depth: NDArray[Any], *, source: Path) -> None:
    """Refuse a depth picture of another size than its colour picture.

    Raises
    ------
    CaptureError
        Naming both sizes.
    """
    if color.shape[:2] != depth.shape[:2]:
        raise CaptureError(
            f"depth is {depth.shape[1]}x{depth.shape[0]}, colour {color.shape[1]}x{color.shape[0]}",
            source=source,
            remedy="align depth to colour, so that both have one size",
        )


def aligned_depth(
    depth_m: NDArray[np.float32],
    color: NDArray[np.uint8],
    intrinsics: Intrinsics,
    given: CameraFile | None,
    *,
    source: Path,
    depth_camera: Intrinsics | None = None,
) -> NDArray[np.float32]:
    """Bring depth into the colour picture, if the calibration says that it is not there yet.

    A calibration with both `depth` and `depth_to_color` says so; else depth must have the
    colour picture's size.

    Raises
    ------
    CaptureError
        If sizes disagree.
    """
    camera = (given.depth if given else None) or depth_camera
    if given is None or camera is None or given.depth_to_color is None:
        require_same_size(color, depth_m, source=source)
        return depth_m
    if depth_m.shape != (camera.height, camera.width):
        raise CaptureError(
            f"depth is {depth_m.shape[1]}x{depth_m.shape[0]}, the depth camera's intrinsics are "
            f"for {camera.width}x{camera.height}",
            source=source,
            remedy="give the depth camera's intrinsics at that size",
        )
    from cucumbervision.geometry.camera import align_depth_to_color

    return align_depth_to_color(
        depth_m,
        camera.matrix,
        intrinsics.matrix,
        intrinsics.size,
        given.depth_to_color.rotation,
        given.depth_to_color.translation_m,
        depth_lens=(camera.distortion, camera.coefficients),
        color_lens=(intrinsics.distortion, intrinsics.coefficients),
    )
