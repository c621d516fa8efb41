"""The curve of a training: what its network finds on pictures that nobody trained on.

It is judged by what is shipped: the exported network, with the runtime and the merging that a user
has. Nothing is chosen by it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision.capture.files import read_color
from cucumbervision_lab.detection.average_precision import Judged, average_precision
from cucumbervision_lab.detection.groups import overall
from cucumbervision_lab.detection.outcomes import found_rows, fruit_rows
from cucumbervision_lab.detection.picture_result import Networks, detect_picture, open_networks
from cucumbervision_lab.detection.pictures import Stage
from cucumbervision_lab.detection.truth import frame_of, read_held_out
from cucumbervision_lab.training.export_yolo import export_yolo
from cucumbervision_lab.training.tables import read_rows, write_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_lab.detection.pictures import Frame

__all__ = ["Curve", "draw_curve", "halved"]

CONFIDENCE = 0.30
FRAMES = 40


class Curve:
    """Judges a network again and again and keeps the points.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    photos : Path
        Folder of the audited photos; those of test scenes are judged.
    drawn : Path, optional
        A drawn set; 40 pictures of its test split are judged.
    run : Path
        Gets `curve.csv` and `curve.png`.
    """

    def __init__(self, task: str, photos: Path, drawn: Path | None, run: Path) -> None:
        self.task, self.run = task, run
        self._photos, self._drawn = photos, drawn

    def judge(self, network: Path, pictures: int) -> dict[str, float]:
        """Judge a checkpoint and add it to the curve.

        Parameters
        ----------
        network : Path
            A checkpoint (.pt).
        pictures : int
            That it has seen.

        Returns
        -------
        dict of str to float
            Recall and precision at a confidence of 0.30 on photos, recall on the photos at half
            the size, and mAP on drawn frames: of boxes and masks, or of boxes and points.
        """
        onnx = export_yolo(network, self.run / "curve.onnx", dynamic=True, half=True)
        point = self._on_photos(onnx) | self._on_drawn(onnx)
        rows = [
            row for row in read_rows(self.run / "curve.csv") if int(row["pictures"]) != pictures
        ]
        rows.append({"pictures": pictures, **{k: f"{v:.4f}" for k, v in point.items()}})
        rows.sort(key=lambda row: int(row["pictures"]))
        write_rows(self.run / "curve.csv", rows)
        draw_curve(self.run / "curve.csv", self.run / "curve.png")
        return point

    def _networks(self, onnx: Path, floor: float) -> Networks:
        seg = self.task == "seg"
        return open_networks(onnx if seg else None, None if seg else onnx, None, floor=floor)

    @cached_property
    def _audited(self) -> list[Any]:
        from cucumbervision_lab.detection.photos import audited_photos

        return audited_photos(self._photos)[0]

    def _on_photos(self, onnx: Path) -> dict[str, float]:
        networks = self._networks(onnx, CONFIDENCE)
        whole, small = [], []
        for photo in self._audited:
            color = read_color(photo.path)
            whole.append(detect_picture(photo.truth, color, networks).frame)
            if any(not one.ignore for one in photo.truth.true):
                small.append(detect_picture(*halved(photo.truth, color), networks).frame)

        def score(frames: list[Frame]) -> tuple[float, ...]:
            one = overall(fruit_rows(frames, CONFIDENCE), found_rows(frames, CONFIDENCE))
            return tuple(math.nan if x is None else x.value for x in (one.recall, one.precision))

        (recall, precision), (half, _) = score(whole), score(small)
        return {"photos_recall": recall, "photos_precision": precision, "half_recall": half}

    def _on_drawn(self, onnx: Path) -> dict[str, float]:
        if self._drawn is None:
            return {}
        networks = self._networks(onnx, 0.001)
        held_out = read_held_out(self._drawn, "test", FRAMES)
        frames = []
        for picture in held_out.pictures:
            color = read_color(held_out.data.path(picture))
            frames.append(
                detect_picture(frame_of(picture, held_out.data, None), color, networks).frame
            )
        seg = self.task == "seg"
        stage = Stage.SEGMENTED if seg else Stage.POSED
        boxes = average_precision(frames, Judged.BOXES, stage)
        other = average_precision(frames, Judged.MASKS if seg else Judged.KEYPOINTS, stage)
        return {
            "drawn_map50": boxes.at_50.value,
            "drawn_map50_95": boxes.at_50_95.value,
            "drawn_masks_map50_95" if seg else "drawn_points_map50_95": other.at_50_95.value,
        }


def halved(truth: Frame, color: NDArray[np.uint8]) -> tuple[Frame, NDArray[np.uint8]]:
    """Give a photo in the middle of a grey one of its size, at half of it.

    A detector brings every picture to its own size; the grey keeps fruit small.

    Parameters
    ----------
    truth : Frame
        Its boxes.
    color : ndarray of uint8, shape (H, W, 3)
        RGB.

    Returns
    -------
    truth : Frame
        The same boxes in the new picture.
    color : ndarray of uint8, shape (H, W, 3)
        RGB.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision_lab.detection.pictures import Frame, TrueFruit
    >>> photo = Frame("a.jpg", "s", 8, 4, (TrueFruit(np.array([-0.5, -0.5, 3.5, 1.5])),))
    >>> small, color = halved(photo, np.zeros((4, 8, 3), np.uint8))
    >>> small.true[0].box.tolist(), color.shape, int((color == 0).all(axis=2).sum())
    ([1.5, 0.5, 3.5, 1.5], (4, 8, 3), 8)
    """
    height, width = color.shape[:2]
    size = width // 2, height // 2
    x, y = (width - size[0]) // 2, (height - size[1]) // 2
    sheet = np.full_like(color, 114)
    sheet[y : y + size[1], x : x + size[0]] = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    scale = np.array([size[0] / width, size[1] / height] * 2)
    shift = np.array([x, y, x, y])
    true = tuple(
        replace(one, box=(one.box + 0.5) * scale + shift - 0.5, code=None) for one in truth.true
    )
    return replace(truth, true=true), sheet


def draw_curve(table: Path, out: Path) -> None:
    """Draw the curve's CSV file as a PNG.

    Parameters
    ----------
    table : Path
        `curve.csv`.
    out : Path
        The file to write; nothing is written where matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return
    rows = read_rows(table)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    seen = [int(row["pictures"]) / 1000 for row in rows]
    names = [key for key in dict.fromkeys(k for row in rows for k in row) if key != "pictures"]
    for name in names:
        axes.plot(seen, [float(row.get(name) or "nan") for row in rows], marker=".", label=name)
    axes.set(xlabel="pictures seen, thousands", ylabel="share", ylim=(0, 1))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")
    figure.savefig(out, dpi=120)
