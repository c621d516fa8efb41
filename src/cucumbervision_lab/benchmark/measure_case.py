"""Measure a simulated case by every method under the same conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision.instances.instance import Instance, MaskSource
from cucumbervision.instances.masks import box_iou, box_of_mask, distances_inside, mask_iou
from cucumbervision.measurement.intervals import mask_features, tube_features
from cucumbervision.measurement.methods import AVAILABLE, masked_points
from cucumbervision.measurement.result import MethodName, Selector
from cucumbervision.measurement.selector import choose, measure_fruit
from cucumbervision_lab.benchmark.baselines import available_baselines
from cucumbervision_lab.benchmark.cases import Simulated, simulate
from cucumbervision_lab.benchmark.records import LengthRecord, Masks

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.result import Fruit
    from cucumbervision_lab.benchmark.cases import Case

    Find = Callable[[Capture], Sequence[Instance]]

_CORRELATION_PX = 12.0


def draw_disturbance(
    shape: tuple[int, int], rms_px: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Generate a smooth random displacement field of an outline with a given RMS.

    Examples
    --------
    >>> field = draw_disturbance((240, 320), 1.5, np.random.default_rng(0))
    >>> bool(abs(field.std() - 1.5) < 1e-3)
    True
    """
    noise = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), _CORRELATION_PX)
    return np.asarray(noise * np.float32(rms_px / noise.std()))


