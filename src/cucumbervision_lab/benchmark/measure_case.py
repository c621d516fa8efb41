"""Measure one simulated case by everybody, under the same conditions."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.accuracy.records import Masks, Record
from cucumbervision.measurement.methods import Region, run_methods
from cucumbervision.measurement.result import Method
from cucumbervision.measurement.selector import Selector, choose
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask, mask_iou
from cucumbervision_lab.benchmark.disturb import disturb_mask, draw_disturbance
from cucumbervision_lab.benchmark.oracle import oracle_length_m
from cucumbervision_lab.benchmark.simulate import Simulated, simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.measurement.result import Measurement
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision_lab.benchmark.protocol import Case

__all__ = ["CaseOptions", "measure_case"]

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
    region = Region(
        capture.depth_m, capture.intrinsics, instance.box, instance.mask, instance.keypoints
    )
    results = run_methods(region, [m for m in Method if m is not Method.M6])
    start = time.perf_counter()
    m6 = run_methods(region, [Method.M6])[Method.M6]
    details: dict[str, Any] = {"m6_ms": round(1e3 * (time.perf_counter() - start), 1)}
    results[Method.M6] = m6
    lengths: dict[str, float | None] = {str(m): r.length_m for m, r in results.items()}
    lengths.update(_tube(m6))
    lengths.update(_selected(results, region, details))
    if instance.mask is not None:
        rng = np.random.default_rng(case.capture_seed + 5)
        lengths["oracle"] = oracle_length_m(truth, instance.mask, capture.intrinsics, rng)
        if outsiders:
            lengths.update(_outsiders(capture.depth_m, instance.mask, region))
    details.update(_noted(m6, instance))
    points = region.mask_points_m
    pixels = 0 if instance.mask is None else int(np.count_nonzero(instance.mask))
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
        fill=0.0 if points is None or not pixels else len(points) / pixels,
        condition=case.condition,
        depth_scale=taken.depth_scale,
        lengths_m=lengths,
        details={
            **details,
            "mask_iou": round(mask_iou(instance.mask, truth.visible), 4),
            "ends_seen": _ends_seen(taken),
        },
    )


def _tube(m6: Measurement) -> dict[str, float | None]:
    tube = m6.tube
    return {
        "M6": tube.centreline_m if tube else None,
        "M6 thread": tube.thread_m if tube else None,
        "M6 chord": tube.chord_m if tube else None,
    }


def _selected(
    results: dict[Method, Measurement], region: Region, details: dict[str, Any]
) -> dict[str, float | None]:
    points = None if region.mask_points_m is None else len(region.mask_points_m)
    lengths: dict[str, float | None] = {}
    for selector in Selector:
        allowed = {
            m: r for m, r in results.items() if selector is Selector.BEST or m is not Method.M6
        }
        chosen, _, _ = choose(allowed, points, region.box)
        lengths[f"selector {selector}"] = None if chosen is None else chosen.length_m
        method = None if chosen is None else str(chosen.measured_by or chosen.method)
        details[f"selected_{selector}"] = method
    return lengths


def _outsiders(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], region: Region
) -> dict[str, float | None]:
    from cucumbervision_lab.benchmark.baselines import available_outsiders

    tools = available_outsiders()
    return {name: tool(depth_m, mask, region.intrinsics) for name, tool in tools.items()}


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
