"""What perceived masks cost in length: the whole pipeline beside the true masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.accuracy.records import Masks, Record, Suite
from cucumbervision.accuracy.statistics import score
from cucumbervision.accuracy.tables import Truth, methods_against, readings, truth_m
from cucumbervision.measurement.result import Method
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask, decode_rle
from cucumbervision_lab.benchmark.measure_case import fruit_lengths
from cucumbervision_lab.detection.estimates import Estimate, estimate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.accuracy.statistics import Metrics
    from cucumbervision.capture.frames import Capture
    from cucumbervision_lab.detection.pictures import Frame

__all__ = ["GROUPS", "LengthScore", "group_of", "length_records", "length_scores"]

GROUPS = ("whole, in sight", "whole, partly hidden", "cut by the picture's edge")
_IN_SIGHT = 0.10
_READ = (*Method, "M6 thread", "M6 chord", "selector best", "selector paper")


@dataclass(frozen=True)
class LengthScore:
    """One method's errors on one group of fruit.

    Parameters
    ----------
    group : str
        One of `GROUPS`, or 'whole'.
    masks : Masks
        Whose masks.
    truth : Truth
        Which true length.
    method : str
        Its name in `Record.lengths_m`.
    missed : int
        Fruit that the detector did not find.
    metrics : Metrics
        Its errors, what was missed or not measured counting as 100 %.
    error_percent : Estimate
        Mean absolute error, the same, with its interval by scene.
    measured_percent : Estimate
        Mean absolute error of what was measured.
    """

    group: str
    masks: Masks
    truth: Truth
    method: str
    missed: int
    metrics: Metrics
    error_percent: Estimate
    measured_percent: Estimate


def length_records(
    frame: Frame, capture: Capture, perceived: Mapping[int, Instance]
) -> list[Record]:
    """Measure a picture's fruit on their true masks and on perceived ones.

    Parameters
    ----------
    frame : Frame
        Its truth.
    capture : Capture
        Its colour and depth.
    perceived : mapping of int to Instance
        What was found of each fruit, by its place in `frame.true`, with SAM's mask and keypoints.

    Returns
    -------
    list of Record
        Two for each fruit that is to be found and whose lengths are known. A fruit that was
        missed has a perceived record without any length.
    """
    records = []
    for number, fruit in enumerate(frame.true):
        if not fruit.required or fruit.code is None or fruit.centreline_m is None:
            continue
        found = perceived.get(number)
        records.append(_record(frame, number, capture, _true_instance(frame, number), Masks.EXACT))
        records.append(_record(frame, number, capture, found, Masks.PERCEIVED))
    return records


def _true_instance(frame: Frame, number: int) -> Instance:
    fruit = frame.true[number]
    code = fruit.code or {}
    mask = decode_rle(code["counts"], *code["size"])
    points = None
    if fruit.keypoints is not None:
        points = np.column_stack([fruit.keypoints[:, :2], fruit.keypoints[:, 2] == 2])
    return Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET, keypoints=points)


def _record(
    frame: Frame, number: int, capture: Capture, instance: Instance | None, masks: Masks
) -> Record:
    fruit = frame.true[number]
    lengths: dict[str, float | None] = dict.fromkeys(map(str, _READ))
    details: dict[str, Any] = {"scene": frame.scene, "missed": instance is None}
    details["cut_off"] = bool(fruit.cut_off)
    if instance is not None:
        measured = measure_fruit(capture, instance)
        lengths.update(fruit_lengths(measured, capture)[0])
        details["selected"] = str(measured.selected.method) if measured.selected else None
        details["flags"] = list(measured.flags)
    return Record(
        case=f"{frame.name}#{number}",
        suite=Suite.OWN,
        masks=masks,
        fruit=f"{frame.name}#{number}",
        centreline_m=fruit.centreline_m,
        thread_m=fruit.thread_m,
        chord_m=fruit.chord_m,
        distance_m=fruit.distance_m,
        tilt_deg=float("nan"),
        bend_radius_m=None,
        hidden_share=fruit.hidden_share,
        fill=float("nan"),
        lengths_m=lengths,
        details=details,
    )


def group_of(record: Record) -> str:
    """Say which of `GROUPS` a fruit belongs to; one of unknown hidden share is in sight."""
    if record.details.get("cut_off"):
        return GROUPS[2]
    return GROUPS[1] if record.hidden_share > _IN_SIGHT else GROUPS[0]


def length_scores(records: Sequence[Record], truth: Truth) -> list[LengthScore]:
    """Score every method by group of fruit and kind of masks.

    Parameters
    ----------
    records : sequence of Record
        From `length_records`.
    truth : Truth
        What to hold them against.
    """
    scores = []
    for group in ("whole", *GROUPS):
        for masks in (Masks.EXACT, Masks.PERCEIVED):
            some = [
                r
                for r in records
                if r.masks is masks
                and truth_m(r, truth) is not None
                and (group_of(r) == group or (group == "whole" and group_of(r) != GROUPS[2]))
            ]
            scores += [_score(some, group, masks, truth, m) for m in methods_against(some, truth)]
    return scores


def _score(
    records: Sequence[Record], group: str, masks: Masks, truth: Truth, method: str
) -> LengthScore:
    read = readings(records, method, truth)
    percent = read.errors_percent
    scenes = [str(r.details["scene"]) for r in records]
    known = np.isfinite(read.lengths_m)
    return LengthScore(
        group,
        masks,
        truth,
        method,
        sum(bool(r.details["missed"]) for r in records),
        score(read.lengths_m, read.truth_m),
        estimate(percent, scenes),
        estimate(percent[known], [s for s, k in zip(scenes, known, strict=True) if k]),
    )
