"""Masks and boxes of fruit: areas, overlaps, suppression, spurs, flowers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cucumbervision.arrays import Array, Array32, Ints, Mask, Numbers, Pixels
from cucumbervision.errors import InstancesError


def as_mask(values: Numbers) -> Mask:
    """Return a binary mask (bool, 0/1 or 0/255) as bool.

    Parameters
    ----------
    values : ndarray, shape (H, W)
        Of any dtype of numbers.

    Returns
    -------
    ndarray of bool, shape (H, W)
        The same array where it is bool already.

    Raises
    ------
    InstancesError
        If it is not two-dimensional, or holds more than two values, or two of which none is 0.

    Examples
    --------
    >>> as_mask(np.array([[0, 255], [255, 0]], np.uint8)).tolist()
    [[False, True], [True, False]]
    """
    array = np.asarray(values)
    remedy = "give bool, 0 and 1, or 0 and 255, one value a pixel"
    if array.ndim != 2 or array.dtype.kind not in "buif":
        fault = f"a mask is {array.dtype} with {array.ndim} dimensions, not yes or no a pixel"
        raise InstancesError(fault, remedy=remedy)
    if array.dtype == np.bool_:
        return array
    filled = array != 0
    if filled.any() and not (array[filled] == array[filled][0]).all():
        lowest, highest = array[filled].min(), array[filled].max()
        fault = f"a mask has values from {lowest:g} to {highest:g} beside 0, not one"
        raise InstancesError(fault, remedy=remedy)
    return np.asarray(filled)


def mask_window(mask: Mask, margin_px: int = 0) -> tuple[slice, slice] | None:
    """Return the slices of the rows and columns that hold a mask's pixels; None if it is empty.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
    margin_px : int
        Pixels to add on every side, within the picture.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:5] = True
    >>> mask_window(mask)
    (slice(1, 2, None), slice(2, 5, None))
    >>> mask_window(mask, 1)
    (slice(0, 3, None), slice(1, 6, None))
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return None
    # Only the mask's rows: the picture's would take several times as long.
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(axis=0))
    y, x = (
        slice(max(int(filled[0]) - margin_px, 0), min(int(filled[-1]) + 1 + margin_px, size))
        for filled, size in zip((rows, columns), mask.shape, strict=True)
    )
    return y, x


def overlap(a: tuple[slice, ...], b: tuple[slice, ...]) -> tuple[slice, ...]:
    """Return the part that two windows of `mask_window` share.

    Examples
    --------
    >>> overlap((slice(1, 4), slice(0, 9)), (slice(2, 6), slice(3, 5)))
    (slice(2, 4, None), slice(3, 5, None))
    """
    pairs = zip(a, b, strict=True)
    return tuple(slice(max(x.start, y.start), min(x.stop, y.stop)) for x, y in pairs)


def mask_pixels(mask: Mask) -> Array:
    """Return the coordinates of a mask's pixels, row by row.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)

    Returns
    -------
    ndarray of float64, shape (N, 2)
        u, v in pixels.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:4] = mask[2, 1] = True
    >>> mask_pixels(mask).tolist()
    [[2.0, 1.0], [3.0, 1.0], [1.0, 2.0]]
    """
    window = mask_window(mask)
    if window is None:
        return np.empty((0, 2))
    v, u = np.nonzero(mask[window])
    corner = window[1].start, window[0].start
    return np.asarray(np.stack([u, v], axis=1) + corner, np.float64)


_SPECK = 0.02


def without_specks(part: Mask, share: float = _SPECK) -> Mask:
    """Return a mask without pieces that are smaller than a share of it; the largest stays.

    Examples
    --------
    >>> mask = np.zeros((4, 60), bool)
    >>> mask[:, :40] = mask[2, 50] = True
    >>> int(mask.sum()), int(without_specks(mask).sum())
    (161, 160)
    """
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(part.view(np.uint8), connectivity=8)
    if count <= 2:
        return part
    areas = np.asarray(stats)[:, cv2.CC_STAT_AREA]
    is_piece = areas >= min(share * areas[1:].sum(), areas[1:].max())
    is_piece[0] = False
    return np.asarray(is_piece[np.asarray(labels)])


