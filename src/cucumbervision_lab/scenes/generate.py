"""Generate synthetic data sets: scene, colour, simulated depth and ground truth of each frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from cucumbervision.capture.frames import fuse_burst
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_color, write_jpeg, write_png
from cucumbervision.errors import DataSetError, wrap_os_errors
from cucumbervision.files import read_json
from cucumbervision.tube.shape import arc_positions, points_along
from cucumbervision_lab.arrays import Array, Array32, Generator, Pixels
from cucumbervision_lab.data.coco import coco_entries, read_coco, write_annotations
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.processes import kept_rows
from cucumbervision_lab.scenes.colors import expose, palette, random_exposure
from cucumbervision_lab.scenes.compose import HARD, PLAIN, Composition, Setting, compose
from cucumbervision_lab.scenes.depth_camera import VGA, D4xx, sense
from cucumbervision_lab.scenes.paste import Cutout, cutouts_of, fruitless, montage
from cucumbervision_lab.scenes.scene import FruitTruth, render, truth_of
from cucumbervision_lab.scenes.shading import Style, random_style, shade
from cucumbervision_lab.scenes.skin import Skin
from cucumbervision_lab.scenes.textures import Assets, load_assets

_BURST = 3
_VGA_SHARE = 0.5  # of the frames with depth
_AXIS_POINTS = 41
# The focal length of a D435's colour camera is 0.71 of its width.
_FOCAL_SHARE = (0.69, 0.73)
# Carrot, banana, aubergine, wood, steel, a black hose, a white pipe; sRGB.
_DECOYS = palette("e27828 e8c846 3e2242 967654 96989c 28282a e1e0da")


@dataclass(frozen=True)
class FrameOptions:
    """Options shared by all frames of a set.

    Parameters
    ----------
    width, height : int
        Size of the pictures, pixels.
    shares : tuple of float
        Probabilities of hanging, bench and crate scenes; their sum is 1.
    depth : bool
        Also simulate the depth of a D435.
    hard : bool
        Use `HARD` scenes instead of `PLAIN` ones.
    """

    width: int = 1280
    height: int = 720
    shares: tuple[float, float, float] = (0.6, 0.22, 0.18)
    depth: bool = True
    hard: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """A synthetic frame.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    camera : Intrinsics
        Intrinsics.
    staged : Composition
        The scene.
    truth : tuple of FruitTruth
        Ground truth of the cucumbers.
    exact_m : ndarray of float64, shape (H, W)
        Exact depth, metres; 0 for no object.
    depth_m : ndarray of float32, shape (H, W), optional
        Simulated depth of a D435 aligned to colour, fused from three frames, metres; 0 for no
        reading.
    """

    color: Pixels
    camera: Intrinsics
    staged: Composition
    truth: tuple[FruitTruth, ...]
    exact_m: Array
    depth_m: Array32 | None


def draw_frame(seed: int, index: int, options: FrameOptions, assets: Assets) -> Frame:
    """Render one frame of a set.

    Parameters
    ----------
    seed, index : int
        Seed of the set and index of the frame. A frame depends only on these and the options.
    options : FrameOptions
        Options of the set.
    assets : Assets
        Picture assets; may be empty.

    Returns
    -------
    Frame
        Frame with 0 to 12 cucumbers, or 0 to 18 for `hard`.
    """
    # Separate random streams, so that the colour picture does not depend on `depth`.
    streams = np.random.default_rng([seed, index]).spawn(3)
    rng, painter, sensor = streams
    camera = _camera(rng, options)
    setting = list(Setting)[int(rng.choice(3, p=options.shares))]
    staged = compose(rng, camera, setting, HARD if options.hard else PLAIN)
    view = render(staged.scene, camera)
    style = _style(painter, staged, assets)
    linear = shade(staged.scene, view, camera, style, assets, painter)
    truth = truth_of(staged.scene, camera, view)
    exposure = random_exposure(painter, options.width)
    color = expose(linear, exposure, painter)
    depth: Array32 | None = None
    if options.depth:
        sensor.normal()  # drawn by earlier versions, whose frames are the same
        size = VGA if sensor.random() < _VGA_SHARE else None
        burst = sense(staged.scene, D4xx.like(camera, size), sensor, _BURST)
        depth = fuse_burst([color] * _BURST, burst).depth_m
    return Frame(
        color,
        camera,
        staged,
        tuple(t for t, tube in zip(truth, staged.scene.fruit, strict=True) if not tube.is_decoy),
        view.depth_m,
        depth,
    )


def _camera(rng: Generator, options: FrameOptions) -> Intrinsics:
    focal = rng.uniform(*_FOCAL_SHARE) * max(options.width, options.height)
    centre = (
        options.width * (0.5 + rng.normal(0, 0.006)),
        options.height * (0.5 + rng.normal(0, 0.006)),
    )
    return Intrinsics(options.width, options.height, focal, focal, *centre)


def _style(rng: Generator, staged: Composition, assets: Assets) -> Style:
    style = random_style(rng, staged.scene, assets, staged.setting, up=staged.up)
    skins = (
        _decoy(rng, skin) if tube.is_decoy else skin
        for skin, tube in zip(style.skins, staged.scene.fruit, strict=True)
    )
    return replace(style, skins=tuple(skins))


def _decoy(rng: Generator, skin: Skin) -> Skin:
    """Return the skin of a decoy, an object with the shape of a cucumber."""
    color = np.array(_DECOYS[int(rng.integers(len(_DECOYS)))]) * rng.uniform(0.8, 1.1)
    red, green, blue = np.clip(color + rng.normal(0, 8, 3), 0, 255).tolist()
    base = (red, green, blue)
    return replace(skin, base=base, tip=base, stripe=base, warts_per_cm2=0.0, neck=0.1, texture=-1)


def extras_of(truth: FruitTruth) -> dict[str, Any]:
    """Return the metric ground truth of a fruit for `Label.extras`.

    Parameters
    ----------
    truth : FruitTruth
        Ground truth of the fruit.

    Returns
    -------
    dict
        `centreline_m`, `thread_m`, `chord_m`, `distance_m` (depth of the midpoint), `tilt_deg`
        (angle between chord and picture plane), and `axis_m` with `radius_m` at 41 evenly spaced
        points of the axis from the blossom end, camera coordinates.

    Examples
    --------
    >>> from cucumbervision_lab.scenes.scene import Scene, truth_of
    >>> from cucumbervision_lab.scenes.bodies import arc_tube
    >>> tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.5))
    >>> truth, = truth_of(Scene((tube,)), Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0))
    >>> extras = extras_of(truth)
    >>> extras["distance_m"], extras["tilt_deg"], len(extras["axis_m"])
    (0.5, 0.0, 41)
    """
    axis = truth.axis_m
    run = arc_positions(axis)
    shares = np.linspace(0.0, 1.0, _AXIS_POINTS)
    even = points_along(axis, shares)
    lean = np.degrees(np.arcsin((axis[-1, 2] - axis[0, 2]) / truth.chord_m))
    return {
        "centreline_m": round(truth.centreline_m, 6),
        "thread_m": round(truth.thread_m, 6),
        "chord_m": round(truth.chord_m, 6),
        "distance_m": round(float(even[_AXIS_POINTS // 2, 2]), 5),
        "tilt_deg": round(float(abs(lean)), 3),
        "axis_m": even.round(5).tolist(),
        "radius_m": np.interp(shares * run[-1], run, truth.radius_m).round(6).tolist(),
    }


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
        `frames.jsonl` (the labels of each frame) and `annotations.json`.
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
    jobs = {f"{index:06d}": index for index in range(options.frames)}
    draw = partial(_draw, options, out)
    rows = kept_rows(out / "frames.jsonl", jobs, draw, workers, progress)
    write_annotations(rows, ("cucumber",), out)
    return read_coco(out)


def _check_options(options: SynthOptions, out: Path) -> None:
    """Write the options to the folder, or check that they match the existing ones."""
    paths = {key: getattr(options, key) for key in ("assets", "paste", "onto")}
    folders = {key: "" if path is None else path.resolve().name for key, path in paths.items()}
    record = json.loads(json.dumps(asdict(options) | {"frames": None} | folders))
    file = out / _MANIFEST
    with wrap_os_errors("cannot be written", out, "choose another folder", DataSetError):
        if file.exists() and read_json(file, DataSetError, "delete it to resume") != record:
            raise DataSetError(
                "contains a set with other options",
                source=out,
                remedy="use the same options to resume, or another folder",
            )
        for name in ("images", *(("depth", "exact") if options.frame.depth else ())):
            (out / name).mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


_assets = lru_cache(maxsize=1)(load_assets)


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


def _paste_onto(
    options: SynthOptions, onto: Path, paste: Path, out: Path, index: int
) -> LabelledPicture:
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
    return picture


def _draw(options: SynthOptions, out: Path, index: int) -> list[dict[str, Any]]:
    if options.onto is not None and options.paste is not None:
        return [coco_entries(_paste_onto(options, options.onto, options.paste, out, index))]
    frame = draw_frame(options.seed, index, options.frame, _assets(options.assets))
    name = f"{index:06d}"
    split = options.split or _SPLIT_OF[index % len(_SPLIT_OF)]
    picture = label_frame(frame, name, f"synth-{options.seed}-{name}", split)
    write_jpeg(out / "images" / f"{name}.jpg", frame.color, _QUALITY)
    if frame.depth_m is not None:
        write_png(out / "depth" / f"{name}.png", _steps(frame.depth_m, _DEPTH_UNIT_M))
        write_png(out / "exact" / f"{name}.png", _steps(frame.exact_m, _EXACT_UNIT_M))
    return [coco_entries(picture)]


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
            "gravity": [round(-float(component), 4) for component in frame.staged.up],
        },
    )
