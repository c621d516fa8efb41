"""The curve of a training: what its network finds on pictures that nobody trained on.

It is judged by what is shipped: the exported network, with the runtime and the merging that a user
has. Nothing is chosen by it.
"""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path

from cucumbervision.capture.pictures import read_color
from cucumbervision_lab.detection.average_precision import Judged, average_precision
from cucumbervision_lab.detection.photos import Photo, audited_photos, evaluate_photos
from cucumbervision_lab.detection.picture_result import Networks, detect_picture, open_networks
from cucumbervision_lab.detection.pictures import Stage, frame_of, read_held_out
from cucumbervision_lab.detection.run import chosen_networks
from cucumbervision_lab.training.export import export_yolo
from cucumbervision_lab.training.tables import read_rows, write_rows

_DRAWN = ("photos all", "half all: recall", "drawn")  # of the columns, as lines
_FRAMES = 40


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
            Recall and precision on photos, by test and at half the size, at the confidence that
            is asked by default; mAP on drawn frames: of boxes and masks, or of boxes and points.
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

    def _networks(self, onnx: Path, *, ranked: bool) -> Networks:
        """Load a checkpoint: a detector beside the pose network in use, a pose network alone."""
        pair = chosen_networks(onnx, None) if self.task == "seg" else (None, onnx)
        return open_networks(*pair, None, ranked=ranked)

    @cached_property
    def _audited(self) -> list[Photo]:
        return audited_photos(self._photos)[0]

    def _on_photos(self, onnx: Path) -> dict[str, float]:
        found = evaluate_photos(self._audited, self._networks(onnx, ranked=False))
        point = {}
        for words, scores in (("photos", found.scores[:1] + found.tests), ("half", found.small)):
            for name, score in scores:
                head = f"{words} {name}"
                for what, one in (("recall", score.recall), ("precision", score.precision)):
                    point[f"{head}: {what}"] = math.nan if one is None else one.value
        return point

    def _on_drawn(self, onnx: Path) -> dict[str, float]:
        if self._drawn is None:
            return {}
        networks = self._networks(onnx, ranked=True)
        held_out = read_held_out(self._drawn, "test", _FRAMES)
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
            "drawn_map50": boxes.map50,
            "drawn_map50_95": boxes.map50_95,
            "drawn_masks_map50_95" if seg else "drawn_points_map50_95": other.map50_95,
        }


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
    keys = dict.fromkeys(key for row in rows for key in row)
    names = [key for key in keys if key.startswith(_DRAWN)]
    for name in names:
        axes.plot(seen, [float(row.get(name) or "nan") for row in rows], marker=".", label=name)
    axes.set(xlabel="pictures seen, thousands", ylabel="share", ylim=(0, 1))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")
    figure.savefig(out, dpi=120)
