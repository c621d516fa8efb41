"""Measure a simulated case by every method under the same conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from enum import StrEnum
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import MissingExtraError, wrap_reader_errors
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_iou, box_of_mask, distances_inside, mask_iou, mask_window
from cucumbervision.methods.intervals import mask_features, tube_features
from cucumbervision.methods.paper_methods import M4_WINDOW_PX, window_depths
from cucumbervision.methods.result import Fruit, MethodName, Selector
from cucumbervision.methods.selector import choose, measure_fruit
from cucumbervision.methods.table import AVAILABLE, masked_points
from cucumbervision_lab.arrays import Array, Array32, Generator, Mask
from cucumbervision_lab.evaluate.cases import Case, Simulated, simulate
from cucumbervision_lab.scenes.generate import extras_of

Find = Callable[[Capture], Sequence[Instance]]

Row = dict[str, Any]
"""One fruit of one capture, measured by every method on one kind of masks, as `measure_case`."""

_NUMBERS = (
    *("centreline_m", "thread_m", "chord_m", "distance_m", "tilt_deg", "bend_radius_m"),
    *("hidden_share", "fill", "depth_scale"),
)


class Masks(StrEnum):
    """Kind of masks and keypoints."""

    EXACT = "exact"
    DISTURBED = "disturbed"
    PERCEIVED = "perceived"


def readings_frame(rows: Iterable[Row]) -> pd.DataFrame:
    """Return measured fruit as a data frame with one row per fruit, kind of masks and method.

    Parameters
    ----------
    rows : iterable of Row
        At least one, as `measure_case` returns them.

    Returns
    -------
    DataFrame
        Their keys as columns, unknown numbers as NaN; `method` and `length_m` (metres, NaN if the
        method failed) in place of `lengths_m`.

    Examples
    --------
    >>> row = dict.fromkeys(_NUMBERS) | {"case": "a", "lengths_m": {"M1": 0.19, "M6": None}}
    >>> readings_frame([row])[["case", "method", "length_m", "thread_m"]]
      case method  length_m  thread_m
    0    a     M1      0.19       NaN
    1    a     M6       NaN       NaN
    """
    readings = [
        {**row, "method": method, "length_m": length_m}
        for row in rows
        for method, length_m in row["lengths_m"].items()
    ]
    with wrap_reader_errors("the records", remedy="run the benchmark again"):
        frame = pd.DataFrame(readings).drop(columns="lengths_m")
        return frame.astype(dict.fromkeys((*_NUMBERS, "length_m"), float))


_CORRELATION_PX = 12.0


def draw_disturbance(shape: tuple[int, int], rms_px: float, rng: Generator) -> Array32:
    """Generate a smooth random displacement field of an outline with a given RMS.

    Examples
    --------
    >>> field = draw_disturbance((240, 320), 1.5, np.random.default_rng(0))
    >>> bool(abs(field.std() - 1.5) < 1e-3)
    True
    """
    noise = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), _CORRELATION_PX)
    return np.asarray(noise * np.float32(rms_px / noise.std()))


def disturb_mask(mask: Mask, shift_px: Array32) -> Mask:
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


def measure_case(case: Case, masks: Sequence[Masks], find: Find | None = None) -> list[Row]:
    """Simulate a case and measure its fruit with each kind of mask.

    Parameters
    ----------
    case : Case
        The case.
    masks : sequence of Masks
        Kinds of masks. With perceived ones, as in the complete benchmark, baselines are run too.
    find : callable, optional
        Detects the fruit of a capture with masks and keypoints, required for perceived masks.
        Ground truth is only used to select the detection of the case's fruit.

    Returns
    -------
    list of Row
        A row for each kind of mask; empty if too few pixels are visible. Keys: case, suite, masks,
        fruit (captures of one fruit are not independent samples), condition ('plain', 'sun',
        'wet'), depth_scale (ratio of measured to true depth), the true lengths centreline_m,
        thread_m and chord_m, distance_m of the fruit's centre, tilt_deg (angle between chord and
        picture plane), bend_radius_m (None for straight fruit), hidden_share, and those of
        `fruit_readings`.
    """
    taken = simulate(case, paint=Masks.PERCEIVED in masks)
    truth, capture, true = taken.truth, taken.capture, extras_of(taken.truth)
    if np.count_nonzero(truth.visible) < NO_RECORD_BELOW_PX:
        return []
    truths = {
        "case": case.name,
        "suite": case.suite,
        "fruit": case.fruit,
        "condition": case.condition,
        "depth_scale": taken.depth_scale,
        **{name: true[name] for name in ("centreline_m", "thread_m", "chord_m", "tilt_deg")},
        "distance_m": case.distance_m,
        "bend_radius_m": case.bend_radius_m,
        "hidden_share": truth.hidden_share,
    }
    tools = available_baselines() if Masks.PERCEIVED in masks else {}
    rows = []
    for kind in masks:
        instance = _instance(taken, kind, case, find)
        row, _ = fruit_readings(capture, instance, truth.visible)
        mask = None if instance is None else instance.mask
        row["lengths_m"] |= {
            name: None if mask is None else measure(capture.depth_m, mask, capture.intrinsics)
            for name, measure in tools.items()
        }
        rows.append({**truths, "masks": kind, **row})
    return rows


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


def found_at(box: Array, instances: Sequence[Instance]) -> Instance | None:
    """Return the detection that matches a box x1, y1, x2, y2 in pixels, or None."""
    best = max(instances, key=lambda instance: box_iou(instance.box, box), default=None)
    return None if best is None or box_iou(best.box, box) < _FOUND_IOU else best


def fruit_readings(
    capture: Capture, instance: Instance | None, true_mask: Mask
) -> tuple[Row, Fruit | None]:
    """Measure a fruit by every method.

    Parameters
    ----------
    capture : Capture
        The capture.
    instance : Instance, optional
        The fruit's mask and keypoints; None if it was not found.
    true_mask : ndarray of bool, shape (H, W)
        Its visible pixels.

    Returns
    -------
    row : Row
        lengths_m of `fruit_lengths`, None if not found; fill (share of the mask's pixels with a
        depth reading, 0 to 1), selected method, mask_iou with the true mask, and what interval
        models use: mask_features, m6_features and m6_flags.
    fruit : Fruit or None
        What was measured.
    """
    if instance is None:
        return {"lengths_m": dict.fromkeys(READ), "fill": 0.0, "selected": None}, None
    fruit = measure_fruit(capture, instance)
    m6 = fruit.measurements[MethodName.M6]
    row: Row = {
        "lengths_m": fruit_lengths(fruit, capture),
        "fill": fruit.fill or 0.0,
        "selected": None if fruit.selected is None else str(fruit.selected.method),
        "mask_iou": mask_iou(instance.mask, true_mask),
        "mask_features": mask_features(fruit.mask_source, fruit.flags, instance.confidence),
    }
    if m6.fit is not None:
        row["m6_features"] = {k: round(v, 6) for k, v in tube_features(m6).items()}
        row["m6_flags"] = list(m6.fit.flags)
    return row, fruit


def fruit_lengths(fruit: Fruit, capture: Capture) -> dict[str, float | None]:
    """Return the lengths of a fruit by every method and selector.

    Parameters
    ----------
    fruit : Fruit
        Measurement by all methods with `Selector.BEST`.
    capture : Capture
        The measured capture.

    Returns
    -------
    dict of str to float
        'M1' … 'M6', 'M6 thread', 'M6 chord', 'selector best', 'selector paper'; None if not
        measured.
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
    for selector, measurement in ((Selector.BEST, fruit.selected), (Selector.PAPER, by_paper)):
        lengths[f"selector {selector}"] = None if measurement is None else measurement.length_m
    return lengths


