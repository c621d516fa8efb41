"""Read pictures and arrays within size limits, with errors that name the file."""

from __future__ import annotations

import io
import math
import zlib
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.lib import format as npy

from cucumbervision.errors import CaptureError, DepthError, wrap_reader_errors
from cucumbervision.files import read_bytes, read_text, write_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray


COLOR_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm"})
PHOTO_SUFFIXES = COLOR_SUFFIXES | {".webp"}
DEPTH_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".pgm", ".npy", ".csv"})

MOST_PIXELS = 64_000_000
"""Maximum size of a picture; OpenCV is configured to reject larger ones by their header."""
MOST_BURST_PIXELS, MOST_MASK_PIXELS = 4 * MOST_PIXELS, 10 * MOST_PIXELS
"""Maximum total size of the frames of a burst, and of the masks of a frame."""

_ROWS_AT_ONCE = 64  # blended in float32: all rows at once would take four times the memory
_GREY = 114  # padding value of network inputs
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read a colour picture.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB.

    Raises
    ------
    CaptureError
        If the file is missing, truncated or no picture.
    """
    import cv2

    # Ignore the EXIF orientation, because depth would not be rotated with it.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def read_photo(path: Path) -> NDArray[np.uint8]:
    """Read a photo as a picture viewer shows it.

    Applies the EXIF orientation, and converts 16 bits to 8, grey to colour, and transparency to a
    grey background.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB.

    Raises
    ------
    CaptureError
        If the file is missing, truncated or no picture of whole numbers.
    """
    import cv2

    colour = _photo_levels(path, _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH))
    opaque = path.suffix.lower() in {".jpg", ".jpeg"}
    raw = colour if opaque else _decode(path, cv2.IMREAD_UNCHANGED)
    # The alpha channel is stored without the EXIF orientation: use it only if sizes match.
    if raw.ndim == 3 and raw.shape[2] == 4 and raw.shape[:2] == colour.shape[:2]:
        for top in range(0, len(raw), _ROWS_AT_ONCE):
            part = slice(top, top + _ROWS_AT_ONCE)
            alpha = _photo_levels(path, raw[part, :, 3:]).reshape(*raw[part].shape[:2], 1)
            opacity = alpha.astype(np.float32) / 255
            mixed = colour[part] * opacity + _GREY * (1 - opacity)
            colour[part] = np.rint(mixed).astype(np.uint8)
    return cast("NDArray[np.uint8]", cv2.cvtColor(colour, cv2.COLOR_BGR2RGB))


def _photo_levels(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    import cv2

    if image.dtype == np.uint8:
        return image
    if image.dtype == np.uint16:
        return cast("NDArray[np.uint8]", cv2.convertScaleAbs(image, alpha=1 / 257))
    raise CaptureError(
        "its levels are {kind}, whose range is unknown",
        source=path,
        remedy="save it with 8 or 16 bits a colour",
        kind=image.dtype,
    )


def read_masks(paths: Sequence[Path], shape: tuple[int, ...]) -> tuple[NDArray[np.bool_], ...]:
    """Read mask pictures, in which nonzero pixels belong to the fruit.

    Parameters
    ----------
    paths : sequence of Path
        Single-channel pictures.
    shape : tuple of int
        Required shape (H, W).

    Raises
    ------
    CaptureError
        If a file is missing, truncated, no picture or of another size, or all of them together
        take more than memory should hold.
    """
    if len(paths) * shape[0] * shape[1] > MOST_MASK_PIXELS:
        raise CaptureError(
            f"its {len(paths)} masks have more than {MOST_MASK_PIXELS / 1e6:g} million pixels",
            source=paths[0].parent,
            remedy="give fewer masks, or smaller pictures",
        )
    return tuple(_read_mask(path, shape) for path in paths)


def _read_mask(path: Path, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    import cv2

    image = _decode(path, cv2.IMREAD_GRAYSCALE)
    if image.shape != shape[:2]:
        sizes = {"mask": image.shape, "picture": shape}
        parts = {name: f"{size[1]}x{size[0]}" for name, size in sizes.items()}
        fault, remedy = (
            "the mask is {mask}, the picture {picture}",
            "give a mask of the picture's size",
        )
        raise CaptureError(fault, source=path, remedy=remedy, **parts)
    return image > 0


def read_depth(path: Path) -> NDArray[Any]:
    """Read the raw values of a depth picture: PNG, TIFF, PGM, CSV or `.npy`.

    Returns
    -------
    ndarray
        Values as stored, of any shape and dtype; `depth_to_metres` validates them.

    Raises
    ------
    CaptureError
        If the file is missing, truncated, or of no known kind.
    DepthError
        If the file contains no array, or Python objects, which are never loaded.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return read_array(path)
    if suffix == ".csv":
        return _read_table(path)
    if suffix not in DEPTH_SUFFIXES:
        raise CaptureError(
            f"'{suffix}' is not a depth picture",
            source=path,
            remedy="give a 16-bit PNG, a TIFF, a PGM, .csv or .npy",
        )
    import cv2

    _require_one_page(path, suffix)
    return _decode(path, cv2.IMREAD_UNCHANGED)