def distances_inside(mask: Numbers, pixels: Ints | None = None) -> Array32:
    """Compute each set pixel's distance to the nearest unset pixel, in pixels.

    Parameters
    ----------
    mask : ndarray of bool or uint8, shape (H, W)
        Nonzero is set; the border does not count as unset.
    pixels : ndarray of int, shape (N, 2), optional
        Columns and rows of the pixels to return; all if not given.

    Returns
    -------
    ndarray of float32, shape (H, W) or (N,)
        0 for unset pixels; reproducible to the last bit.

    Examples
    --------
    >>> mask = np.ones((3, 4), bool)
    >>> mask[0, 0] = False
    >>> distances_inside(mask)[1:, 1:].astype(float).round(2).tolist()
    [[1.41, 2.24, 3.16], [2.24, 2.83, 3.61]]
    """
    import cv2

    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inside = np.minimum(
        inside, np.float32(sum(mask.shape))
    )  # OpenCV's largest number without an unset pixel
    if pixels is not None:
        inside = inside[pixels[:, 1], pixels[:, 0]]
    # OpenCV's square roots differ in the last bit between calls; the squares are integers.
    return np.sqrt(np.rint(np.square(inside)))


def without_spurs(mask: Mask) -> Mask:
    """Return a mask without what is much thinner than the fruit, such as a stem beside it.

    A morphological opening by a fifth of the largest radius; what lies within two pixels of the
    rest stays, so that corners keep their shape. A part that is thinner than a third of the fruit
    goes, too, if it is long: a stalk, while tips taper.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Pixels of one fruit.

    Examples
    --------
    >>> mask = np.zeros((60, 200), bool)
    >>> mask[20:40, 20:120] = True
    >>> mask[29:31, 120:180] = True
    >>> without_spurs(mask)[30, [100, 119, 121, 130]].tolist()
    [True, True, True, False]
    """
    import cv2

    padded = np.pad(mask.astype(np.uint8), 1)
    radius_px = float(distances_inside(padded).max())
    near = cv2.dilate(_opened(padded, _SPUR * radius_px), _disc(_SPUR_LEFT_PX)) > 0
    thick = _opened(padded, _STALK * radius_px)
    beyond_px = cv2.distanceTransform(1 - thick, cv2.DIST_L2, 3) * (near & (padded > 0))
    count, parts = cv2.connectedComponents((beyond_px > _SPUR_LEFT_PX).astype(np.uint8))
    lengths_px = [beyond_px[parts == part].max() for part in range(1, count)]
    is_kept = np.array([True, *(length <= _STALK_LENGTH * radius_px for length in lengths_px)])
    kept = near & is_kept[parts]
    return np.asarray(mask & kept[1:-1, 1:-1])


def _opened(mask: Pixels, radius_px: float) -> Pixels:
    """Return a mask without what is thinner than a disc of this radius, of at least one pixel."""
    import cv2

    disc = _disc(max(round(radius_px), 1))
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, disc), np.uint8)


def _disc(radius_px: int) -> Pixels:
    import cv2

    side_px = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side_px, side_px))
    return np.asarray(disc, np.uint8)


def box_of_mask(mask: Mask) -> Array:
    """Return the bounding box x1, y1, x2, y2 of a mask, in pixels.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        At least one pixel set.

    Raises
    ------
    ValueError
        If no pixel is set.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:5] = True
    >>> box_of_mask(mask).tolist()
    [1.5, 0.5, 4.5, 1.5]
    """
    window = mask_window(mask)
    if window is None:
        raise ValueError("the mask is empty")
    rows, columns = window
    return np.array([columns.start, rows.start, columns.stop, rows.stop]) - 0.5


def mask_ious(masks: Mask, mask: Mask) -> Array:
    """Compute the intersection over union of several masks, shape (N, H, W), with one."""
    shared = np.count_nonzero(masks & mask, axis=(1, 2))
    return np.asarray(shared / np.maximum(np.count_nonzero(masks | mask, axis=(1, 2)), 1))


