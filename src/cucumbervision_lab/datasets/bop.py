"""Data sets as BOP scenes: `rgb/`, `depth/`, `mask/`, `mask_visib/` and three JSON files.

Format: the BOP benchmark (Hodaň et al. 2018), `docs/bop_datasets_format.md` of the BOP toolkit.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.files import read_depth, write_png
from cucumbervision.errors import DataSetError
from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.datasets.labels import place_file, write_text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture


def write_bop(
    dataset: DataSet,
    out: Path,
    *,
    link: bool = True,
    progress: Callable[[int], None] | None = None,
) -> tuple[Path, ...]:
    """Write a set as BOP scenes, one a split: `out/train/000000`, `out/all/000000` without split.

    Parameters
    ----------
    dataset : DataSet
        Every picture with depth and a camera without distortion, every fruit with a mask.
    out : Path
        Made if it does not exist.
    link : bool
        Pictures become second names of the same files where the disk can; else copies.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    tuple of Path
        The scenes' folders.

    Raises
    ------
    DataSetError
        If a picture lacks depth or camera, a fruit its mask, or the folder cannot be written.
    CaptureError
        If a depth picture cannot be read.

    Notes
    -----
    A fruit's pose is that of its axis, where `extras['axis_m']` gives it: the origin at the
    axis' middle, x towards the stem end. Elsewhere `scene_gt.json` names the class alone, which
    is enough for masks. Labels to ignore are left out. Where no amodal mask is known, the
    visible one stands for it.
    """
    _require(dataset)
    scenes = []
    for split in dict.fromkeys(p.split for p in dataset.pictures):
        scene = out / (split or "all") / "000000"
        _write_scene(dataset, dataset.in_split(split), scene, link, progress)
        scenes.append(scene)
    return tuple(scenes)


def _require(dataset: DataSet) -> None:
    for fault, bad in {
        "have no depth": [p for p in dataset.pictures if p.depth_file is None],
        "have no camera": [p for p in dataset.pictures if p.camera is None],
        "have a lens distortion, which BOP cannot state": [
            p for p in dataset.pictures if p.camera is not None and any(p.camera.coefficients)
        ],
        "have a fruit without mask": [
            p for p in dataset.pictures if any(x.mask_code is None for x in _fruit(p))
        ],
    }.items():
        if bad:
            raise DataSetError(
                f"{len(bad)} pictures {fault}, first {bad[0].file}",
                source=dataset.folder,
                remedy="leave them out",
            )


def _fruit(picture: LabelledPicture) -> list[Label]:
    return [label for label in picture.labels if not label.ignore]


def _write_scene(
    dataset: DataSet,
    pictures: Sequence[LabelledPicture],
    scene: Path,
    link: bool,
    progress: Callable[[int], None] | None,
) -> None:
    cameras: dict[str, Any] = {}
    truths: dict[str, Any] = {}
    infos: dict[str, Any] = {}
    for kind in ("mask", "mask_visib"):
        (scene / kind).mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures):
        camera, depth_file = picture.camera, picture.depth_file
        if camera is None or depth_file is None:  # `_require` has refused these
            continue
        name, source = f"{number:06d}", dataset.path(picture)
        place_file(source, scene / f"rgb/{name}{source.suffix.lower()}", link=link)
        depth = dataset.folder / depth_file
        place_file(depth, scene / f"depth/{name}{depth.suffix}", link=link)
        cameras[str(number)] = {
            "cam_K": camera.matrix.ravel().tolist(),
            # Times the stored number it is millimetres.
            "depth_scale": round(picture.depth_unit_m * 1000, 9),
        }
        known = np.asarray(read_depth(depth)) > 0
        rows = [
            _write_fruit(x, scene, f"{name}_{k:06d}.png", known)
            for k, x in enumerate(_fruit(picture))
        ]
        truths[str(number)] = [row[0] for row in rows]
        infos[str(number)] = [row[1] for row in rows]
        if progress is not None:
            progress(1)
    for file, data in {
        "scene_gt": truths,
        "scene_gt_info": infos,
        "scene_camera": cameras,
    }.items():
        write_text(scene / f"{file}.json", json.dumps(data, indent=1) + "\n")


def _write_fruit(
    label: Label, scene: Path, name: str, known: NDArray[np.bool_]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write a fruit's masks; give its entries of scene_gt and scene_gt_info."""
    visible = label.mask
    if visible is None:
        raise DataSetError("a fruit has no mask", source=scene / name, remedy="leave it out")
    whole = visible if label.amodal is None else label.amodal | visible
    write_png(scene / "mask_visib" / name, visible.astype(np.uint8) * 255)
    write_png(scene / "mask" / name, whole.astype(np.uint8) * 255)
    counts = [int(np.count_nonzero(m)) for m in (whole, whole & known, visible)]
    info = {
        "bbox_obj": _bop_box(whole),
        "bbox_visib": _bop_box(visible),
        "px_count_all": counts[0],
        "px_count_valid": counts[1],
        "px_count_visib": counts[2],
        "visib_fract": round(counts[2] / counts[0], 6) if counts[0] else 0.0,
    }
    return {"obj_id": label.category + 1, **_pose(label)}, info


def _bop_box(mask: NDArray[np.bool_]) -> list[int]:
    """Return x, y of the first pixel and the box's width and height; -1 for an empty mask."""
    if not mask.any():
        return [-1, -1, -1, -1]
    x1, y1, x2, y2 = box_of_mask(mask)
    return [int(x1 + 0.5), int(y1 + 0.5), int(x2 - x1), int(y2 - y1)]


def _pose(label: Label) -> dict[str, Any]:
    """Return rotation (row by row) and translation (mm) of the axis, where it is known."""
    axis = np.array(label.extras.get("axis_m", ()), np.float64)
    if axis.ndim != 2 or axis.shape[1] != 3 or len(axis) < 2:
        return {}
    along = axis[-1] - axis[0]
    length = float(np.linalg.norm(along))
    if length == 0:
        return {}
    x = along / length
    # Any second axis will do for a round body; the one farthest from the first is well defined.
    y = np.cross(np.eye(3)[np.abs(x).argmin()], x)
    y /= np.linalg.norm(y)
    rotation = np.stack([x, y, np.cross(x, y)], axis=1)
    middle = axis[len(axis) // 2] if len(axis) % 2 else axis[len(axis) // 2 - 1 :][:2].mean(axis=0)
    return {
        "cam_R_m2c": rotation.ravel().round(9).tolist(),
        "cam_t_m2c": (1000 * middle).round(4).tolist(),
    }
