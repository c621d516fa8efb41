"""Read images within size limits, and convert depth to metres; wrong units are detected."""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from cucumbervision.arrays import Array32, Mask, Numbers, Pixels
from cucumbervision.errors import CaptureError, DepthError, Message, joined, wrap_reader_errors
from cucumbervision.files import read_bytes, read_text, write_bytes

COLOR_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm"})
PHOTO_SUFFIXES = COLOR_SUFFIXES | {".webp"}
DEPTH_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".pgm", ".npy", ".csv"})

MOST_PIXELS = 64_000_000
"""Maximum size of an image; OpenCV is configured to reject larger ones by their header."""
MOST_BURST_PIXELS, MOST_MASK_PIXELS = 4 * MOST_PIXELS, 10 * MOST_PIXELS
"""Maximum total size of the frames of a burst, and of the masks of a frame."""

_ROWS_AT_ONCE = 64  # blended in float32: all rows at once would take four times the memory
_GREY = 114  # padding value of network inputs
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"


def read_color(path: Path) -> Pixels:
    """Read a colour image.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB.

    Raises
    ------
    CaptureError
        If the file is missing, truncated or no image.
    """
    # Ignore the EXIF orientation, because depth would not be rotated with it.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cast("Pixels", cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def read_photo(path: Path) -> Pixels:
    """Read a photo as an image viewer shows it.

    Applies the EXIF orientation, and converts 16 bits to 8, grey to colour, and transparency to a
    grey background.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB.

    Raises
    ------
    CaptureError
        If the file is missing, truncated or no image of whole numbers.
    """
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
    return cast("Pixels", cv2.cvtColor(colour, cv2.COLOR_BGR2RGB))


def _photo_levels(path: Path, image: Numbers) -> Pixels:
    if image.dtype == np.uint8:
        return image
    if image.dtype == np.uint16:
        return cast("Pixels", cv2.convertScaleAbs(image, alpha=1 / 257))
    remedy = "save it with 8 or 16 bits a colour"
    fault = "its levels are {kind}, whose range is unknown"
    raise CaptureError(fault, source=path, remedy=remedy, kind=image.dtype)


def read_masks(paths: Sequence[Path], shape: tuple[int, ...]) -> tuple[Mask, ...]:
    """Read mask images, in which nonzero pixels belong to the fruit.

    Parameters
    ----------
    paths : sequence of Path
        Single-channel images.
    shape : tuple of int
        Their shape (H, W), which a `Capture` checks.

    Raises
    ------
    CaptureError
        If a file is missing, truncated or no image, or all of them together take more than memory
        should hold.
    """
    if len(paths) * shape[0] * shape[1] > MOST_MASK_PIXELS:
        raise CaptureError(
            f"its {len(paths)} masks have more than {MOST_MASK_PIXELS / 1e6:g} million pixels",
            source=paths[0].parent,
            remedy="give fewer masks, or smaller pictures",
        )
    return tuple(_decode(path, cv2.IMREAD_GRAYSCALE) > 0 for path in paths)


