"""Estimate a camera's depth scale and lens distortion from pictures of a printed square grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cucumbervision.arrays import Array, Array32, Pixels
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics

LEAST_CROSSINGS = 40
_LINE_PX, _BLUR_PX, _NEIGHBOUR_PX = 13, 2.0, 51  # maximum line width, blur and neighbourhood
_CONTRAST = 0.35  # minimum contrast relative to the strongest crossing nearby
_STEP_ERROR, _HOMOGRAPHY_ERROR_PX, _LEAST_SEED = 0.12, 3.0, 16
_SQUARE_ERROR = 0.1  # tolerance of the ratio of sides and of the cosine between them
_MATCH_ERROR = 0.14, 0.14, 0.085, 0.085, 0.085  # by iteration, relative to a cell's diagonal
_OFF_PLANE, _OUTLIER = 0.02, 3.0
_MISCOUNTED = 0.1  # maximum deviation from the median depth scale; diagonals are 41 % off


@dataclass(frozen=True, eq=False)
class GridFit:
    """Result of `fit_grid`.

    Parameters
    ----------
    coefficients : ndarray of float64, shape (5,)
        Brown-Conrady k1, k2, p1, p2, k3.
    residual_px : float
        Median reprojection error of the crossings.
    ratios : ndarray of float64, shape (N,)
        Median ratio of measured to true depth of each picture.
    """

    coefficients: Array
    residual_px: float
    ratios: Array


@dataclass(frozen=True, eq=False)
class _GridPicture:
    """Candidate crossings in one picture, and the initial grid cells."""

    crossings_px: Array
    cells: Array
    pixels: Array
    depth_m: Array32


def fit_grid(captures: Sequence[Capture], spacing_m: float) -> GridFit | None:
    """Fit lens distortion and depth scale to captures of one camera.

    The focal length is not fitted, because on a plane it is nearly degenerate with the distance. If
    it is wrong, the depth scale still corrects lengths across the view.

    Parameters
    ----------
    captures : sequence of Capture
        Captures of the grid, which may be partly occluded; captures without a grid are skipped.
    spacing_m : float
        Distance between the grid lines, metres.

    Returns
    -------
    GridFit or None
        None if no capture shows a grid.
    """
    if not captures:
        return None
    camera = captures[0].intrinsics
    grids = [grid for capture in captures if (grid := _find_grid(capture)) is not None]
    fit, grids = _fitted(grids, camera, spacing_m)
    if fit is None:
        return None
    # If glare interrupts the lines, crossings may be matched along the diagonals.
    alike = np.abs(fit.ratios / np.median(fit.ratios) - 1) < _MISCOUNTED
    if alike.all() or not alike.any():
        return fit
    return _fitted([grid for grid, k in zip(grids, alike, strict=True) if k], camera, spacing_m)[0]


def _fitted(
    grids: list[_GridPicture], camera: Intrinsics, spacing_m: float
) -> tuple[GridFit | None, list[_GridPicture]]:
    # Return the fit and the grids it uses.
    import cv2

    lens = np.zeros(5)
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS
        | cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_FIX_FOCAL_LENGTH
        | cv2.CALIB_FIX_K3
    )
    found = [(grid, grid.cells, _pose(grid, camera.matrix)) for grid in grids]
    for error in _MATCH_ERROR:
        every = (
            (grid, *_matched(grid, cells, pose, camera.matrix, lens, error))
            for grid, cells, pose in found
        )
        matched = [grid for grid in every if len(grid[1]) >= LEAST_CROSSINGS]
        if not matched:
            return None, []
        _, _, coefficients, turns, shifts, *_ = cv2.calibrateCameraExtended(
            [_flat(cells).astype(np.float32) for _, cells, _ in matched],
            [pixels.astype(np.float32).reshape(-1, 1, 2) for _, _, pixels in matched],
            camera.size,
            camera.matrix,
            np.zeros(5),
            flags=flags,
        )
        lens = np.asarray(coefficients, float).ravel()[:5]
        found = [
            (grid, cells, (np.asarray(turn, float), np.asarray(shift, float)))
            for (grid, cells, _), turn, shift in zip(matched, turns, shifts, strict=True)
        ]
    off, ratios = [], []
    for (grid, cells, px), (_, _, pose) in zip(matched, found, strict=True):
        off.append(np.linalg.norm(_projected(cells, pose, camera.matrix, lens) - px, axis=1))
        read = _depth_ratios(grid.depth_m, cells, px, pose)
        ratios.append(float(np.nanmedian(read)) / spacing_m)
    fit = GridFit(lens, float(np.median(np.concatenate(off))), np.array(ratios))
    return fit, [grid for grid, _, _ in matched]


def _find_grid(capture: Capture) -> _GridPicture | None:
    import cv2
    from scipy.spatial import cKDTree

    gray = np.asarray(cv2.cvtColor(capture.color, cv2.COLOR_RGB2GRAY), np.uint8)
    peaks = _crossing_peaks(gray)
    if len(peaks) < LEAST_CROSSINGS:
        return None
    tree, done, best = cKDTree(peaks), set[int](), (0, peaks, peaks)
    for first in range(len(peaks)):
        if first in done:
            continue
        lattice = _lattice(peaks, tree, first)
        if len(lattice) < _LEAST_SEED:
            continue
        done.update(lattice.values())
        cells, pixels = np.array(list(lattice), float), peaks[list(lattice.values())]
        homography, inside = cv2.findHomography(cells, pixels, cv2.RANSAC, _HOMOGRAPHY_ERROR_PX)
        plane = np.asarray(homography, float)
        if plane.size != 9 or not _is_square(plane, capture.intrinsics):
            continue
        fits = np.asarray(inside).ravel() > 0
        if fits.sum() > max(best[0], _LEAST_SEED):
            best = int(fits.sum()), cells[fits], pixels[fits]
    if not best[0]:
        return None
    start = peaks.astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
    refined = np.asarray(cv2.cornerSubPix(gray, start, (7, 7), (-1, -1), stop), float)
    return _GridPicture(refined.reshape(-1, 2), best[1], best[2], capture.depth_m)


def _crossing_peaks(gray: Pixels) -> Array:
    """Return candidate crossings of thin bright or dark lines, in whole pixels.

    At a crossing, the second derivative of brightness is large in every direction; on a line, only
    across it.
    """
    import cv2

    kernel = np.ones((_LINE_PX, _LINE_PX), np.uint8)
    kinds = [cv2.morphologyEx(gray, way, kernel) for way in (cv2.MORPH_TOPHAT, cv2.MORPH_BLACKHAT)]
    lines = np.asarray(max(kinds, key=lambda kind: float(np.mean(kind))), np.float32)
    smooth = cv2.GaussianBlur(lines, (0, 0), _BLUR_PX)
    xx, yy, xy = (
        np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3))
        for order in ((2, 0), (0, 2), (1, 1))
    )
    bend = -((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    window = np.ones((_NEIGHBOUR_PX, _NEIGHBOUR_PX), np.uint8)
    usual = np.asarray(cv2.blur(cv2.dilate(bend, window), window.shape))
    highest = np.asarray(cv2.dilate(bend, np.ones((9, 9), np.uint8)))
    v, u = np.nonzero((bend == highest) & (bend > _CONTRAST * usual) & (bend > 0))
    return np.stack([u, v], axis=1).astype(np.float64)


def _lattice(peaks: Array, tree: cKDTree, first: int) -> dict[tuple[int, int], int]:
    """Return the peaks connected to the first one by nearly constant steps, by grid cell."""
    reaches, neighbours = (np.asarray(column) for column in tree.query(peaks[first], k=9))
    ways = [
        peaks[k] - peaks[first]
        for reach, k in zip(reaches[1:], neighbours[1:], strict=True)
        if tree.query(2 * peaks[first] - peaks[k])[0] < _STEP_ERROR * reach
    ]
    if not ways:
        return {}
    areas = [abs(float(ways[0][0] * w[1] - ways[0][1] * w[0])) for w in ways]
    sides = [float(np.linalg.norm(ways[0]) * np.linalg.norm(w)) for w in ways]
    across = [w for w, area, of in zip(ways, areas, sides, strict=True) if area > 0.5 * of]
    if not across:
        return {}
    indices, steps = {(0, 0): first}, {(0, 0): (ways[0], across[0])}
    taken, queue = {first}, [(0, 0)]
    for cell in queue:
        along, aside = steps[cell]
        for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            neighbour = cell[0] + i, cell[1] + j
            if neighbour in indices:
                continue
            step = i * along + j * aside
            off, k = tree.query(peaks[indices[cell]] + step)
            if off < _STEP_ERROR * np.linalg.norm(step) and int(k) not in taken:
                indices[neighbour] = int(k)
                taken.add(int(k))
                step = peaks[int(k)] - peaks[indices[cell]]
                steps[neighbour] = (i * step, aside) if i else (along, j * step)
                queue.append(neighbour)
    return indices


def _is_square(homography: Array, camera: Intrinsics) -> bool:
    sides = (np.linalg.inv(camera.matrix) @ homography)[:, :2]
    lengths = np.linalg.norm(sides, axis=0)
    cosine = abs(float(sides[:, 0] @ sides[:, 1])) / float(lengths[0] * lengths[1])
    return abs(float(lengths[0] / lengths[1]) - 1) < _SQUARE_ERROR and cosine < _SQUARE_ERROR


def _flat(cells: Array) -> Array:
    return np.column_stack([cells, np.zeros(len(cells))])


_Pose = tuple["Array", "Array"]


def _pose(seen_grid: _GridPicture, matrix: Array) -> _Pose:
    import cv2

    _, turn, shift = cv2.solvePnP(_flat(seen_grid.cells), seen_grid.pixels, matrix, np.zeros(5))
    return np.asarray(turn, float), np.asarray(shift, float)


def _projected(cells: Array, pose: _Pose, matrix: Array, lens: Array) -> Array:
    import cv2

    return np.asarray(cv2.projectPoints(_flat(cells), *pose, matrix, lens)[0], float).reshape(-1, 2)


def _matched(
    seen_grid: _GridPicture, cells: Array, pose: _Pose, matrix: Array, lens: Array, error: float
) -> tuple[Array, Array]:
    """Return the crossings, as cells and pixels, whose depth agrees with the grid's plane."""
    from scipy.spatial import cKDTree

    first_cell, end_cell = cells.min(axis=0) - 3, cells.max(axis=0) + 4
    axes = np.meshgrid(*map(np.arange, first_cell, end_cell))
    grid = np.stack(axes, axis=-1).reshape(-1, 2).astype(np.float64)
    expected = _projected(grid, pose, matrix, lens)
    diagonal = np.linalg.norm(_projected(grid + 1, pose, matrix, lens) - expected, axis=1)
    off, nearest = (
        np.asarray(column) for column in cKDTree(seen_grid.crossings_px).query(expected)
    )
    is_near = off < error * diagonal
    if not is_near.any():
        return grid[:0], expected[:0]
    pixels, off = seen_grid.crossings_px[nearest[is_near]], off[is_near]
    ratio = _depth_ratios(seen_grid.depth_m, grid[is_near], pixels, pose)
    level = np.abs(ratio / np.nanmedian(ratio) - 1) <= _OFF_PLANE
    is_crossing = level & (off <= max(_OUTLIER * float(np.median(off)), 0.5))
    return grid[is_near][is_crossing], pixels[is_crossing]


def _depth_ratios(depth_m: Array32, cells: Array, pixels: Array, pose: _Pose) -> Array:
    """Return the ratio of measured depth to that of the pose by cell; NaN with too few readings."""
    import cv2

    turn = np.asarray(cv2.Rodrigues(pose[0])[0], float)
    expected = (_flat(cells) @ turn.T + pose[1].ravel())[:, 2]
    ratios = np.full(len(cells), np.nan)
    for k, (u, v) in enumerate(np.rint(pixels).astype(int)):
        window = depth_m[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3]
        read = window[valid_depth(window)]
        if read.size > window.size // 4:
            ratios[k] = float(np.median(read)) / expected[k]
    return ratios