def mask_iou(a: Mask | None, b: Mask) -> float:
    """Compute the intersection over union of two masks; 0 if the first is None.

    Examples
    --------
    >>> mask_iou(np.array([[True, True, False]]), np.array([[False, True, True]])) == 1 / 3
    True
    """
    return 0.0 if a is None else float(mask_ious(a[None], b)[0])


_SWALLOWED = 0.5  # share of the smaller mask inside the larger one, from which it is contained
_ONE_IOU = 0.8  # IoU from which two masks show the same object
_BESIDE_PX = 8
_NEARER = 0.01  # of the distance: least depth difference that shows which fruit is in front


def disjoint_masks(
    masks: Sequence[Mask | None], scores: Sequence[float], depth_m: Array32 | None = None
) -> list[Mask | None]:
    """Assign the pixels that two masks share to one of them.

    The smaller mask gets them if at least half of it lies in the larger one; otherwise the mask
    whose other pixels are closest in depth to the shared ones; otherwise the more confident one.

    Parameters
    ----------
    masks : sequence of ndarray of bool, shape (H, W), or None
        Masks of different fruit. Two with an IoU of 0.8 or more show the same fruit and stay as
        they are.
    scores : sequence of float
        Confidence of each.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres; 0 where there is no reading.

    Returns
    -------
    list of ndarray of bool, shape (H, W), or None
        In the same order; an array that shares no pixel is returned itself.

    Examples
    --------
    >>> left_half, whole_fruit = np.zeros((2, 1, 6), bool)
    >>> left_half[0, :3] = whole_fruit[0, :] = True
    >>> [mask.astype(int).tolist() for mask in disjoint_masks([left_half, whole_fruit], [0.5, 0.9])]
    [[[1, 1, 1, 0, 0, 0]], [[0, 0, 0, 1, 1, 1]]]
    """
    present = {k: mask for k, mask in enumerate(masks) if mask is not None}
    windows = {k: window for k, mask in present.items() if (window := mask_window(mask))}
    parted = list(masks)
    for i, j in ((i, j) for j in windows for i in windows if i < j):
        shared, pair = overlap(windows[i], windows[j]), (parted[i], parted[j])
        a, b = (np.asarray(mask) for mask in pair)
        # Compare the masks as given: earlier assignments may have changed both.
        if (a[shared] & b[shared]).any() and mask_iou(present[i], present[j]) < _ONE_IOU:
            loser = _loser((a, b), (scores[i], scores[j]), depth_m)
            parted[(i, j)[loser]] = (a & ~b, b & ~a)[loser]
    return parted


def _loser(pair: tuple[Mask, Mask], scores: tuple[float, float], depth_m: Array32 | None) -> int:
    """Return the index of the mask that loses the shared pixels."""
    a, b = pair
    shared = a & b
    areas = int(np.count_nonzero(a)), int(np.count_nonzero(b))
    count = int(np.count_nonzero(shared))
    if count >= _SWALLOWED * min(areas):
        return int(areas[1] > areas[0])
    far_m = _distances(shared, pair, depth_m)
    if all(far_m):
        off = [abs(distance_m - far_m[0]) for distance_m in far_m[1:]]
        if abs(off[0] - off[1]) > _NEARER * far_m[0]:
            return int(off[1] > off[0])
    return int(scores[1] <= scores[0])


def _distances(shared: Mask, pair: tuple[Mask, Mask], depth_m: Array32 | None) -> list[float]:
    """Return the median depths, metres, of the shared pixels and of each mask's own near them.

    0 without a reading. Only pixels nearby count, since a tilted fruit's ends differ in depth.
    """
    window = mask_window(shared)
    if depth_m is None or window is None:
        return [0.0]
    margin = max(_BESIDE_PX, *(part.stop - part.start for part in window))
    around = mask_window(shared, margin) or window
    medians = []
    for mask in (shared, *(mask & ~shared for mask in pair)):
        readings = depth_m[around][mask[around]]
        readings = readings[readings > 0]
        medians.append(float(np.median(readings)) if readings.size else 0.0)
    return medians


