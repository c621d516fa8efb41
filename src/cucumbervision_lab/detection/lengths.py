"""Lengths on perceived masks beside those on true masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.accuracy.statistics import Estimate, estimate, score
from cucumbervision.measurement.result import LengthDefinition, Method
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.mask_codes import decode_rle
from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.benchmark.measure_case import fruit_lengths, noted
from cucumbervision_lab.report.length_tables import against
from cucumbervision_lab.report.records import LengthRecord, Masks

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from cucumbervision.accuracy.statistics import Metrics
    from cucumbervision.capture.frames import Capture
    from cucumbervision_lab.detection.pictures import Frame, TrueFruit

_GROUPS = ("whole, in sight", "whole, partly hidden", "cut by the picture's edge")
_IN_SIGHT = 0.10
_READ = (*Method, "M6 thread", "M6 chord", "selector best", "selector paper")


@dataclass(frozen=True)
class LengthScore:
    """One method's errors on one group of fruit.

    Parameters
    ----------
    group : str
        One of `_GROUPS`, or 'whole'.
    masks : Masks
        Whose masks.
    truth : LengthDefinition
        Which true length.
    method : str
        Its name in `LengthRecord.lengths_m`.
    missed : int
        Fruit that the detector did not find.
    metrics : Metrics
        Its errors, what was missed or not measured counting as 100 %.
    error_percent : Estimate
        Mean absolute error, the same, with its interval by scene.
    error_of_measured_percent : Estimate
        Mean absolute error of what was measured.
    """

    group: str
    masks: Masks
    truth: LengthDefinition
    method: str
    missed: int
    metrics: Metrics
    error_percent: Estimate
    error_of_measured_percent: Estimate


def length_records(
    frame: Frame, capture: Capture, perceived: Mapping[int, Instance]
) -> list[LengthRecord]:
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
    list of LengthRecord
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
) -> LengthRecord:
    fruit = frame.true[number]
    lengths: dict[str, float | None] = dict.fromkeys(map(str, _READ))
    details: dict[str, Any] = {"scene": frame.scene, "missed": instance is None}
    details |= {"cut_off": bool(fruit.cut_off), "group": _group_of(fruit)}
    details["selected"] = None
    fill = None
    if instance is not None:
        measured = measure_fruit(capture, instance)
        lengths.update(fruit_lengths(measured, capture)[0])
        details["selected"] = str(measured.selected.method) if measured.selected else None
        details["flags"] = list(measured.flags)
        details |= noted(measured)
        fill = measured.fill
    return LengthRecord(
        case=f"{frame.name}#{number}",
        suite="detection",
        masks=masks,
        fruit=f"{frame.name}#{number}",
        centreline_m=fruit.centreline_m,
        thread_m=fruit.thread_m,
        chord_m=fruit.chord_m,
        distance_m=fruit.distance_m,
        tilt_deg=float("nan"),
        bend_radius_m=None,
        hidden_share=fruit.hidden_share,
        fill=float("nan") if fill is None else fill,
        lengths_m=lengths,
        details=details,
    )


def _group_of(fruit: TrueFruit) -> str:
    """Return which of `_GROUPS` a fruit belongs to; one of unknown hidden share is in sight."""
    if fruit.cut_off:
        return _GROUPS[2]
    return _GROUPS[1] if fruit.hidden_share > _IN_SIGHT else _GROUPS[0]


def length_scores(readings: pd.DataFrame, truth: LengthDefinition) -> list[LengthScore]:
    """Score every method by group of fruit and kind of masks.

    Parameters
    ----------
    readings : DataFrame
        Of `length_records`, as `readings_frame` gives them.
    truth : LengthDefinition
        What to hold them against.
    """
    scored = against(readings, truth)
    scores = []
    for group in ("whole", *_GROUPS):
        inside = scored["group"] != _GROUPS[2] if group == "whole" else scored["group"] == group
        for masks in (Masks.EXACT, Masks.PERCEIVED):
            chosen = scored[inside & (scored["masks"] == masks)]
            for method, part in chosen.groupby("method", observed=True):
                known = part[part["length_m"].notna()]
                scores.append(
                    LengthScore(
                        group,
                        masks,
                        truth,
                        str(method),
                        int(part["missed"].sum()),
                        score(part["length_m"], part["true_m"]),
                        estimate(part["error_percent"], part["scene"].tolist()),
                        estimate(known["error_percent"], known["scene"].tolist()),
                    )
                )
    return scores
