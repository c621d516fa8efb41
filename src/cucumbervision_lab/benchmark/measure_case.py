"""Measure one simulated case by everybody, under the same conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.accuracy.records import Masks, Record
from cucumbervision.measurement.cloud import masked_points
from cucumbervision.measurement.result import Method
from cucumbervision.measurement.selector import Selector, choose, measure_fruit
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask, mask_iou
from cucumbervision_lab.benchmark.disturb import disturb_mask, draw_disturbance
from cucumbervision_lab.benchmark.oracle import oracle_length_m
from cucumbervision_lab.benchmark.simulate import Simulated, simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.result import FruitMeasurement, Measurement
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision_lab.benchmark.protocol import Case

__all__ = ["CaseOptions", "fruit_lengths", "measure_case"]

OUTLINE_RMS_PX = 1.5
NO_RECORD_BELOW_PX = 30  # a fruit of which fewer pixels show is no capture of a fruit


@dataclass(frozen=True)
class CaseOptions:
    """How a case is measured.

    Parameters
    ----------
    masks : tuple of Masks
        Whose masks.
    outsiders : bool
        Whether other people's tools run too.
    frames : int
        Size of the burst.
    prompt : str
        SAM's prompt, for perceived masks.
    """

    masks: tuple[Masks, ...] = (Masks.EXACT, Masks.DISTURBED)
    outsiders: bool = False
    frames: int = 5
    prompt: str = "box+point"


def measure_case(
    case: Case, options: CaseOptions, segmenter: Segmenter | None = None
) -> list[Record]:
    """Simulate a case and measure its fruit with each kind of mask.

    Parameters
    ----------
    case : Case
        What to take.
    options : CaseOptions
        How to measure.
    segmenter : Segmenter, optional
        Draws the perceived masks, prompted by the box of the exact one.

    Returns
    -------
    list of Record
        One for each kind of mask; none where too little of the fruit shows.
    """
    taken = simulate(case, options.frames, paint=Masks.PERCEIVED in options.masks)
    if np.count_nonzero(taken.truth.visible) < NO_RECORD_BELOW_PX:
        return []
    records = []
    for kind in options.masks:
        instance = _instance(taken, kind, case, segmenter)
        records.append(_record(case, taken, kind, instance, options.outsiders))
    return records


def _instance(taken: Simulated, kind: Masks, case: Case, segmenter: Segmenter | None) -> Instance:
    truth = taken.truth
    rng = np.random.default_rng(case.capture_seed + 4)
    seen = (truth.keypoint_visibility == 2).astype(float)
    keypoints = np.column_stack([truth.keypoints_px, seen])
    exact = Instance(
        box_of_mask(truth.visible),
        mask=truth.visible,
        mask_source=MaskSource.DATASET,
        keypoints=keypoints,
    )
    if kind is Masks.EXACT:
        return exact
    if kind is Masks.DISTURBED:
        field = draw_disturbance(truth.visible.shape, OUTLINE_RMS_PX, rng)
        mask = disturb_mask(truth.visible, field)
        keypoints[:, :2] += rng.normal(0, OUTLINE_RMS_PX, (5, 2))
        box = box_of_mask(mask) if mask.any() else exact.box
        return replace(exact, box=box, mask=mask, keypoints=keypoints)
    if segmenter is None:
        raise ValueError("perceived masks need a segmenter")
    prompt = replace(exact, mask=None, mask_source=None, keypoints=None)
    return segmenter.segment(taken.capture.color, [prompt])[0]


def _record(
    case: Case, taken: Simulated, kind: Masks, instance: Instance, outsiders: bool
) -> Record:
    truth, capture = taken.truth, taken.capture
    measured = measure_fruit(capture, instance)
    lengths, chosen = fruit_lengths(measured, capture)
    if instance.mask is not None:
        rng = np.random.default_rng(case.capture_seed + 5)
        lengths["oracle"] = oracle_length_m(truth, instance.mask, capture.intrinsics, rng)
        if outsiders:
            lengths.update(_outsiders(capture, instance.mask))
    return Record(
        case=case.name,
        suite=case.suite,
        masks=kind,
        fruit=case.fruit,
        centreline_m=truth.centreline_m,
        thread_m=truth.thread_m,
        chord_m=truth.chord_m,
        distance_m=case.distance_m,
        tilt_deg=_chord_tilt_deg(truth.axis_m),
        bend_radius_m=case.bend_radius_m,
        hidden_share=truth.hidden_share,
        fill=0.0 if instance.mask is None else measured.fill or 0.0,
        condition=case.condition,
        depth_scale=taken.depth_scale,
        lengths_m=lengths,
        details={
            **{f"selected_{selector}": method for selector, method in chosen.items()},
            **_noted(measured.measurements[Method.M6], instance),
            "mask_iou": round(mask_iou(instance.mask, truth.visible), 4),
            "ends_seen": _ends_seen(taken),
        },
    )


def fruit_lengths(
    fruit: FruitMeasurement, capture: Capture
) -> tuple[dict[str, float | None], dict[Selector, str | None]]:
    """Return a fruit's lengths by every method and both selectors, and what these chose.

    Parameters
    ----------
    fruit : FruitMeasurement
        By all methods, chosen by `Selector.BEST`.
    capture : Capture
        Where it was measured.

    Returns
    -------
    lengths_m : dict of str to float
        'M1' … 'M6', 'M6 thread', 'M6 chord', 'selector best', 'selector paper'; None for none.
    chosen : dict of Selector to str
        The method whose length each selector took.
    """
    lengths: dict[str, float | None] = {
        str(method): one.length_m for method, one in fruit.measurements.items()
    }
    tube = fruit.measurements[Method.M6].tube
    lengths["M6 thread"] = tube.thread_m if tube else None
    lengths["M6 chord"] = tube.chord_m if tube else None
    # The paper's selector takes no mask of the detector's.
    mask, points = fruit.instance.mask, None
    if mask is not None:
        points = len(masked_points(capture.depth_m, mask, capture.intrinsics))
    by_paper, _, _ = choose(fruit.measurements, points, fruit.instance.box, Selector.PAPER)
    chosen: dict[Selector, str | None] = {}
    for selector, one in ((Selector.BEST, fruit.selected), (Selector.PAPER, by_paper)):
        lengths[f"selector {selector}"] = None if one is None else one.length_m
        chosen[selector] = None if one is None else str(one.source)
    return lengths, chosen


def _outsiders(capture: Capture, mask: NDArray[np.bool_]) -> dict[str, float | None]:
    from cucumbervision_lab.benchmark.baselines import available_outsiders

    tools = available_outsiders()
    return {name: tool(capture.depth_m, mask, capture.intrinsics) for name, tool in tools.items()}


def _noted(m6: Measurement, instance: Instance) -> dict[str, Any]:
    noted: dict[str, Any] = {"m6_reason": str(m6.reason), "mask_failure": instance.mask_failure}
    if m6.fit is not None:
        from cucumbervision.measurement.intervals import tube_features

        noted["m6_features"] = {k: round(v, 6) for k, v in tube_features(m6).items()}
        noted["m6_flags"] = list(m6.fit.flags)
    return noted


def _ends_seen(taken: Simulated) -> bool:
    """Whether leaves leave both ends' outlines in sight."""
    truth = taken.truth
    hidden = truth.amodal & ~truth.visible
    if not hidden.any():
        return True
    seen = []
    for u, v in np.rint(taken.capture.intrinsics.project(truth.axis_m[[0, -1]])).astype(int):
        near = np.s_[max(v - 3, 0) : max(v + 4, 0), max(u - 3, 0) : max(u + 4, 0)]
        seen.append(not hidden[near].any())
    return all(seen)


def _chord_tilt_deg(axis_m: Sequence[NDArray[np.float64]] | NDArray[np.float64]) -> float:
    run = np.asarray(axis_m[-1]) - np.asarray(axis_m[0])
    return float(np.rad2deg(np.arcsin(min(1.0, abs(run[2]) / np.linalg.norm(run)))))
