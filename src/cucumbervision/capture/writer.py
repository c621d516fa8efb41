"""Any capture to a native capture folder."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.files import json_value, parse_model, write_bytes, write_png
from cucumbervision.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture

__all__ = ["write_native"]

# Steps to try, coarse first: 16 bits of the finest reach 3.3 m.
_UNITS_M = (0.001, 0.0005, 0.00025, 0.0001, 0.00005)
_STEPS = 65535
_EXACT_M = 1e-6


def write_native(
    capture: Capture,
    folder: Path,
    *,
    burst: Sequence[tuple[NDArray[np.uint8], NDArray[np.float32]]] = (),
    timestamps_s: Sequence[float | None] = (),
) -> Path:
    """Write a capture as a native folder, which reads back the same.

    Parameters
    ----------
    capture : Capture
        What to write; its name, frame, stop, masks, intrinsics and provenance are kept.
    folder : Path
        Made if it does not exist; must not hold a capture yet.
    burst : sequence of (color, depth_m), optional
        The burst's single frames, written in place of the capture's fused picture and fused
        again when read: colour uint8 (H, W, 3), depth float32 (H, W) in metres.
    timestamps_s : sequence of float, optional
        Seconds since the epoch of the burst's frames.

    Returns
    -------
    Path
        The `capture.json` written, last of all files: an interrupted write is no capture.

    Raises
    ------
    CaptureError
        If the folder already holds a capture, cannot be written, or depth reaches farther than
        65.5 m.

    Notes
    -----
    Depth is 16-bit PNG in steps of 1 mm, or in finer steps where 1 mm would lose something (a
    burst's median may lie between two millimetres). Where the finest that reaches the farthest
    reading (0.05 mm up to 3.3 m, 0.1 mm up to 6.5 m) loses something,
    `capture.json` says how much at most under `depth_rounding_m`.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision.capture.readers import open_source
    >>> depth = np.full((48, 64), 0.4545, np.float32)
    >>> color, camera = np.zeros((48, 64, 3), np.uint8), Intrinsics(64, 48, 60, 60, 32, 24)
    >>> with tempfile.TemporaryDirectory() as tmp:
    ...     path = write_native(Capture(color, depth, camera, "a"), pathlib.Path(tmp) / "a")
    ...     back = next(iter(open_source(path.parent))).load()
    >>> back.name, bool((back.depth_m == depth).all())
    ('a', True)
    """
    from cucumbervision.capture.readers.native import MANIFEST, MASKS, Manifest

    if (folder / MANIFEST).exists():
        raise CaptureError("already holds a capture", source=folder, remedy="choose another folder")
    frames = list(burst) or [(capture.color, capture.depth_m)]
    times = list(timestamps_s) or ([None] * len(burst) if burst else [capture.timestamp_s])
    unit_m, rounding_m = _choose_unit([d for _, d in frames], folder)
    manifest = _manifest(capture, times, unit_m, rounding_m, fused=not burst)
    text = json.dumps(json_value(manifest), indent=2) + "\n"
    parse_model(Manifest, json.loads(text), source=folder)
    try:
        (folder / MASKS if capture.masks else folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CaptureError(
            f"cannot be made ({error.strerror})", source=folder, remedy="choose another folder"
        ) from None
    for i, (color, depth_m) in enumerate(frames):
        write_png(folder / f"color_{i:06d}.png", color)
        write_png(folder / f"depth_{i:06d}.png", _steps(depth_m, unit_m).astype(np.uint16))
    for k, mask in enumerate(capture.masks):
        write_png(folder / MASKS / f"{capture.frame:06d}_{k:06d}.png", mask.astype(np.uint8) * 255)
    write_bytes(folder / MANIFEST, text.encode())
    return folder / MANIFEST


def _manifest(
    capture: Capture,
    times: Sequence[float | None],
    unit_m: float,
    rounding_m: float,
    *,
    fused: bool,
) -> dict[str, Any]:
    from cucumbervision.capture.camera_file import CameraModel
    from cucumbervision.capture.readers.native import FORMAT

    return {
        "format": FORMAT,
        "version": 1,
        "name": capture.name,
        "frame": capture.frame,
        "burst_frame": capture.burst_frame if fused else 0,
        "burst_size": capture.burst_size if fused else 1,
        "frames": [
            {"color": f"color_{i:06d}.png", "depth": f"depth_{i:06d}.png", "timestamp_s": t}
            for i, t in enumerate(times)
        ],
        "depth_unit_m": unit_m,
        "depth_rounding_m": rounding_m,
        "camera": CameraModel.of(capture.intrinsics).model_dump(mode="json"),
        "stop": vars(capture.stop),
        "simulated": capture.simulated,
        "provenance": dict(capture.provenance),
    }


def _choose_unit(depths_m: Sequence[NDArray[np.float32]], folder: Path) -> tuple[float, float]:
    readings = np.unique(np.concatenate([d[np.isfinite(d) & (d > 0)].ravel() for d in depths_m]))
    far_m = float(readings.max(initial=0.0))
    unit_m, rounding_m = 0.0, 0.0
    for step_m in _UNITS_M:
        if far_m / step_m > _STEPS:
            break
        unit_m = step_m
        rounding_m = float(np.abs(_steps(readings, unit_m) * unit_m - readings).max(initial=0.0))
        if rounding_m <= _EXACT_M:
            return unit_m, 0.0
    if not unit_m:
        raise CaptureError(
            f"depth reaches {far_m:.0f} m, too far for 16 bits in millimetres",
            source=folder,
            remedy="set readings beyond 65.5 m to 0",
        )
    return unit_m, round(rounding_m, 6)


def _steps(depth_m: NDArray[np.float32], unit_m: float) -> NDArray[np.float64]:
    finite = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0)
    return np.rint(finite.astype(np.float64) / unit_m)
