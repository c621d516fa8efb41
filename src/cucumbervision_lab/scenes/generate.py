"""Generate synthetic data sets in parallel; interrupted runs can be resumed."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.pictures import read_color, write_jpeg, write_png
from cucumbervision.errors import DataSetError
from cucumbervision_lab.data.coco import (
    FRAGMENTS,
    collect_fragments,
    read_coco,
    write_coco,
    write_fragment,
)
from cucumbervision_lab.data.labels import Label, LabelledPicture, ticked
from cucumbervision_lab.processes import each_done
from cucumbervision_lab.scenes.appearance import load_assets
from cucumbervision_lab.scenes.frame import Frame, FrameOptions, draw_frame, extras_of
from cucumbervision_lab.scenes.paste import cutouts_of, fruitless, montage

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision_lab.data.labels import DataSet
    from cucumbervision_lab.scenes.appearance import Assets
    from cucumbervision_lab.scenes.paste import Cutout

_SMALLEST_PX, _LARGEST_PX = 32, 4096


def parse_size(text: str) -> tuple[int, int]:
    """Parse width x height in pixels.

    Raises
    ------
    DataSetError
        If the text has another form, or a side is out of range.

    Examples
    --------
    >>> parse_size("640x360")
    (640, 360)
    """
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0
    if not all(_SMALLEST_PX <= side <= _LARGEST_PX for side in (width, height)):
        raise DataSetError(
            f"invalid size {text!r}",
            source="--size",
            remedy=f"give WIDTHxHEIGHT, each from {_SMALLEST_PX} to {_LARGEST_PX} px",
        )
    return width, height


_MANIFEST = "synth.json"


_DEPTH_UNIT_M = 0.001

_EXACT_UNIT_M = 0.0001

_QUALITY = 92  # of the JPEG files

# 70:15:15, as in the paper.
_SPLIT_OF = ("train",) * 14 + ("val",) * 3 + ("test",) * 3

# Fruit with a smaller visible share are ignored.
_LEAST_SHARE = 0.12

_LEAST_PX = 0.0001  # share of the picture's pixels below which fruit are ignored


@dataclass(frozen=True)
class SynthOptions:
    """Options of a synthetic set; the same options give the same files.

    Parameters
    ----------
    frames : int
        Number of frames.
    seed : int
        Random seed.
    frame : FrameOptions
        Size, settings and depth of every frame.
    assets : Path, optional
        Folder of picture assets.
    split : str
        'train', 'val' or 'test' for all frames; empty for 70:15:15.
    paste : Path, optional
        Folder of a set with masks whose fruit are pasted onto photos.
    onto : Path, optional
        Folder of a labelled set whose pictures without fruit replace the synthetic frames. Only the
        size of `frame` is then used.

    Raises
    ------
    DataSetError
        If options do not go together.
    """

    frames: int = 1500
    seed: int = 1
    frame: FrameOptions = field(default_factory=FrameOptions)
    assets: Path | None = None
    split: str = ""
    paste: Path | None = None
    onto: Path | None = None

    def __post_init__(self) -> None:
        if self.split not in ("", "train", "val", "test"):
            raise DataSetError(
                f"unknown split {self.split!r}", source="--split", remedy="use train, val or test"
            )
        is_montage = self.paste is not None or self.onto is not None
        whole = self.paste is not None and self.onto is not None and self.split == "train"
        if is_montage and (self.frame.depth or not whole):
            raise DataSetError(
                "montages are for training only, and have no depth",
                source="--paste and --onto",
                remedy="give both, and add --no-depth --split train",
            )


def generate(
    options: SynthOptions,
    out: Path,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> DataSet:
    """Generate a synthetic set, or its missing frames.

    Parameters
    ----------
    options : SynthOptions
        Options of the set.
    out : Path
        Folder for `images/`, `depth/` (simulated, millimetres), `exact/` (tenths of a millimetre),
        `fragments/` and `annotations.json`.
    workers : int
        Number of processes.
    progress : callable, optional
        Called with the number of frames completed since the last call; existing frames count.

    Returns
    -------
    DataSet
        All frames of the set.

    Raises
    ------
    DataSetError
        If the folder contains a set with other options, or is not writable.

    Notes
    -----
    The labels of a frame are written last, so an interrupted frame is generated again. A run with
    more frames adds the missing ones.
    """
    _check_options(options, out)
    missing = [k for k in range(options.frames) if not _fragment(out, k).exists()]
    if progress is not None:
        progress(options.frames - len(missing))
    for _ in ticked(each_done(partial(_draw, options, out), missing, workers), progress):
        pass
    return write_coco(collect_fragments(out), out)


def _check_options(options: SynthOptions, out: Path) -> None:
    """Write the options to the folder, or check that they match the existing ones."""
    paths = {key: getattr(options, key) for key in ("assets", "paste", "onto")}
    folders = {key: "" if path is None else path.resolve().name for key, path in paths.items()}
    record = json.loads(json.dumps(asdict(options) | {"frames": None} | folders))
    file = out / _MANIFEST
    try:
        if file.exists() and json.loads(file.read_text(encoding="utf-8")) != record:
            raise DataSetError(
                "contains a set with other options",
                source=out,
                remedy="use the same options to resume, or another folder",
            )
        for name in ("images", FRAGMENTS, *(("depth", "exact") if options.frame.depth else ())):
            (out / name).mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise DataSetError(
            f"cannot be written ({error.strerror})", source=out, remedy="choose another folder"
        ) from None
    except ValueError:
        raise DataSetError(
            "is damaged", source=file, remedy="delete it and run the command again to resume"
        ) from None


@lru_cache(maxsize=1)
def _assets(folder: Path | None) -> Assets:
    return load_assets(folder)


@lru_cache(maxsize=1)
def _cutouts(folder: Path) -> tuple[Cutout, ...]:
    return cutouts_of(read_coco(folder))


@lru_cache(maxsize=1)
def _grounds(folder: Path) -> tuple[tuple[tuple[LabelledPicture, Path], ...], ...]:
    """Return the photos for montages grouped by source, so that every source has equal weight."""
    data = read_coco(folder)
    grounds = [p for p in data.in_split("train") if fruitless(p)]
    if not grounds:
        raise DataSetError(
            "contains no large training pictures without fruit",
            source=folder,
            remedy="add pictures of canopies, leaves or benches",
        )
    sources = sorted({picture.source for picture in grounds})
    return tuple(
        tuple((p, data.path(p)) for p in grounds if p.source == source) for source in sources
    )


def _paste_onto(options: SynthOptions, onto: Path, paste: Path, out: Path, index: int) -> None:
    """Write a montage of fruit on a photo instead of a synthetic frame."""
    rng = np.random.default_rng([options.seed, index, 2])
    grounds = _grounds(onto)
    of_one_source = grounds[int(rng.integers(len(grounds)))]
    ground, path = of_one_source[int(rng.integers(len(of_one_source)))]
    size = options.frame.width, options.frame.height
    color, labels = montage(read_color(path), size, _cutouts(paste), rng)
    name = f"{index:06d}"
    picture = LabelledPicture(
        f"images/{name}.jpg",
        *size,
        labels,
        scene=ground.scene,
        split="train",
        source=ground.source,
        licence=ground.licence,
    )
    write_jpeg(out / picture.file, color, _QUALITY)
    write_fragment(picture, _fragment(out, index))


def _draw(options: SynthOptions, out: Path, index: int) -> None:
    if options.onto is not None and options.paste is not None:
        _paste_onto(options, options.onto, options.paste, out, index)
        return
    frame = draw_frame(options.seed, index, options.frame, _assets(options.assets))
    name = f"{index:06d}"
    split = options.split or _SPLIT_OF[index % len(_SPLIT_OF)]
    picture = label_frame(frame, name, f"synth-{options.seed}-{name}", split)
    write_jpeg(out / "images" / f"{name}.jpg", frame.color, _QUALITY)
    if frame.depth_m is not None:
        write_png(out / "depth" / f"{name}.png", _steps(frame.depth_m, _DEPTH_UNIT_M))
        write_png(out / "exact" / f"{name}.png", _steps(frame.exact_m, _EXACT_UNIT_M))
    write_fragment(picture, _fragment(out, index))


def _fragment(out: Path, index: int) -> Path:
    return out / FRAGMENTS / f"{index:06d}.json"


def _steps(depth_m: np.ndarray[Any, Any], unit_m: float) -> np.ndarray[Any, Any]:
    return np.clip(np.rint(depth_m / unit_m), 0, 65535).astype(np.uint16)


def label_frame(frame: Frame, name: str, scene: str, split: str) -> LabelledPicture:
    """Return the labels of a synthetic frame.

    Parameters
    ----------
    frame : Frame
        The frame.
    name : str
        Base name of its files.
    scene : str
        Scene name.
    split : str
        'train', 'val' or 'test'.

    Returns
    -------
    LabelledPicture
        Labels of all visible fruit. Fruit are ignored if less than 12 % is visible, or less than
        0.01 % of the picture.
    """
    height, width = frame.color.shape[:2]
    labels = []
    for truth in frame.truth:
        visible_px = int(truth.visible.sum())
        if not visible_px:
            continue
        small = visible_px < _LEAST_PX * width * height or truth.hidden_share > 1 - _LEAST_SHARE
        points = np.column_stack([truth.keypoints_px, truth.keypoint_visibility])
        labels.append(
            Label.of_mask(
                truth.visible,
                amodal=truth.amodal,
                keypoints=points.astype(np.float64),
                hidden_share=round(truth.hidden_share, 4),
                cut_off=truth.cut_off,
                ignore=small,
                extras=extras_of(truth),
            )
        )
    depth = frame.depth_m is not None
    return LabelledPicture(
        f"images/{name}.jpg",
        width,
        height,
        tuple(labels),
        scene=scene,
        split=split,
        source="synth",
        licence="CC0-1.0",
        depth_file=f"depth/{name}.png" if depth else None,
        depth_unit_m=_DEPTH_UNIT_M,
        camera=frame.camera,
        extras={
            "setting": frame.staged.setting.value,
            "variety": frame.staged.variety.value,
            "depth_scale": round(frame.depth_scale, 6),
            "gravity": [round(-float(component), 4) for component in frame.staged.up],
        },
    )