def read_depth(path: Path) -> Numbers:
    """Read the raw values of a depth image: PNG, TIFF, PGM, CSV or `.npy`.

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
    read_bytes(path)  # a missing file is named
    with suppress(cv2.error), _quiet_opencv():  # `_decode` names a damaged one
        pages = cv2.imcount(str(path))
        if pages > 1:
            raise DepthError(
                f"holds {pages} pages, and nothing tells which belongs to the colour picture",
                source=path,
                remedy="save the one that was taken with it as a picture of its own",
            )
    return _decode(path, cv2.IMREAD_UNCHANGED)


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from printing its own messages for a broken file."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _read_table(path: Path) -> Numbers:
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


def read_array(path: Path) -> Numbers:
    """Read an `.npy` file of numbers; never Python objects.

    Raises
    ------
    DepthError
        If it is another file, or its items are no numbers.
    """
    data = read_bytes(path)
    remedy = "save the array as uint16 or float32 with numpy.save"
    with wrap_reader_errors(path, DepthError, remedy):
        array: Numbers = np.load(io.BytesIO(data), allow_pickle=False, max_header_size=4000)
        if array.dtype.kind not in "biuf":
            raise DepthError("holds no numbers", source=path, remedy=remedy)
        return array


def _decode(path: Path, flags: int) -> Numbers:
    data = read_bytes(path)
    # OpenCV gives a truncated image with its missing part grey, as if nothing were wrong.
    truncated = (data.startswith(_PNG) and not _whole_png(data)) or (
        data.startswith(_JPEG) and b"\xff\xd9" not in data[-1024:]
    )
    image, remedy = None, "copy or export it again"
    fault = "is truncated or damaged" if truncated else "is not a readable picture"
    if not truncated:
        try:
            with _quiet_opencv():
                image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            if "CV_IO_MAX_IMAGE" in str(error):  # from the header, before memory is allocated
                fault, remedy = "has more than {limit:g} million pixels", "give a smaller picture"
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


def encoded(image: Numbers, suffix: str = ".png", quality: int = 95) -> bytes:
    """Return the content of an image file.

    Parameters
    ----------
    image : ndarray, shape (H, W) or (H, W, 3)
        RGB, grey or 16-bit values.
    suffix : str
        '.png' or '.jpg'.
    quality : int
        Quality of a JPEG, up to 100.

    Examples
    --------
    >>> encoded(np.zeros((4, 4, 3), np.uint8), ".jpg")[:3].hex()
    'ffd8ff'
    """
    image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix == ".jpg" else []
    return cv2.imencode(suffix, image, options)[1].tobytes()


def write_png(path: Path, image: Numbers) -> None:
    """Write an RGB, grey or 16-bit image.

    Raises
    ------
    CaptureError
        If the file cannot be written.
    """
    write_bytes(path, encoded(image))


def write_jpeg(path: Path, color_rgb: Pixels, quality: int = 95) -> None:
    """Write an RGB image.

    Raises
    ------
    CaptureError
        If the file cannot be written.
    """
    write_bytes(path, encoded(color_rgb, ".jpg", quality))


DEPTH_MIN_M, DEPTH_MAX_M = 0.1, 5.0


def valid_depth(depth_m: Array32) -> Mask:
    """Return which depth values are valid readings, between 0.1 and 5 m.

    Parameters
    ----------
    depth_m : ndarray of float
        Depth in metres, any shape; 0, NaN and infinity are no readings.

    Returns
    -------
    ndarray of bool
        The shape of `depth_m`.

    Examples
    --------
    >>> valid_depth(np.array([0.0, 0.05, 0.5, 9.0, np.nan], np.float32))
    array([False, False,  True, False, False])
    """
    # Comparisons with NaN are False, so NaN needs no separate test.
    return (depth_m >= DEPTH_MIN_M) & (depth_m <= DEPTH_MAX_M)


_FEW, _MOST = 0.01, 0.5
_WHOLE = 0.01  # of a millimetre, to which float32 rounds whole ones
_FINEST_M, _COARSEST_M = 1e-7, 10.0
_UNIT_NAMES = {
    1.0: "metres",
    0.001: "millimetres",
    0.0001: "steps of 0.1 mm",
    0.0002: "steps of 0.2 mm",
}


def enlarge_depth(depth_m: Array32, width: int, height: int) -> Array32:
    """Return depth with more pixels, each with the value of the nearest; nothing is interpolated.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (h, w)
        Metres; 0 for no reading.
    width, height : int
        New size, pixels.

    Examples
    --------
    >>> enlarge_depth(np.array([[0.5, 0.75]], np.float32), 4, 1)
    array([[0.5 , 0.5 , 0.75, 0.75]], dtype=float32)
    """
    size = (width, height)
    return np.asarray(cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)


def depth_to_metres(raw: Numbers, unit_m: float | None = None, *, source: object = None) -> Array32:
    """Convert the raw values of a depth image to metres.

    Parameters
    ----------
    raw : ndarray, shape (H, W) or (H, W, 1)
        Integers of at least 16 bits, or floats. NaN, infinity and negative values are invalid.
    unit_m : float, optional
        Metres per step; by default 0.001 for integers and 1 for floats.
    source : object, optional
        The file, for error messages.

    Returns
    -------
    ndarray of float32, shape (H, W)
        Metres; 0 for no reading. Readings outside 0.1 to 5 m are kept; see `valid_depth`.

    Raises
    ------
    DepthError
        If the image has colour channels or 8 bits, the unit is implausible while metres or
        millimetres are plausible, or the numbers are shares of the largest.

    Examples
    --------
    >>> depth_to_metres(np.array([[0, 454]], np.uint16))
    array([[0.   , 0.454]], dtype=float32)
    >>> depth_to_metres(np.array([[np.nan, 0.454]]), source="a.npy", unit_m=0.001)
    Traceback (most recent call last):
    ...
    cucumbervision.errors.DepthError: a.npy: depth is declared in millimetres, ...
    """
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[:, :, 0]
    _check_kind(raw, source)
    if unit_m is None:
        _refuse_shares(raw, source)
        unit_m = 1.0 if raw.dtype.kind == "f" else 0.001
    if not _FINEST_M <= unit_m <= _COARSEST_M:
        fault, remedy = "no camera's depth has steps of {unit:g} m", "correct the unit"
        raise DepthError(fault, source=source, remedy=remedy, unit=unit_m)
    _check_unit(raw, unit_m, source)
    return scale_depth(raw, unit_m)


def scale_depth(raw: Numbers, unit_m: float) -> Array32:
    """Scale depth to metres without plausibility checks; invalid values become 0.

    Examples
    --------
    >>> scale_depth(np.array([[-1.0, 454.0, np.nan]]), 0.001)
    array([[0.   , 0.454, 0.   ]], dtype=float32)
    """
    # Multiply in double precision, so that 454 * 0.001 is the float32 nearest to 0.454.
    depth_m: Array32 = np.multiply(raw, unit_m, dtype=np.float64).astype(np.float32)
    if raw.dtype.kind != "u":
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
    return depth_m


def require_readings(depth_m: Array32, *, source: object = None) -> None:
    """Raise an error if depth has no valid reading.

    Raises
    ------
    DepthError
        If no reading is between 0.1 and 5 m.
    """
    if valid_depth(depth_m).any():
        return
    readings = depth_m[depth_m > 0]
    what = Message("every pixel is 0")
    if readings.size:
        ends = {"low": readings.min(), "high": readings.max()}
        what = Message("readings run from {low:.4g} to {high:.4g} m", **ends)
    raise DepthError(
        "depth has no reading between {low} and {high:.0f} m: {what}",
        source=source,
        remedy="check the depth stream and its unit, and capture again",
        low=DEPTH_MIN_M,
        high=DEPTH_MAX_M,
        what=what,
    )


def _check_kind(raw: Numbers, source: object) -> None:
    if raw.ndim != 2 or not raw.size:
        fault = (
            "depth is {kind} {shape}, not one value a pixel; "
            "a colourised picture of depth has no distances"
        )
    elif raw.dtype.itemsize < 2 or raw.dtype.kind not in "uif":
        fault = "depth has {bits} bits ({kind}), a picture to look at and no distances"
    else:
        return
    parts = {"kind": raw.dtype, "shape": raw.shape, "bits": 8 * raw.dtype.itemsize}
    raise DepthError(fault, source=source, remedy="give the 16-bit depth itself", **parts)


def _refuse_shares(raw: Numbers, source: object) -> None:
    """Refuse numbers that were divided by the largest: relative depth has no metres."""
    if raw.dtype.kind != "f":
        return
    readings = raw[np.isfinite(raw) & (raw > 0)]
    if readings.max(initial=0.0) != 1.0 or readings.min() == 1.0:
        return
    steps = 1000.0 * readings
    if (np.abs(steps - np.rint(steps)) > _WHOLE).mean() > _MOST:  # a camera's are whole millimetres
        raise DepthError(
            "depth is 1 at most, as shares of the largest distance are, which are no metres",
            source=source,
            remedy="give depth in metres; if it is, declare the depth unit 1 m",
        )


def _check_unit(raw: Numbers, unit_m: float, source: object) -> None:
    inside = _share_inside(raw, unit_m)
    if inside > _FEW:
        return
    shares = {candidate_m: _share_inside(raw, candidate_m) for candidate_m in _UNIT_NAMES}
    fitting = [candidate_m for candidate_m, share in shares.items() if share > _MOST]
    if fitting:
        declared = _UNIT_NAMES.get(unit_m) or Message("steps of {unit:g} m", unit=unit_m)
        raise DepthError(
            "depth is declared in {declared}, but {outside:.0f} % of its readings then lie "
            "outside {low} to {high:.0f} m; in {unit} {inside:.0f} % lie inside",
            source=source,
            remedy="declare the depth unit {units}",
            units=joined((Message("{unit:g} m", unit=x) for x in fitting), "{first} or {second}"),
            declared=declared,
            outside=100 * (1 - inside),
            low=DEPTH_MIN_M,
            high=DEPTH_MAX_M,
            unit=_UNIT_NAMES[fitting[0]],
            inside=100 * shares[fitting[0]],
        )


def _share_inside(raw: Numbers, unit_m: float) -> float:
    # Relative to all positive finite readings.
    first_step, last_step = DEPTH_MIN_M / unit_m, DEPTH_MAX_M / unit_m
    if raw.dtype.kind in "ui":  # comparing integers with integers is several times faster
        first_step, last_step = math.ceil(first_step), math.floor(last_step)
    readings = np.count_nonzero(raw > 0 if raw.dtype.kind in "ui" else (raw > 0) & np.isfinite(raw))
    return int(np.count_nonzero((raw >= first_step) & (raw <= last_step))) / max(int(readings), 1)
