"""One clean RGB-D frame: what every reader gives and every later room takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import CaptureError, DepthError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

__all__ = ["DEPTH_MAX_M", "DEPTH_MIN_M", "Capture", "Stop", "valid_depth"]

DEPTH_MIN_M = 0.1
DEPTH_MAX_M = 5.0


@dataclass(frozen=True)
class Stop:
    """Where in the house a capture was taken; every part may be unknown."""

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    step: int | None = None


@dataclass(frozen=True, eq=False)
class Capture:
    """One RGB-D frame, or a burst fused to one, with depth aligned to colour.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 where there is no reading.
    intrinsics : Intrinsics
        The colour stream's, at the picture's size.
    name : str
        What the capture is called in tables and file names; unique within a source.
    frame : int
        The source's own number: BOP image id, recording frame, index in a burst folder.
    burst_frame : int
        Index within the burst of the frame whose colour was kept.
    burst_size : int
        How many frames were fused.
    masks : tuple of ndarray of bool, shape (H, W)
        The data set's own masks of the fruit, where it has them.
    stop : Stop
        Where it was taken.
    timestamp_s : float, optional
        Seconds since the epoch.
    simulated : bool
        True for rendered captures; shown wherever the capture is.
    source : str
        The file or folder it was read from.
    provenance : mapping
        What else the source says: camera name, serial number, software.

    Raises
    ------
    CaptureError
        If colour, depth, masks and intrinsics do not have one size, or a dtype is wrong.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> capture = Capture(
    ...     np.zeros((48, 64, 3), np.uint8),
    ...     np.full((48, 64), 0.5, np.float32),
    ...     Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0),
    ...     name="a",
    ... )
    >>> capture.width, capture.height, capture.fill
    (64, 48, 1.0)
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics
    name: str
    frame: int = 0
    burst_frame: int = 0
    burst_size: int = 1
    masks: tuple[NDArray[np.bool_], ...] = ()
    stop: Stop = field(default_factory=Stop)
    timestamp_s: float | None = None
    simulated: bool = False
    source: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.color.ndim != 3 or self.color.shape[2] != 3 or self.color.dtype != np.uint8:
            raise CaptureError(
                f"colour is {self.color.dtype} {self.color.shape}, not uint8 (H, W, 3)",
                source=self.source or self.name,
                remedy="give an 8-bit RGB picture",
            )
        if self.depth_m.ndim != 2 or self.depth_m.dtype != np.float32:
            raise DepthError(
                f"depth is {self.depth_m.dtype} {self.depth_m.shape}, not float32 (H, W) in metres",
                source=self.source or self.name,
                remedy="give one depth value a pixel",
            )
        sizes = {
            "colour": self.color.shape[:2],
            "depth": self.depth_m.shape,
            "intrinsics": (self.intrinsics.height, self.intrinsics.width),
            **{f"mask {i}": m.shape for i, m in enumerate(self.masks)},
        }
        if len(set(sizes.values())) > 1:
            text = ", ".join(f"{k} {s[1]}x{s[0]}" for k, s in sizes.items())
            raise CaptureError(
                f"sizes differ: {text}",
                source=self.source or self.name,
                remedy="align depth to colour and give the colour intrinsics at that size",
            )

    @property
    def width(self) -> int:
        """Width in pixels."""
        return int(self.depth_m.shape[1])

    @property
    def height(self) -> int:
        """Height in pixels."""
        return int(self.depth_m.shape[0])

    @property
    def fill(self) -> float:
        """Share of pixels with a valid depth reading, 0 to 1."""
        return float(valid_depth(self.depth_m).mean())


def valid_depth(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Say which depth values are readings: finite and between 0.1 and 5 m.

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
    # Comparisons with NaN are False, so NaN needs no test of its own.
    return (depth_m >= DEPTH_MIN_M) & (depth_m <= DEPTH_MAX_M)