Baseline = Callable[[Array32, Mask, Intrinsics], float | None]

_SMOOTH_PX = 41  # maximum window of the smoothing along the path
_MIN_PATH_PX = 5


def skan_length(depth_m: Array32, mask: Mask, intrinsics: Intrinsics) -> float | None:
    """Compute the 3D length of a mask's longest shortest skeleton path by skan.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 is no reading.
    mask : ndarray of bool, shape (H, W)
        Mask of the fruit.
    intrinsics : Intrinsics
        Intrinsics of the colour stream.

    Returns
    -------
    float or None
        Length in metres; None without a path.

    Raises
    ------
    MissingExtraError
        If skan or scikit-image is not installed.

    Notes
    -----
    `skimage.morphology.skeletonize`, then the longest of the shortest paths of the graph by
    `skan.csr.skeleton_to_csgraph` (Nunez-Iglesias et al. 2018, PeerJ 6:e4312).
    """
    try:
        import skan
        from skimage.morphology import skeletonize
    except ImportError:
        raise MissingExtraError("skan", "benchmark") from None
    window = mask_window(mask)
    if window is None:
        return None
    thin = skeletonize(mask[window])  # type: ignore[no-untyped-call,unused-ignore]
    if np.count_nonzero(thin) < _MIN_PATH_PX:
        return None
    graph, (rows, columns) = skan.csr.skeleton_to_csgraph(thin)
    distances, before = dijkstra(graph, directed=False, return_predecessors=True)
    distances[np.isinf(distances)] = -1  # of another part of the mask
    start, node = divmod(int(distances.argmax()), len(distances))
    path = [node]
    while node != start:
        node = int(before[start, node])
        path.append(node)
    corner = [window[1].start, window[0].start]
    path_px = np.column_stack([columns[path], rows[path]]) + corner
    return lifted_length(path_px, depth_m, mask, intrinsics)