_SPUR, _STALK = 0.2, 0.35  # of the largest radius: what is thinner, and what is thin and long
_SPUR_LEFT_PX = 2
_STALK_LENGTH = 0.6  # of the largest radius
_FLOWER_REDNESS = 18.0
"""How much redder than the fruit a withered flower is, in CIELAB a*; skin varies by half of it."""

_FLOWER_SHARE = 0.002, 0.15  # of the mask's area: a smaller part is noise, a larger one no flower


def without_flower(mask: Mask, color_rgb: Pixels, outline: Mask | None = None) -> Mask:
    """Return a fruit's mask without the withered flower at its end.

    A flower is a coherent part that is much redder than the fruit's median colour, as pale tips of
    vivid fruit are, too.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        The fruit, perhaps with its flower.
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    outline : ndarray of bool, shape (H, W), optional
        Another outline of the fruit, by a network that leaves flowers out: what is in it stays.

    Returns
    -------
    ndarray of bool, shape (H, W)
        The same mask where there is no such part.

    Examples
    --------
    >>> color, mask = np.zeros((40, 90, 3), np.uint8), np.zeros((40, 90), bool)
    >>> mask[10:30, 5:80] = True
    >>> color[mask] = (60, 120, 50)
    >>> color[14:26, 72:80] = (220, 150, 60)
    >>> bool(without_flower(mask, color)[20, 60]), bool(without_flower(mask, color)[20, 76])
    (True, False)
    >>> bool(without_flower(mask, color, outline=mask)[20, 76])
    True
    """
    import cv2

    window = mask_window(mask)
    if window is None:
        return mask
    inside = mask[window]
    scaled = np.ascontiguousarray(color_rgb[window]).astype(np.float32) / 255
    redness = cv2.cvtColor(scaled, cv2.COLOR_RGB2LAB)[..., 1]
    redder = inside & (redness > np.median(redness[inside]) + _FLOWER_REDNESS)
    if outline is not None:
        redder &= ~outline[window]
    if not redder.any():
        return mask
    square = np.ones((3, 3), np.uint8)
    opened = cv2.morphologyEx(redder.astype(np.uint8), cv2.MORPH_OPEN, square)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    least_px, most_px = (share * np.count_nonzero(inside) for share in _FLOWER_SHARE)
    parts = np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= least_px) + 1
    if parts.size == 0:
        return mask
    flower = cv2.dilate(np.isin(labels, parts).astype(np.uint8), square) > 0
    _, labels, stats, _ = cv2.connectedComponentsWithStats((inside & ~flower).astype(np.uint8))
    body = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if len(stats) > 1 else flower
    if np.count_nonzero(inside & ~body) > most_px:
        return mask
    cleaned = np.zeros_like(mask)
    cleaned[window] = inside & body
    return cleaned


_BOX_SIDE_PX, _BOX_FILL, _BOX_CORNER = 12, 0.95, 0.08


def is_box_mask(mask: Mask) -> bool:
    """Return whether a mask is a filled box, upright or rotated, instead of an outline.

    A fruit leaves the corners of its bounding rectangle empty, unless the edge of the picture cuts
    it: a mask that touches the edge does not count as a box.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Rectangles narrower than 12 pixels cannot be distinguished from fruit.

    Examples
    --------
    >>> mask = np.zeros((40, 60), bool)
    >>> mask[10:30, 5:55] = True
    >>> is_box_mask(mask)
    True
    >>> mask[10:13, 5:8] = False
    >>> is_box_mask(mask)
    False
    """
    import cv2

    if mask[[0, -1]].any() or mask[:, [0, -1]].any() or not mask.any():
        return False
    outlines, _ = cv2.findContours(
        mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    rectangle = cv2.minAreaRect(np.concatenate(outlines))
    sides_px = np.array(rectangle[1]) + 1.0  # from the pixels' centres to their edges
    if sides_px.min() < _BOX_SIDE_PX or mask.sum() < _BOX_FILL * sides_px.prod():
        return False
    corners = cv2.boxPoints(rectangle)
    steps = (np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners)
    inset = sum(step / np.linalg.norm(step, axis=1, keepdims=True) for step in steps)
    u, v = np.rint(corners + _BOX_CORNER * sides_px.min() * inset).astype(int).T
    return bool(mask[v, u].all())


def box_areas(boxes: Numbers) -> Array:
    """Compute the areas of boxes, shape (N, 4); 0 where one has no extent."""
    return np.asarray(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None).prod(axis=1), np.float64)


