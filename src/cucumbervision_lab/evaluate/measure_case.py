"""Measure a simulated case by every method under the same conditions, and its records."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CucumberVisionError, MissingExtraError, wrap_reader_errors
from cucumbervision.files import parse_model, read_text
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_iou, box_of_mask, distances_inside, mask_iou, mask_window
from cucumbervision.methods.intervals import mask_features, tube_features
from cucumbervision.methods.result import Fruit, MethodName, Selector
from cucumbervision.methods.selector import choose, measure_fruit
from cucumbervision.methods.table import AVAILABLE, masked_points
from cucumbervision_lab.arrays import Array, Array32, Generator, Mask
from cucumbervision_lab.evaluate.cases import Case, Simulated, simulate

Find = Callable[[Capture], Sequence[Instance]]

_NUMBERS = (
    *("centreline_m", "thread_m", "chord_m", "distance_m", "tilt_deg", "bend_radius_m"),
    *("hidden_share", "fill", "depth_scale", "length_m"),
)


class Masks(StrEnum):
    """Kind of masks and keypoints."""

    EXACT = "exact"
    DISTURBED = "disturbed"
    PERCEIVED = "perceived"


@dataclass(frozen=True)
class LengthRecord:
    """One fruit of one capture, measured by every method under the same conditions.

    Parameters
    ----------
    case : str
        Name of the capture, unique within the suite.
    suite : str
        Part of the benchmark.
    masks : Masks
        Kind of masks and keypoints.
    fruit : str
        Name of the fruit; captures of one fruit are not independent samples.
    centreline_m, thread_m, chord_m : float or None
        True lengths in metres; None if unknown.
    distance_m : float
        Distance of the fruit's centre from the camera, metres.
    tilt_deg : float
        Angle between chord and picture plane, degrees, 0 to 90.
    bend_radius_m : float or None
        Radius of curvature of the axis, metres; None for straight fruit.
    hidden_share : float
        Occluded share of the fruit's pixels, 0 to 1.
    fill : float
        Share of the mask's pixels with a depth reading, 0 to 1.
    condition : str
        'plain', 'sun', 'wet'.
    depth_scale : float
        Depth scale of the camera, the ratio of measured to true depth.
    lengths_m : dict of str to float or None
        Length by each method, metres; None if it failed, no key if it was not run. Keys: 'M1' …
        'M5', 'M6' (centreline), 'M6 thread', 'M6 chord', selectors and baselines.
    details : dict
        Further values by name.
    """

    case: str
    suite: str
    masks: Masks
    fruit: str
    centreline_m: float | None
    thread_m: float | None
    chord_m: float | None
    distance_m: float
    tilt_deg: float
    bend_radius_m: float | None
    hidden_share: float
    fill: float
    condition: str = "plain"
    depth_scale: float = 1.0
    lengths_m: dict[str, float | None] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


def append_record(path: Path, record: LengthRecord) -> None:
    """Append a record as a line of JSON in a single write."""
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(asdict(record)) + "\n")


def read_records(paths: Iterable[Path]) -> list[LengthRecord]:
    """Read records; an incomplete last line of an interrupted run is skipped.

    Raises
    ------
    CucumberVisionError
        If another line is invalid.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.jsonl"
    >>> facts = 0.2, 0.22, 0.2, 0.5, 0.0, None, 0.0, 1.0
    >>> record = LengthRecord("a", "paper", Masks.EXACT, "f1", *facts)
    >>> append_record(path, record)
    >>> read_records([path]) == [record]
    True
    """
    records = []
    for path in paths:
        lines = read_text(path, CucumberVisionError).split("\n")
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            place, remedy = f"{path}, line {number}", "delete the line, or the file, and run again"
            try:
                with wrap_reader_errors(place, remedy=remedy):
                    values = json.loads(line)
                records.append(
                    parse_model(LengthRecord, values, source=place, error=CucumberVisionError)
                )
            except CucumberVisionError:
                if number == len(lines):
                    continue
                raise
    return records


def readings_frame(records: Iterable[LengthRecord]) -> pd.DataFrame:
    """Return records as a data frame with one row per record and method.

    Parameters
    ----------
    records : iterable of LengthRecord
        Records with at least one length.

    Returns
    -------
    DataFrame
        The fields of `LengthRecord` except `lengths_m` and `details`, unknown numbers as NaN;
        `method` and `length_m` (metres, NaN if the method failed); and a column for each key of
        `details`.

    Raises
    ------
    MissingExtraError
        As `require_extra`.

    Examples
    --------
    >>> read = {"M1": 0.19, "M6": None}
    >>> facts = 0.2, None, None, 0.5, 0.0, None, 0.0, 1.0
    >>> record = LengthRecord("a", "paper", Masks.EXACT, "f1", *facts, lengths_m=read)
    >>> readings_frame([record])[["case", "method", "length_m", "centreline_m", "thread_m"]]
      case method  length_m  centreline_m  thread_m
    0    a     M1      0.19           0.2       NaN
    1    a     M6       NaN           0.2       NaN
    """
    require_extra()
    import pandas as pd

    rows = []
    for record in records:
        shared = {**vars(record), **record.details}
        del shared["lengths_m"], shared["details"]
        rows += [
            shared | {"method": method, "length_m": length_m}
            for method, length_m in record.lengths_m.items()
        ]
    with wrap_reader_errors("the records", remedy="run the benchmark again"):
        return pd.DataFrame(rows).astype(dict.fromkeys(_NUMBERS, float))


def require_extra() -> None:
    """Check that pandas is installed.

    Raises
    ------
    MissingExtraError
        If it is not.
    """
    if find_spec("pandas") is None:
        raise MissingExtraError("pandas", "benchmark")


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


def found_at(box: Array, instances: Sequence[Instance]) -> Instance | None:
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


def _chord_tilt_deg(axis_m: Sequence[Array] | Array) -> float:
    run = np.asarray(axis_m[-1]) - np.asarray(axis_m[0])
    return float(np.rad2deg(np.arcsin(min(1.0, abs(run[2]) / np.linalg.norm(run)))))


Baseline = Callable[[Array32, Mask, Intrinsics], float | None]

_HALF_WINDOW_PX = 2  # median of a 5x5 window, as in M4
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


BASELINES: dict[str, Baseline] = {"skan": skan_length}


def available_baselines() -> dict[str, Baseline]:
    """Return the baselines whose packages are installed.

    Examples
    --------
    >>> set(available_baselines()) <= {"skan"}
    True
    """
    needs = {"skan": ("skan", "skimage")}
    return {
        name: function
        for name, function in BASELINES.items()
        if all(find_spec(package) for package in needs.get(name, ()))
    }


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
    z = _depth_along(path_px.astype(int), np.where(mask & valid_depth(depth_m), depth_m, np.nan))
    finite = np.isfinite(z)
    if not finite.any():
        return None
    place = np.arange(len(z))
    z = np.interp(place, place[finite], z[finite])
    x, y = intrinsics.rays(path_px[:, 0].astype(float), path_px[:, 1].astype(float))
    window = min(_SMOOTH_PX, len(z) - 1 + len(z) % 2)
    points = savgol_filter(np.stack([x * z, y * z, z], axis=1), window, 2, axis=0)
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _depth_along(path_px: NDArray[Any], readings_m: NDArray[Any]) -> Array:
    half = _HALF_WINDOW_PX
    depth = np.full(len(path_px), np.nan)
    for k, (u, v) in enumerate(path_px):
        window_m = readings_m[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
        valid = window_m[np.isfinite(window_m)]
        if valid.size:
            depth[k] = np.median(valid)
    return depth