def _require_one_page(path: Path, suffix: str) -> None:
    """Reject a picture of several pages or frames, because the correct one is unknown."""
    data = read_bytes(path)
    pages = 1
    if suffix in {".tif", ".tiff"}:
        import cv2

        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            pages = cv2.imcount(str(path)) if path.is_file() else 1
        except cv2.error:  # `_decode` says what is wrong
            pages = 1
        cv2.utils.logging.setLogLevel(level)
    elif data.startswith(_PNG):
        start = data.find(b"acTL", 0, 200)
        pages = int.from_bytes(data[start + 4 : start + 8], "big") if start > 0 else 1
    if pages > 1:
        raise DepthError(
            f"holds {pages} pages, and nothing tells which belongs to the colour picture",
            source=path,
            remedy="save the one that was taken with it as a picture of its own",
        )


def _read_table(path: Path) -> NDArray[Any]:
    text = read_text(path)
    first = text.partition("\n")[0]
    if "\t" in first or ";" in first:  # then a comma is a decimal one
        text = text.replace(",", ".").replace("\t", ",").replace(";", ",")
    if text.count(",") > MOST_PIXELS:
        fault = f"has more than {MOST_PIXELS / 1e6:g} million cells"
        raise DepthError(fault, source=path, remedy="give a smaller picture")
    with wrap_reader_errors(path, DepthError, "give a line of numbers for each row of pixels"):
        table = np.loadtxt(text.splitlines(), delimiter=",", ndmin=2)
    is_integer = bool(np.isfinite(table).all() and (table == np.rint(table)).all())
    return table.astype(np.int32) if is_integer and np.abs(table).max(initial=0) < 2**31 else table


def read_array(path: Path) -> NDArray[Any]:
    """Read an `.npy` file of numbers; never Python objects.

    Raises
    ------
    DepthError
        If it is another file, or its items are no numbers.
    """
    data = read_bytes(path)
    remedy = "save the array as uint16 or float32 with numpy.save"
    with wrap_reader_errors(path, DepthError, remedy):
        stream = io.BytesIO(data)
        is_first = npy.read_magic(stream) == (1, 0)
        read_head = npy.read_array_header_1_0 if is_first else npy.read_array_header_2_0
        shape, is_by_columns, dtype = read_head(stream, max_header_size=4000)
        if dtype.kind not in "biuf":
            raise DepthError("holds no numbers", source=path, remedy=remedy)
        # Unlike numpy.load it takes no memory for what the head promises and the file lacks.
        flat = np.frombuffer(data, dtype, math.prod(shape), stream.tell())
        return flat.reshape(shape, order="F" if is_by_columns else "C")


def _decode(path: Path, flags: int) -> NDArray[Any]:
    import cv2

    data = read_bytes(path)
    # OpenCV gives a truncated picture with its missing part grey, as if nothing were wrong.
    truncated = (data.startswith(_PNG) and not _whole_png(data)) or (
        data.startswith(_JPEG) and b"\xff\xd9" not in data[-1024:]
    )
    image = None
    fault = "is truncated or damaged" if truncated else "is not a readable picture"
    remedy = "copy or export it again"
    if not truncated:
        # OpenCV would print its own messages for a broken file.
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            if "CV_IO_MAX_IMAGE" in str(error):  # from the header, before memory is allocated
                fault = "has more than {limit:g} million pixels"
                remedy = "give a smaller picture"
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise CaptureError(fault, source=path, remedy=remedy, limit=MOST_PIXELS / 1e6)
    return image


def _whole_png(data: bytes) -> bool:
    """Walk the PNG's chunks (ISO/IEC 15948, 5.3): each whole, its checksum right, IEND last."""
    offset = len(_PNG)
    while offset + 12 <= len(data):
        length = int.from_bytes(data[offset : offset + 4], "big")
        body, end = offset + 4, offset + 8 + length
        if data[end : end + 4] != zlib.crc32(data[body:end]).to_bytes(4, "big"):
            return False
        if data[body : body + 4] == b"IEND":
            return True
        offset = end + 4
    return False


def write_png(path: Path, image: NDArray[Any]) -> None:
    """Write an RGB, grey or 16-bit picture.

    Raises
    ------
    CaptureError
        If the file cannot be written.
    """
    import cv2

    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".png", image)
    write_bytes(path, data.tobytes())


def write_jpeg(path: Path, color_rgb: NDArray[np.uint8], quality: int = 95) -> None:
    """Write an RGB picture.

    Raises
    ------
    CaptureError
        If the file cannot be written.
    """
    import cv2

    bgr = np.ascontiguousarray(color_rgb[..., ::-1])
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    write_bytes(path, data.tobytes())