def available_baselines() -> dict[str, Baseline]:
    """Return the baselines whose packages are installed.

    Examples
    --------
    >>> set(available_baselines()) <= {"skan"}
    True
    """
    installed = all(find_spec(package) for package in ("skan", "skimage"))
    return {"skan": skan_length} if installed else {}


def lifted_length(
    path_px: NDArray[Any], depth_m: Array32, mask: Mask, intrinsics: Intrinsics
) -> float | None:
    """Compute the 3D length of a path of pixels.

    Each pixel is deprojected with the median of the valid readings of the mask in a 5x5 window;
    missing values are interpolated along the path. The points are smoothed along the path by a
    Savitzky-Golay filter (second order, at most 41 px), which removes the staircase of pixels and
    depth noise but keeps the ends. Without smoothing, a diagonal path would be up to 8 % too long.

    Parameters
    ----------
    path_px : ndarray, shape (N, 2)
        Pixels (u, v) in order.
    depth_m, mask, intrinsics
        See `skan_length`.

    Returns
    -------
    float or None
        Metres; None for fewer than 5 pixels or without a valid reading.

    Examples
    --------
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> path = np.stack([np.arange(200, 401), np.full(201, 240)], axis=1)
    >>> round(lifted_length(path, depth, depth > 0, camera), 6)
    0.2
    """
    from scipy.signal import savgol_filter

    if len(path_px) < _MIN_PATH_PX:
        return None
    u, v = np.asarray(path_px, np.float64).T
    z = window_depths(depth_m, u, v, M4_WINDOW_PX, mask)
    finite = np.isfinite(z)
    if not finite.any():
        return None
    place = np.arange(len(z))
    z = np.interp(place, place[finite], z[finite])
    x, y = intrinsics.rays(u, v)
    window = min(_SMOOTH_PX, len(z) - 1 + len(z) % 2)
    points = savgol_filter(np.stack([x * z, y * z, z], axis=1), window, 2, axis=0)
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