def disturb_mask(mask: NDArray[np.bool_], shift_px: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Displace the outline of a mask by a field.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        The exact mask.
    shift_px : ndarray of float32, shape (H, W)
        Outward displacement at each pixel.

    Returns
    -------
    ndarray of bool, shape (H, W)
        Pixels whose signed distance inside the outline exceeds the negative displacement.

    Examples
    --------
    >>> mask = np.zeros((40, 40), bool)
    >>> mask[10:30, 10:30] = True
    >>> grown = disturb_mask(mask, np.full((40, 40), 2.0, np.float32))
    >>> int(np.flatnonzero(grown[20])[0])
    8
    """
    # The centre of a pixel is half a pixel from its border.
    signed = np.where(mask, distances_inside(mask) - 0.5, 0.5 - distances_inside(~mask))
    return np.asarray(signed > -shift_px)


OUTLINE_RMS_PX = 1.5

_FOUND_IOU = 0.5  # minimum box IoU of a detection with the fruit of the case

READ = (*map(str, AVAILABLE), "M6 thread", "M6 chord", "selector best", "selector paper")
"""Names of the lengths of a fruit, as `fruit_lengths` gives them."""

NO_RECORD_BELOW_PX = 30  # minimum number of visible pixels for a record


@dataclass(frozen=True)
class CaseOptions:
    """Measurement options of a case.

    Parameters
    ----------
    masks : tuple of Masks
        Kinds of masks.
    baselines : bool
        Also run the baselines.
    """

    masks: tuple[Masks, ...] = (Masks.EXACT, Masks.DISTURBED)
    baselines: bool = False


def measure_case(case: Case, options: CaseOptions, find: Find | None = None) -> list[LengthRecord]:
    """Simulate a case and measure its fruit with each kind of mask.

    Parameters
    ----------
    case : Case
        The case.
    options : CaseOptions
        Measurement options.
    find : callable, optional
        Detects the fruit of a capture with masks and keypoints, required for perceived masks.
        Ground truth is only used to select the detection of the case's fruit.

    Returns
    -------
    list of LengthRecord
        A record for each kind of mask; empty if too few pixels are visible.
    """
    taken = simulate(case, paint=Masks.PERCEIVED in options.masks)
    if np.count_nonzero(taken.truth.visible) < NO_RECORD_BELOW_PX:
        return []
    records = []
    for kind in options.masks:
        instance = _instance(taken, kind, case, find)
        records.append(_record(case, taken, kind, instance, options.baselines))
    return records


def _instance(taken: Simulated, kind: Masks, case: Case, find: Find | None) -> Instance | None:
    truth = taken.truth
    rng = np.random.default_rng(case.capture_seed + 4)
    visible = (truth.keypoint_visibility == 2).astype(float)
    keypoints = np.column_stack([truth.keypoints_px, visible])
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
    if find is None:
        raise ValueError("perceived masks need `find`")
    return found_at(exact.box, find(taken.capture))


def found_at(box: NDArray[np.float64], instances: Sequence[Instance]) -> Instance | None:
    """Return the detection that matches a box x1, y1, x2, y2 in pixels, or None."""
    best = max(instances, key=lambda instance: box_iou(instance.box, box), default=None)
    return None if best is None or box_iou(best.box, box) < _FOUND_IOU else best


def _record(
    case: Case, taken: Simulated, kind: Masks, instance: Instance | None, baselines: bool
) -> LengthRecord:
    truth, capture = taken.truth, taken.capture
    tools = available_baselines() if baselines else {}
    lengths: dict[str, float | None] = dict.fromkeys((*READ, *tools))
    details: dict[str, Any] = {"mask_failure": "not found", "mask_iou": 0.0}
    fill = 0.0
    if instance is not None:
        measured = measure_fruit(capture, instance)
        fill = 0.0 if instance.mask is None else measured.fill or 0.0
        lengths, chosen = fruit_lengths(measured, capture)
        details = {f"selected_{selector}": method for selector, method in chosen.items()}
        details |= interval_details(measured)
        details["mask_iou"] = round(mask_iou(instance.mask, truth.visible), 4)
    if instance is not None and instance.mask is not None:
        for name, measure in tools.items():
            lengths[name] = measure(capture.depth_m, instance.mask, capture.intrinsics)
    return LengthRecord(
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
        fill=fill,
        condition=case.condition,
        depth_scale=taken.depth_scale,
        lengths_m=lengths,
        details=details,
    )


def fruit_lengths(
    fruit: Fruit, capture: Capture
) -> tuple[dict[str, float | None], dict[Selector, str | None]]:
    """Return the lengths of a fruit by every method and selector, and the selected methods.

    Parameters
    ----------
    fruit : Fruit
        Measurement by all methods with `Selector.BEST`.
    capture : Capture
        The measured capture.

    Returns
    -------
    lengths_m : dict of str to float
        'M1' … 'M6', 'M6 thread', 'M6 chord', 'selector best', 'selector paper'; None if not
        measured.
    chosen : dict of Selector to str
        Method selected by each selector.
    """
    lengths: dict[str, float | None] = {
        str(method): measurement.length_m for method, measurement in fruit.measurements.items()
    }
    tube = fruit.measurements[MethodName.M6].tube
    lengths["M6 thread"] = tube.thread_m if tube else None
    lengths["M6 chord"] = tube.chord_m if tube else None
    # The paper's selector does not use the detector's mask.
    mask, points = fruit.instance.mask, None
    if mask is not None:
        points = len(masked_points(capture.depth_m, mask, capture.intrinsics))
    by_paper, _, _ = choose(fruit.measurements, points, fruit.instance.box, Selector.PAPER)
    chosen: dict[Selector, str | None] = {}
    for selector, measurement in ((Selector.BEST, fruit.selected), (Selector.PAPER, by_paper)):
        lengths[f"selector {selector}"] = None if measurement is None else measurement.length_m
        chosen[selector] = None if measurement is None else str(measurement.source)
    return lengths, chosen


def interval_details(fruit: Fruit) -> dict[str, Any]:
    """Return the details of a measurement that interval models use as features."""
    m6 = fruit.measurements[MethodName.M6]
    details: dict[str, Any] = {
        "m6_reason": str(m6.reason),
        "mask_failure": fruit.instance.mask_failure,
        "mask_features": mask_features(fruit.mask_source, fruit.flags, fruit.instance.confidence),
    }
    if m6.fit is not None:
        details["m6_features"] = {k: round(v, 6) for k, v in tube_features(m6).items()}
        details["m6_flags"] = list(m6.fit.flags)
    return details


def _chord_tilt_deg(axis_m: Sequence[NDArray[np.float64]] | NDArray[np.float64]) -> float:
    run = np.asarray(axis_m[-1]) - np.asarray(axis_m[0])
    return float(np.rad2deg(np.arcsin(min(1.0, abs(run[2]) / np.linalg.norm(run)))))
