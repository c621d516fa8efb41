"""Shared functions of the readers: choose intrinsics, and build a capture from files."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.depth import depth_to_metres, require_readings
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics, check_intrinsics
from cucumbervision.errors import CaptureError, IntrinsicsError, wrap_reader_errors
from cucumbervision.geometry.camera import align_depth_to_color

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.capture.camera_file import CameraFile, Extrinsics

_MIDDLE = 0.4  # minimum relative position of the principal point of a matrix without a size


def choose_intrinsics(
    own: Intrinsics | None,
    given: CameraFile | None,
    width: int,
    height: int,
    *,
    source: object,
) -> Intrinsics:
    """Return the given intrinsics if they pass the check, otherwise those of the source.

    Raises
    ------
    IntrinsicsError
        If the intrinsics belong to another stream or size, with the scale error that they would
        cause; or if there are none.
    """
    if given is not None:
        camera = given.intrinsics
        if not given.is_sized:
            middle = camera.cx_px / width, camera.cy_px / height
            if not all(_MIDDLE <= part <= 1 - _MIDDLE for part in middle):
                raise IntrinsicsError(
                    f"does not say its size, and {camera.cx_px:g}, {camera.cy_px:g} px is not near "
                    f"the middle of a picture of {width}x{height}",
                    source=given.path,
                    remedy="give the intrinsics of this size of picture",
                )
            camera = replace(camera, width=width, height=height)
        return check_intrinsics(camera, width, height, known=own, source=given.path)
    if own is not None:
        return check_intrinsics(own, width, height, source=source)
    raise no_intrinsics(source)


def no_intrinsics(source: object) -> CaptureError:
    """Return the error for a source without intrinsics."""
    return IntrinsicsError(
        "carries no camera intrinsics, without which pixels have no lengths",
        source=source,
        remedy="give the colour camera's as an intrinsics file",
    )


def require_same_size(color: NDArray[Any], depth: NDArray[Any], *, source: Path) -> None:
    """Raise an error if the sizes of depth and colour picture differ.

    Raises
    ------
    CaptureError
        If the sizes differ.
    """
    if color.shape[:2] != depth.shape[:2]:
        raise CaptureError(
            f"depth is {depth.shape[1]}x{depth.shape[0]}, colour {color.shape[1]}x{color.shape[0]}",
            source=source,
            remedy="align depth to colour, so that both have one size",
        )


def frame_capture(
    color: NDArray[np.uint8],
    read_raw: Callable[[], NDArray[Any]],
    own: Intrinsics | None,
    given: CameraFile | None,
    unit_m: float | None,
    *,
    source: Path,
    depth_source: Path,
    depth_camera: Intrinsics | None = None,
    **about: Any,
) -> Capture:
    """Create a capture from a colour and a depth picture.

    Depth is aligned to colour if the intrinsics file has `depth` and `depth_to_color`; otherwise
    depth must have the size of the colour picture.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    read_raw : callable
        Reads the raw depth values, shape (h, w), after the intrinsics have been checked.
    own : Intrinsics, optional
        Intrinsics of the source.
    given : CameraFile, optional
        Intrinsics given by the user.
    unit_m : float, optional
        Metres per depth step, if given by the user.
    source, depth_source : Path
        The files, for error messages.
    depth_camera : Intrinsics, optional
        Intrinsics of the depth camera, if not in the user's file.
    **about
        Further fields of `Capture`.

    Raises
    ------
    CaptureError
        If sizes differ, or depth has no valid reading.
    IntrinsicsError
        See `choose_intrinsics`.
    """
    height, width = color.shape[:2]
    intrinsics = choose_intrinsics(own, given, width, height, source=source)
    unit_m = unit_m or (given.depth_unit_m if given else None)
    depth_m = depth_to_metres(read_raw(), unit_m, source=depth_source)
    camera = (given.depth if given else None) or depth_camera
    if given is None or camera is None or given.depth_to_color is None:
        require_same_size(color, depth_m, source=depth_source)
    else:
        depth_m = _aligned(depth_m, camera, intrinsics, given.depth_to_color, source=depth_source)
    require_readings(depth_m, source=depth_source)
    return Capture(color, depth_m, intrinsics, source=str(source), **about)


def _aligned(
    depth_m: NDArray[np.float32],
    camera: Intrinsics,
    intrinsics: Intrinsics,
    moved: Extrinsics,
    *,
    source: Path,
) -> NDArray[np.float32]:
    if depth_m.shape != (camera.height, camera.width):
        raise CaptureError(
            f"depth is {depth_m.shape[1]}x{depth_m.shape[0]}, the depth camera's intrinsics are "
            f"for {camera.width}x{camera.height}",
            source=source,
            remedy="give the depth camera's intrinsics at that size",
        )
    with wrap_reader_errors(
        source, IntrinsicsError, "correct lens and 'depth_to_color' in the camera file"
    ):
        return align_depth_to_color(
            depth_m,
            camera.matrix,
            intrinsics.matrix,
            intrinsics.size,
            moved.rotation,
            moved.translation_m,
            depth_lens=(camera.distortion, camera.coefficients),
            color_lens=(intrinsics.distortion, intrinsics.coefficients),
        )
