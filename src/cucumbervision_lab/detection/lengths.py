"""Lengths on perceived masks beside those on true masks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.measurement.result import Method
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.mask_codes import decode_rle
from cucumbervision.perception.masks import box_of_mask, mask_iou
from cucumbervision_lab.benchmark.measure_case import fruit_lengths, noted
from cucumbervision_lab.benchmark.records import LengthRecord, Masks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision_lab.detection.pictures import Frame, TrueFruit

_READ = (*Method, "M6 thread", "M6 chord", "selector best", "selector paper")


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
    mask = _true_mask(fruit)
    points = None
    if fruit.keypoints is not None:
        points = np.column_stack([fruit.keypoints[:, :2], fruit.keypoints[:, 2] == 2])
    return Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET, keypoints=points)


def _true_mask(fruit: TrueFruit) -> NDArray[np.bool_]:
    code = fruit.code or {}
    return decode_rle(code["counts"], *code["size"])


def _record(
    frame: Frame, number: int, capture: Capture, instance: Instance | None, masks: Masks
) -> LengthRecord:
    fruit = frame.true[number]
    lengths: dict[str, float | None] = dict.fromkeys(map(str, _READ))
    details: dict[str, Any] = {"scene": frame.scene, "missed": instance is None}
    details["cut_off"] = bool(fruit.cut_off)
    details["selected"] = None
    fill = None
    if instance is not None:
        measured = measure_fruit(capture, instance)
        lengths.update(fruit_lengths(measured, capture)[0])
        details["selected"] = str(measured.selected.method) if measured.selected else None
        details["flags"] = list(measured.flags)
        details["mask_iou"] = mask_iou(instance.mask, _true_mask(fruit))
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
