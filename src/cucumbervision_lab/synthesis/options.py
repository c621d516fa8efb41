"""Read the options of a set from words."""

from __future__ import annotations

from pathlib import Path

from cucumbervision.errors import DataSetError
from cucumbervision_lab.synthesis.frame import FrameOptions
from cucumbervision_lab.synthesis.generate import SynthOptions

__all__ = ["parse_options"]

SMALLEST_PX, LARGEST_PX = 32, 4096


def parse_options(
    *,
    frames: int,
    seed: int,
    size: str,
    shares: str,
    split: str,
    assets: Path | None = None,
    paste: Path | None = None,
    depth: bool = True,
    scale_sd: float = 0.0,
) -> SynthOptions:
    """Give the options that the words mean.

    Parameters
    ----------
    frames, seed, depth, scale_sd : int, int, bool, float
        As `SynthOptions` and `FrameOptions`.
    size : str
        '1280x720': width x height in pixels.
    shares : str
        '0.6,0.22,0.18': weights of hanging, bench and crate, not all 0.
    split : str
        '', 'train', 'val' or 'test'.
    assets : Path, optional
        Folder of textures, backgrounds and lights.
    paste : Path, optional
        Folder of a set with masks whose fruit are pasted in.

    Raises
    ------
    DataSetError
        Naming the option that means nothing.

    Examples
    --------
    >>> options = parse_options(frames=3, seed=1, size="640x360", shares="1,0,0", split="")
    >>> options.frame.width, options.frame.shares
    (640, (1.0, 0.0, 0.0))
    """
    try:
        width, height = (int(part) for part in size.lower().split("x"))
    except ValueError:
        width = height = 0
    if not all(SMALLEST_PX <= side <= LARGEST_PX for side in (width, height)):
        raise DataSetError(
            f"{size!r} is no size from {SMALLEST_PX} to {LARGEST_PX} px",
            source="--size",
            remedy="write it as 1280x720",
        )
    if split not in ("", "train", "val", "test"):
        raise DataSetError(
            f"no split is called {split!r}", source="--split", remedy="write train, val or test"
        )
    if paste is not None and depth:
        raise DataSetError("pasted fruit have no depth", source="--paste", remedy="add --no-depth")
    return SynthOptions(
        frames=frames,
        seed=seed,
        frame=FrameOptions(width, height, _shares(shares), depth, scale_sd),
        assets=str(assets.resolve()) if assets else "",
        split=split,
        paste=str(paste.resolve()) if paste else "",
    )


def _shares(words: str) -> tuple[float, float, float]:
    try:
        weights = [float(part) for part in words.split(",")]
    except ValueError:
        weights = []
    if len(weights) != 3 or min(weights) < 0 or not 0 < sum(weights) < float("inf"):
        raise DataSetError(
            f"{words!r} are no three weights", source="--shares", remedy="write them as 6,2,2"
        )
    a, b, c = (weight / sum(weights) for weight in weights)
    return a, b, c
