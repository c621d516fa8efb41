"""Shared functions of the readers: find and choose intrinsics, build a capture from files."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from cucumbervision.arrays import Array32, Numbers, Pixels
from cucumbervision.capture import pictures
from cucumbervision.capture.camera_file import CameraFile, read_camera_file
from cucumbervision.capture.frames import Capture, Doubt, depth_along_axis
from cucumbervision.capture.intrinsics import (
    DepthAlong,
    Intrinsics,
    Stream,
    align_depth_to_color,
    check_intrinsics,
)
from cucumbervision.capture.source import Folder, ReadOptions
from cucumbervision.errors import CaptureError, IntrinsicsError, wrap_reader_errors

_OWN_NAME = "intrinsics.json"
_CAMERA_NAME = re.compile(
    r"(.*(intrinsic|camera|cam_?k|calib).*|k)\.(json|ya?ml|xml|txt)"
    r"|(.*(intrinsics?|cam_?k|camera_?matrix)|k)\.npy",
    re.IGNORECASE,
)
_CAMERA_WORD = re.compile(
    r"intrinsics?|camera|cam|k|camk|calib(ration)?|info|colou?r|rgb|depth|aligned|to|matrix|params?"
)
_PICTURES = tuple(pictures.COLOR_SUFFIXES)
_Words = tuple[str, ...]
_RECTIFIED, _RAW = (
    re.compile(rf"(?<![a-z]){word}(?![a-z])", re.IGNORECASE) for word in ("rect(ified)?", "raw")
)
_SAME_FOCAL = 0.005
_SAME_VIEW = 0.01  # most by which the factors of width and height differ
_OFF_MIDDLE = 0.1  # of the size: maximum for the principal point of a matrix without a size


def choose_intrinsics(
    frame_intrinsics: Intrinsics | None,
    camera_file: CameraFile | None,
    width: int,
    height: int,
    *,
    aligned_to: Stream | None = None,
    source: object,
) -> Intrinsics:
    """Return the given intrinsics if they pass the check, otherwise those of the source.

    If colour is aligned to depth, these are the intrinsics of the depth camera, whose pixels both
    images have.

    Raises
    ------
    IntrinsicsError
        If the intrinsics belong to another stream or size, with the scale error that they would
        cause; or if there are none.
    """
    if aligned_to is Stream.DEPTH:
        frame_intrinsics = frame_intrinsics and replace(frame_intrinsics, stream=Stream.COLOR)
    if camera_file is not None:
        camera = camera_file.intrinsics
        if aligned_to is Stream.DEPTH:
            depth = camera_file.depth
            camera = replace(depth.intrinsics if depth else camera, stream=Stream.COLOR)
        if camera_file.rectified is not None:
            camera = _of_raw_or_rectified(camera_file, camera_file.rectified, source)
        if not camera_file.is_sized:
            off = abs(camera.cx_px / width - 0.5), abs(camera.cy_px / height - 0.5)
            if max(off) > _OFF_MIDDLE:
                raise IntrinsicsError(
                    "does not say its size, and {cx:g}, {cy:g} px is not near the middle of a "
                    "picture of {size}",
                    source=camera_file.path,
                    remedy="give the intrinsics of this size of picture",
                    **{"cx": camera.cx_px, "cy": camera.cy_px, "size": f"{width}x{height}"},
                )
            camera = replace(camera, width=width, height=height)
        return check_intrinsics(
            camera, width, height, color=frame_intrinsics, source=camera_file.path
        )
    if frame_intrinsics is not None:
        return check_intrinsics(frame_intrinsics, width, height, source=source)
    raise no_intrinsics(source)


def _of_raw_or_rectified(
    camera_file: CameraFile, rectified: Intrinsics, source: object
) -> Intrinsics:
    """Return the intrinsics of the images, which are rectified or raw by their names."""
    raw = camera_file.intrinsics
    name = f"{source} {camera_file.path.name}"
    if _RECTIFIED.search(name):
        return rectified
    if abs(rectified.fx_px / raw.fx_px - 1) > _SAME_FOCAL and not _RAW.search(name):
        raise IntrinsicsError(
            f"P has fx {rectified.fx_px:g} px for rectified pictures, K {raw.fx_px:g} px for raw "
            "ones, and no name tells which these are",
            source=camera_file.path,
            remedy="put 'rect' or 'raw' into the name of the pictures or of this file",
        )
    return raw


def no_intrinsics(source: object) -> CaptureError:
    """Return the error for a source without intrinsics."""
    return IntrinsicsError(
        "carries no camera intrinsics, without which pixels have no lengths",
        source=source,
        remedy="give the colour camera's with --intrinsics FILE",
    )


def require_same_size(color: Numbers, depth: Numbers, *, source: Path) -> None:
    """Raise an error if the sizes of depth and colour image differ.

    Raises
    ------
    CaptureError
        If the sizes differ.
    """
    if color.shape[:2] != depth.shape[:2]:
        raise CaptureError(
            "depth is {depth}, colour {color}",
            source=source,
            remedy="align depth to colour, so that both have one size; or, if depth has "
            "the colour camera's field of view in fewer pixels, say so with "
            "--aligned-to color",
            depth=f"{depth.shape[1]}x{depth.shape[0]}",
            color=f"{color.shape[1]}x{color.shape[0]}",
        )


def frame_capture(
    color: Pixels,
    read_raw: Callable[[], Numbers],
    frame_intrinsics: Intrinsics | None,
    camera_file: CameraFile | None,
    options: ReadOptions,
    *,
    source: Path,
    depth_source: Path,
    depth_camera: Intrinsics | None = None,
    **capture_fields: Any,
) -> Capture:
    """Create a capture from a colour and a depth image.

    Depth is aligned to colour if the intrinsics file has `depth` and `depth_to_color`, unless the
    images are declared as aligned. Otherwise depth must have the size of the colour image, or,
    if it is declared as aligned to colour, the same aspect ratio.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    read_raw : callable
        Reads the raw depth values, shape (h, w), after the intrinsics have been checked.
    frame_intrinsics : Intrinsics, optional
        Intrinsics of the source.
    camera_file : CameraFile, optional
        Intrinsics given by the user.
    options : ReadOptions
        The user's options for depth, with the unit of the format.
    source, depth_source : Path
        The files, for error messages.
    depth_camera : Intrinsics, optional
        Intrinsics of the depth camera, if not in the user's file.
    **capture_fields
        Further fields of `Capture`.

    Raises
    ------
    CaptureError
        If sizes differ, or depth has no valid reading.
    IntrinsicsError
        See `choose_intrinsics`.
    """
    height, width = color.shape[:2]
    options = options.with_camera(camera_file)
    aligned_to, along = options.aligned_to, options.depth_along
    intrinsics = choose_intrinsics(
        frame_intrinsics, camera_file, width, height, aligned_to=aligned_to, source=source
    )
    depth_m = pictures.depth_to_metres(read_raw(), options.depth_unit_m, source=depth_source)
    depth_model = camera_file.depth if camera_file else None
    camera = depth_model.intrinsics if depth_model else depth_camera
    doubts: tuple[Doubt, ...] = ()
    moved = camera_file.depth_to_color if camera_file and aligned_to is None else None
    if camera and moved:
        if depth_m.shape != camera.size[::-1]:
            fault = f"depth is {depth_m.shape[1]}x{depth_m.shape[0]}, the depth camera's intrinsics"
            fault = f"{fault} are for {camera.width}x{camera.height}"
            remedy = "give the depth camera's intrinsics at that size"
            raise CaptureError(fault, source=depth_source, remedy=remedy)
        depth_m = depth_along_axis(depth_m, camera) if along is DepthAlong.RAY else depth_m
        remedy = "correct lens and 'depth_to_color' in the camera file"
        with wrap_reader_errors(depth_source, IntrinsicsError, remedy):
            depth_m = align_depth_to_color(
                depth_m, camera, intrinsics, moved.rotation, moved.translation_m
            )
    else:
        if aligned_to is Stream.COLOR and _is_same_view(depth_m, width, height):
            depth_m, doubts = (
                pictures.enlarge_depth(depth_m, width, height),
                (Doubt.DEPTH_RESAMPLED,),
            )
        require_same_size(color, depth_m, source=depth_source)
        depth_m = depth_along_axis(depth_m, intrinsics) if along is DepthAlong.RAY else depth_m
    pictures.require_readings(depth_m, source=depth_source)
    return Capture(color, depth_m, intrinsics, source=str(source), doubts=doubts, **capture_fields)


def _is_same_view(depth_m: Array32, width: int, height: int) -> bool:
    """Return whether depth has fewer pixels than colour, in the same proportion both ways."""
    across, down = width / depth_m.shape[1], height / depth_m.shape[0]
    return bool(across > 1 and abs(across / down - 1) <= _SAME_VIEW)


class CameraFinder:
    """Finds the intrinsics file of an image, in its folder or the nearest parent folder.

    A file whose name refers to certain images (`cam1_intrinsics.json` beside `cam1_color_1.png`
    and `cam2_color_1.png`) belongs only to these. Of several other files, the native name has
    priority; the others must contain the same camera.

    Parameters
    ----------
    folder : Folder
        The available files.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cucumbervision.capture.source import Folder
    >>> walk = Folder(Path("walk"), {"": ["camera.json"], "rgb": ["1.png"]})
    >>> CameraFinder(walk).find("rgb")
    PosixPath('walk/camera.json')
    """

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._names, self._only = cache(self._begins_and_owners), cache(_only)

    def find(self, folder_path: str, picture: str = "") -> Path | None:
        """Return the file of an image, or of a subfolder; None without one.

        Raises
        ------
        IntrinsicsError
            If several files could belong to the image and differ.
        """
        words, others = _stem_words(picture), self._names(folder_path)[0]
        while True:
            owners = self._names(folder_path)[1]
            length = next((k for k in range(len(words), 0, -1) if words[:k] in owners), 0)
            shared = (name for owner in owners if owner not in others for name in owners[owner])
            names = tuple(sorted(owners[words[:length]] if length else shared))
            if names or not folder_path:
                file = self._only(self._folder.path / folder_path, names)
                if isinstance(file, IntrinsicsError):
                    raise file
                return file
            folder_path = folder_path.rpartition("/")[0]

    def _begins_and_owners(self, folder_path: str) -> tuple[set[_Words], dict[_Words, list[str]]]:
        """Return the words with which a folder's images begin, and its intrinsics files by image.

        A file belongs to the images that begin with its words, apart from those of a camera.
        """
        begins: set[_Words] = set()
        owners: dict[_Words, list[str]] = {}
        for name in self._folder.files.get(folder_path, ()):
            words = _stem_words(name)
            if name.lower().endswith(_PICTURES):
                begins |= {words[:k] for k in range(1, len(words) + 1)}
            if _CAMERA_NAME.fullmatch(name):
                owner = tuple(word for word in words if not _CAMERA_WORD.fullmatch(word))
                owners.setdefault(owner, []).append(name)
        return begins, owners


def _only(folder: Path, names: tuple[str, ...]) -> Path | IntrinsicsError | None:
    """Return the only file with a camera among these, or why none is; None without a file."""
    if _OWN_NAME in names or len(names) < 2:
        return folder / (_OWN_NAME if _OWN_NAME in names else names[0]) if names else None
    cameras: dict[str, Intrinsics] = {}
    for name in names:
        with suppress(CaptureError):
            camera = read_camera_file(folder / name).intrinsics
            if camera.stream is Stream.COLOR:
                cameras[name] = camera
    if len(set(cameras.values())) > 1:
        return IntrinsicsError(
            "{names} hold different cameras, and no name tells whose is whose",
            source=folder,
            remedy="begin its name as the pictures' (cam1_intrinsics.json), or give --intrinsics",
            names=", ".join(cameras),
        )
    return folder / next(iter(cameras), names[0])


def _stem_words(name: str) -> _Words:
    return tuple(re.findall(r"[^\W_]+", name.rpartition(".")[0].casefold()))
