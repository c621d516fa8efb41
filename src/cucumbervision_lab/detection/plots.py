"""The evaluation's pictures, as PNG bytes: plots, and the worst cases of drawn scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.files import read_color
from cucumbervision.perception.mask_codes import decode_rle
from cucumbervision_lab.detection.outcomes import matches_of
from cucumbervision_lab.detection.pictures import DRAWN, Stage
from cucumbervision_lab.report.plots import as_png, new_figure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from cucumbervision.accuracy.statistics import Estimate
    from cucumbervision_lab.detection.figures import Summary
    from cucumbervision_lab.detection.outcomes import EndRow, GroupScore
    from cucumbervision_lab.detection.picture_result import OverlapRow
    from cucumbervision_lab.detection.pictures import Code, Frame
    from cucumbervision_lab.detection.run import DetectionResult

_BLUE, _ORANGE, _GREEN = "#0072B2", "#D55E00", "#009E73"

_LEAST_PERCENT = 0.05


def recall_plot(groups: Sequence[GroupScore]) -> bytes:
    """Plot recall and precision against each factor that has a scale, with 95 % by scene.

    Parameters
    ----------
    groups : sequence of GroupScore
        Of any factors.
    """
    scaled = [one for one in groups if math.isfinite(one.middle)]
    factors = list(dict.fromkeys(one.factor for one in scaled))
    figure = new_figure(3.6)
    axes = figure.subplots(1, max(len(factors), 1), sharey=True, squeeze=False)[0]
    for ax, factor in zip(axes, factors, strict=False):
        own = [one for one in scaled if one.factor == factor]
        scale = 100.0 if "%" in factor else 1.0
        where = np.array([scale * one.middle for one in own])
        parts: list[tuple[str, str, str, list[Estimate | None]]] = [
            ("recall", _BLUE, "o", [one.recall for one in own]),
            ("precision", _ORANGE, "s", [one.precision for one in own]),
        ]
        for label, colour, marker, estimates in parts:
            known = [
                (x, e) for x, e in zip(where, estimates, strict=True) if e is not None and e.count
            ]
            if not known:
                continue
            x = [one[0] for one in known]
            y = np.array([one[1].value for one in known])
            low = y - np.nan_to_num([e.low for _, e in known], nan=1.0)
            high = np.nan_to_num([e.high for _, e in known], nan=0.0) - y
            bars = np.maximum([low, high], 0)
            ax.errorbar(x, y, bars, color=colour, marker=marker, capsize=3, label=label)
        ax.set_xlabel(factor)
        ax.set_ylim(-0.02, 1.02)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("share")
    if factors:
        axes[0].legend(fontsize=9, loc="lower left")
    return as_png(figure)


def end_error_plot(rows: Sequence[EndRow]) -> bytes:
    """Plot how many ends have at most which error, those in sight and those hidden.

    Parameters
    ----------
    rows : sequence of EndRow
        At least one.
    """
    ends = [(r.blossom_percent, r.blossom_seen) for r in rows]
    ends += [(r.stem_percent, r.stem_seen) for r in rows]
    figure = new_figure(3.6)
    ax = figure.subplots()
    for label, colour, seen in (("in sight", _BLUE, True), ("hidden", _ORANGE, False)):
        errors = np.sort([e for e, s in ends if s is seen and math.isfinite(e)])
        if errors.size:
            share = 100 * np.arange(1, len(errors) + 1) / len(errors)
            name = f"{label} (n = {len(errors)})"
            ax.step(np.maximum(errors, _LEAST_PERCENT), share, color=colour, label=name)
    for limit, style in ((2.0, ":"), (6.0, "--")):
        ax.axvline(limit, color="black", linewidth=0.8, linestyle=style)
    ax.set_xscale("log")
    ticks = [0.1, 0.5, 1, 2, 6, 10, 50, 100]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_xlabel("distance from the true end (% of the fruit's length in the picture)")
    ax.set_ylabel("ends with at most that error (%)")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9)
    return as_png(figure)


def overlap_plot(rows: Sequence[OverlapRow]) -> bytes:
    """Plot how many masks have at least which overlap: the network's own and SAM's two.

    Parameters
    ----------
    rows : sequence of OverlapRow
        At least one, of drawn or of real pictures.
    """
    kinds = {
        "network alone": ([r.network_iou for r in rows], _GREEN, ":"),
        "SAM, box": ([r.box_iou for r in rows], _BLUE, "--"),
        "SAM, box + centre": ([r.point_iou for r in rows], _ORANGE, "-"),
    }
    figure = new_figure(3.6)
    ax = figure.subplots()
    for name, (values, colour, line) in kinds.items():
        known = np.sort([v for v in values if math.isfinite(v)])
        if known.size:
            share = 100 * (len(known) - np.arange(len(known))) / len(known)
            label = f"{name} (n = {len(known)})"
            ax.step(known, share, color=colour, linestyle=line, label=label, where="post")
    ax.set_xlim(0.5, 1.0)
    ax.set_xlabel("intersection over union with the true mask")
    ax.set_ylabel("masks with at least that (%)")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9, loc="lower left")
    return as_png(figure)


KINDS = {
    "missed": "Fruit that nobody found, the largest and least hidden first.",
    "false": "Detections of what is no cucumber, the surest first.",
    "masks": "Fruit found, with the least overlap of the network's own mask.",
    "keypoints": "Fruit found, with the ends set off furthest.",
}
"""Which worst cases there are, and in which order."""

_TILE_PX = (240, 320)  # height, width

COLUMNS, _MOST = 4, 8

_MARGIN = 0.35

_STRIP_PX = 20

# Okabe and Ito's green and vermilion (RGB).
_TRUE_COLOR, _FOUND_COLOR = (0, 200, 140), (255, 110, 0)


@dataclass(frozen=True)
class WorstCase:
    """One of the worst.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    picture : str
        Its file in the set.
    box : tuple of float
        What to look at, pixels.
    words : str
        What is wrong.
    """

    kind: str
    picture: str
    box: tuple[float, float, float, float]
    words: str


def worst_cases(result: DetectionResult, summary: Summary) -> list[WorstCase]:
    """Return the worst cases of drawn pictures, at most eight of each kind.

    Parameters
    ----------
    result : DetectionResult
        What was seen.
    summary : Summary
        Its figures.
    """
    drawn = {p.file for p in result.held_out.pictures if p.source == DRAWN}
    boxes = {
        (f.name, k): _edges(fruit.box) for f in result.frames for k, fruit in enumerate(f.true)
    }
    fruit = [r for r in summary.fruit if r.picture in drawn]
    missed = sorted(
        (r for r in fruit if not r.found),
        key=lambda r: -r.long_px * (1 - np.nan_to_num(r.hidden_share)),
    )
    cases = [
        ("missed", r.picture, boxes[r.picture, r.fruit], f"{_percent(r.hidden_share)} hidden")
        for r in missed[:_MOST]
    ]
    false = sorted(
        (r for r in summary.found if r.outcome == "false" and r.picture in drawn),
        key=lambda r: -r.score,
    )
    cases += [
        ("false", r.picture, (r.x1, r.y1, r.x2, r.y2), f"confidence {r.score:.2f}")
        for r in false[:_MOST]
    ]
    masks = sorted((r for r in fruit if math.isfinite(r.mask_iou)), key=lambda r: r.mask_iou)
    cases += [
        ("masks", r.picture, boxes[r.picture, r.fruit], f"IoU {r.mask_iou:.2f}")
        for r in masks[:_MOST]
    ]
    ends = [
        (float(np.nanmax([r.blossom_percent, r.stem_percent])), r)
        for r in summary.end_rows
        if r.picture in drawn and np.isfinite([r.blossom_percent, r.stem_percent]).any()
    ]
    cases += [
        (
            "keypoints",
            r.picture,
            boxes[r.picture, r.fruit],
            f"off by {off:.0f} %" + (", swapped" if r.swapped else ""),
        )
        for off, r in sorted(ends, key=lambda one: -one[0])[:_MOST]
    ]
    return [WorstCase(*case) for case in cases]


def draw_sheet(cases: Sequence[WorstCase], result: DetectionResult) -> bytes:
    """Draw cases side by side: truth in green, what was found in orange.

    Parameters
    ----------
    cases : sequence of WorstCase
        Of drawn pictures, at least one.
    result : DetectionResult
        What was seen.

    Returns
    -------
    bytes
        A PNG.

    Raises
    ------
    ValueError
        If a picture is not a drawn one.
    """
    pictures = {p.file: p for p in result.held_out.pictures}
    frames = {f.name: f for f in result.frames}
    height, width = _TILE_PX
    rows = -(-len(cases) // COLUMNS)
    sheet = np.full((rows * (height + 4), min(len(cases), COLUMNS) * (width + 4), 3), 255, np.uint8)
    for k, case in enumerate(cases):
        if pictures[case.picture].source != DRAWN:
            raise ValueError(f"{case.picture} is no drawn picture")
        color = read_color(result.held_out.data.path(pictures[case.picture]))
        tile = _tile(color, frames[case.picture], case, result.plan.confidence)
        top, left = (k // COLUMNS) * (height + 4), (k % COLUMNS) * (width + 4)
        sheet[top : top + height, left : left + width] = tile
    _, data = cv2.imencode(".png", np.ascontiguousarray(sheet[..., ::-1]))
    return bytes(data)


def _tile(
    color: NDArray[np.uint8], frame: Frame, case: WorstCase, confidence: float
) -> NDArray[np.uint8]:
    height, width = _TILE_PX
    x1, y1, x2, y2 = case.box
    scale = min(width / ((1 + 2 * _MARGIN) * (x2 - x1)), height / ((1 + 2 * _MARGIN) * (y2 - y1)))
    scale = min(scale, 4.0)
    shift = np.array([width, height]) / 2 - scale * np.array([x1 + x2, y1 + y2]) / 2
    move = np.column_stack([np.eye(2) * scale, shift])
    smooth = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    grey = (220, 220, 220)
    moved = cv2.warpAffine(color, move, (width, height), flags=smooth, borderValue=grey)
    tile = np.asarray(moved, np.uint8)

    def place(points: NDArray[np.float64]) -> NDArray[np.int32]:
        return np.rint(points * scale + shift).astype(np.int32)

    stage = Stage.POSED if case.kind == "keypoints" else Stage.KEPT
    _, seen, required = matches_of(frame, confidence, stage)
    true = [frame.true[k] for k in required]
    _outlines(tile, (one.code for one in true), place, _TRUE_COLOR)
    _outlines(tile, (one.code for one in seen), place, _FOUND_COLOR)
    for one in seen:
        if one.code is None:
            corners = place(one.box.reshape(2, 2)).tolist()
            cv2.rectangle(tile, tuple(corners[0]), tuple(corners[1]), _FOUND_COLOR, 1)
    if case.kind == "keypoints":
        _points(tile, [one.keypoints for one in true], place, _TRUE_COLOR)
        _points(tile, [one.keypoints for one in seen], place, _FOUND_COLOR)
    label = f"{case.picture.rsplit('/', 1)[-1]}: {case.words}"
    tile[height - _STRIP_PX :] = 0
    at, ink = (6, height - 6), (255, 255, 255)
    cv2.putText(tile, label, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, ink, 1, cv2.LINE_AA)
    return tile


def _outlines(
    tile: NDArray[np.uint8],
    codes: Iterable[Code | None],
    place: Callable[[NDArray[np.float64]], NDArray[np.int32]],
    ink: tuple[int, int, int],
) -> None:
    for code in codes:
        if code is None:
            continue
        mask = decode_rle(code["counts"], *code["size"]).astype(np.uint8)
        found, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        lines = [place(np.asarray(one[:, 0], np.float64)) for one in found]
        cv2.polylines(tile, lines, True, ink, 1, cv2.LINE_AA)


def _points(
    tile: NDArray[np.uint8],
    keypoints: Iterable[NDArray[np.float64] | None],
    place: Callable[[NDArray[np.float64]], NDArray[np.int32]],
    ink: tuple[int, int, int],
) -> None:
    for points in keypoints:
        if points is None:
            continue
        for k, at in enumerate(place(points[:, :2]).tolist()):
            # The blossom end is filled, so that swapped ends show.
            cv2.circle(tile, tuple(at), 4, ink, -1 if k == 0 else 1, cv2.LINE_AA)


def _edges(box: NDArray[np.float64]) -> tuple[float, float, float, float]:
    x1, y1, x2, y2 = (float(edge) for edge in box)
    return x1, y1, x2, y2


def _percent(share: float) -> str:
    return "unknown share" if math.isnan(share) else f"{100 * share:.0f} %"