def _box_intersections(a: Numbers, b: Numbers) -> Array:
    """Compute the intersection area of every pair of boxes.

    Parameters
    ----------
    a, b : ndarray, shape (N, 4) and (M, 4)
        Boxes x1, y1, x2, y2.

    Returns
    -------
    ndarray of float64, shape (N, M)
    """
    lower = np.maximum(a[:, None, :2], b[None, :, :2])
    upper = np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.asarray(np.clip(upper - lower, 0, None).prod(axis=2), np.float64)


def box_ious(a: Numbers, b: Numbers) -> Array:
    """Compute the intersection over union of every pair; 0 where neither has an area.

    Parameters
    ----------
    a, b : ndarray, shape (N, 4) and (M, 4)
        Boxes x1, y1, x2, y2.

    Returns
    -------
    ndarray of float64, shape (N, M)

    Examples
    --------
    >>> box_ious(np.array([[0.0, 0, 2, 1]]), np.array([[1.0, 0, 3, 1], [5, 5, 6, 6]])).round(3)
    array([[0.333, 0.   ]])
    """
    shared = _box_intersections(a, b)
    union = box_areas(a)[:, None] + box_areas(b)[None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def box_iou(a: Numbers, b: Numbers) -> float:
    """Compute the intersection over union of two boxes.

    Examples
    --------
    >>> box_iou(np.array([0.0, 0, 2, 1]), np.array([1.0, 0, 3, 1])) == 1 / 3
    True
    """
    return float(box_ious(np.asarray(a)[None], np.asarray(b)[None])[0, 0])


def share_inside(boxes: Numbers, regions: Numbers) -> Array:
    """Compute the largest share of each box's area that lies within one of the regions.

    Parameters
    ----------
    boxes, regions : ndarray, shape (N, 4) and (M, 4)
        Boxes x1, y1, x2, y2.

    Returns
    -------
    ndarray of float64, shape (N,)

    Examples
    --------
    >>> share_inside(np.array([[0.0, 0, 4, 1]]), np.array([[1.0, 0, 9, 9]]))
    array([0.75])
    """
    shared = _box_intersections(boxes, regions).max(axis=1, initial=0.0)
    return np.asarray(shared / np.maximum(box_areas(boxes), 1e-12))


def suppress(boxes: Numbers, scores: Numbers, classes: Numbers, iou: float) -> Ints:
    """Return the boxes kept by non-maximum suppression within each class.

    Parameters
    ----------
    boxes : ndarray, shape (N, 4)
        x1, y1, x2, y2.
    scores : ndarray, shape (N,)
        Above 0, at most 1.
    classes : ndarray of int, shape (N,)
    iou : float
        Overlap above which the lower score is dropped.

    Returns
    -------
    ndarray of int
        Indices of the boxes kept, best first.

    Examples
    --------
    >>> boxes = np.array([[2.0, 0, 6, 4], [0, 0, 4, 3.9], [0, 0, 4, 4], [0, 0, 4, 4]])
    >>> suppress(boxes, np.array([0.7, 0.8, 0.9, 0.6]), np.array([0, 0, 0, 1]), 0.7).tolist()
    [2, 0, 3]
    """
    import cv2

    # OpenCV separates classes by shifting their boxes, which must begin at 0.
    corners, opposite = np.split(boxes.astype(np.float64), 2, axis=1)
    rectangles = np.concatenate(
        [corners - corners.min(axis=0, initial=0.0), opposite - corners], axis=1
    )
    chosen = cv2.dnn.NMSBoxesBatched(
        rectangles.tolist(), scores.tolist(), classes.tolist(), score_threshold=0, nms_threshold=iou
    )
    return np.array(chosen, np.intp)
