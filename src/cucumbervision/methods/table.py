"""The table of methods, the data that they share, and how they are run on one fruit."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from cucumbervision.arrays import Array, Array32, Mask, Numbers
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import PluginError
from cucumbervision.fruit.masks import mask_window
from cucumbervision.methods.result import (
    Fruit,
    LengthDefinition,
    LengthKind,
    Measurement,
    MethodName,
    Reason,
    TraitValue,
)
from cucumbervision.plugins import Plugin, own, plugins
from cucumbervision.tube.compiled import OneThread
from cucumbervision.tube.shape import AlignedCloud, align_near

_STRIDE = 2  # pixels, of a box


def masked_points(depth_m: Array32, mask: Mask, intrinsics: Intrinsics) -> Array:
    """Deproject every pixel of a mask that has a valid reading.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Camera coordinates in metres (x right, y down, z forward; Eq. 4 of the paper), in row-major
        order of the pixels.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth = np.zeros((48, 64), np.float32)
    >>> depth[24, 38] = 0.5
    >>> camera = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> masked_points(depth, np.ones((48, 64), bool), camera).tolist()
    [[0.05, 0.0, 0.5]]
    """
    window = mask_window(mask)
    if window is None:
        return np.empty((0, 3))
    region = depth_m[window]
    v, u = np.nonzero(mask[window] & valid_depth(region))
    return _deproject(u + window[1].start, v + window[0].start, region[v, u], intrinsics)


def box_points(depth_m: Array32, box: Numbers, intrinsics: Intrinsics) -> Array:
    """Deproject every second pixel, in both directions, of a box that has a valid reading.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels; parts outside the picture are ignored.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Camera coordinates in metres.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> depth = np.full((48, 64), 0.5, np.float32)
    >>> camera = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> box_points(depth, np.array([9.5, 9.5, 19.5, 13.5]), camera).shape
    (10, 3)
    """
    x1, y1, x2, y2 = box_pixels(box, depth_m.shape)
    region = depth_m[y1:y2:_STRIDE, x1:x2:_STRIDE]
    v, u = np.nonzero(valid_depth(region))
    return _deproject(u * _STRIDE + x1, v * _STRIDE + y1, region[v, u], intrinsics)


def box_pixels(box: Numbers, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return the half-open range x1, y1, x2, y2 of pixels whose centres lie in a box.

    Parameters
    ----------
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    shape : tuple of int
        (H, W) of the picture; the range is clipped to it.

    Examples
    --------
    >>> box_pixels(np.array([-3.0, 1.5, 4.5, 99.0]), (10, 20))
    (0, 2, 5, 10)
    """
    height, width = shape
    edges = np.concatenate([np.ceil(box[:2]), np.floor(box[2:]) + 1])
    x1, y1, x2, y2 = np.clip(edges, 0, [width, height] * 2).astype(int).tolist()
    return x1, y1, x2, y2


def _deproject(u_px: Numbers, v_px: Numbers, z_m: Numbers, intrinsics: Intrinsics) -> Array:
    x, y = intrinsics.rays(u_px, v_px)
    return np.stack([x * z_m, y * z_m, z_m], axis=1)


GATE_M = 0.035

AVAILABLE = tuple(own("methods"))
"""Names of the package's own methods, in the order of the table."""


@dataclass(frozen=True, eq=False)
class Region:
    """The data of one fruit in a frame, with point clouds shared by several methods.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    intrinsics : Intrinsics
        The colour stream's.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    mask : ndarray of bool, shape (H, W), optional
        The fruit's pixels.
    keypoints : ndarray of float, shape (5, 3), optional
        u, v, visibility.
    """

    depth_m: Array32
    intrinsics: Intrinsics
    box: Numbers
    mask: Mask | None = None
    keypoints: Array | None = None

    @cached_property
    def mask_points_m(self) -> Array | None:
        """The mask's points in metres, shape (N, 3); None without a mask."""
        if self.mask is None:
            return None
        return masked_points(self.depth_m, self.mask, self.intrinsics)

    @cached_property
    def mask_near(self) -> AlignedCloud | None:
        """The mask's points after the depth gate, with principal axis; None without a mask."""
        points = self.mask_points_m
        return None if points is None else align_near(points, GATE_M)

    @cached_property
    def box_points_m(self) -> Array:
        """The box's points at stride 2 in metres, shape (N, 3)."""
        return box_points(self.depth_m, self.box, self.intrinsics)


class Method(Protocol):
    """Measures the length of a fruit.

    `measurement.methods.TableMethod` is one, and holds what else the table of methods says: what
    the method needs, and whether the selector may choose it. By default it never does: the method
    gets its column, and the length stays as it was.
    """

    @property
    def name(self) -> str:
        """The name, 'M7': the column is called after it, m7_cm."""
        ...

    @property
    def title(self) -> str:
        """What it is, in a few words."""
        ...

    @property
    def kind(self) -> LengthKind:
        """What its length is the length of."""
        ...

    def measure(self, region: Region, /) -> Measurement:
        """Return the length of a fruit in metres, or the reason why there is none.

        Parameters
        ----------
        region : Region
            The fruit's part of the frame: depth in metres, box, mask, keypoints, clouds.
        """
        ...


class Trait(Protocol):
    """A figure of a fruit beside its length: a function of capture and fruit.

    The name is that of the column, and ends with the unit where there is one: 'firmness_mm'.
    """

    @property
    def name(self) -> str:
        """The column."""
        ...

    @property
    def unit(self) -> str:
        """Of the column: cm, mm, mm2, ml, g; any other, or none, is written as it is."""
        ...

    @property
    def says(self) -> str:
        """What it is, in a few words."""
        ...

    def __call__(self, capture: Capture, fruit: Fruit, /) -> float | TraitValue | None:
        """Return the value in SI units; None or a `TraitValue` with the reason where there is none.

        Parameters
        ----------
        capture : Capture
            The frame.
        fruit : Fruit
            The fruit with its mask, fit and length.
        """
        ...


@dataclass(frozen=True)
class TableMethod:
    """A `Method` with its entries in the table of methods.

    Parameters
    ----------
    name : str
        Its name; `name.lower()` followed by '_cm' is its column.
    title : str
        Short description.
    kind : LengthKind
        Quantity that its length measures.
    measure : callable
        Takes a `Region`, and returns a `Measurement` of this name.
    needs : tuple of str
        Its inputs beside depth: 'box', 'mask', 'keypoints'.
    rank : int, optional
        Its place in the order of preference, the least first; it is never chosen without one.
    rank_compact : int, optional
        The same for a box that is less than 1.8 times as long as wide; `rank` if not given.
    least_points : int, optional
        It is chosen for a mask with at least so many valid depth readings; also without a mask if
        not given.
    is_paper : bool
        Whether it is one of the CucumberVision paper's, which `Selector.PAPER` chooses among.
    stands_in : bool
        Whether another method that it fell back on may be chosen in its place.
    color : str
        Of its line in pictures, '#RRGGBB'. The package's own have Okabe and Ito's palette, which
        colour-blind people can tell apart.

    Examples
    --------
    >>> method = TableMethod.of("M5")
    >>> method.title, str(method.kind), method.needs, method.rank
    ('medial arc spline', 'surface-arc', ('mask',), 20)
    """

    name: str
    title: str
    kind: LengthKind
    measure: Callable[[Region], Measurement]
    needs: tuple[str, ...] = ()
    rank: int | None = None
    rank_compact: int | None = None
    least_points: int | None = None
    is_paper: bool = False
    stands_in: bool = False
    color: str = "#999999"

    @classmethod
    def of(cls, method: str | Method) -> TableMethod:
        """Return a method by its name, or any `Method` as one.

        Raises
        ------
        KeyError
            If no method has the name.
        PluginError
            If it cannot be loaded, or is no method.
        """
        plugin = plugin_of(method)
        loaded = plugin.load() if isinstance(method, str) else method
        if isinstance(loaded, cls):
            return loaded
        try:
            return cls(str(loaded.name), str(loaded.title), LengthKind(loaded.kind), loaded.measure)
        except (AttributeError, ValueError) as error:
            raise plugin.error(f"is no method ({error})") from None

    def rank_for(self, mask_points: int | None, *, is_elongated: bool) -> int | None:
        """Return its rank for a mask with so many readings, or a box; None if it is not chosen."""
        least_points = self.least_points
        if least_points is not None and (mask_points is None or mask_points < least_points):
            return None
        return self.rank if is_elongated or self.rank_compact is None else self.rank_compact


def own_method(name: MethodName, measure: Callable[[Region], Measurement]) -> TableMethod:
    """Return one of the package's own methods, with its line of `methods.csv`."""
    text = Path(__file__).with_name("methods.csv").read_text(encoding="utf-8")
    line = next(line for line in csv.DictReader(text.splitlines()) if line["name"] == name)
    ranks = (int(line[k]) if line[k] else None for k in ("rank", "rank_compact", "least_points"))
    rank, rank_compact, least_points = ranks
    return TableMethod(
        name=str(name),
        title=line["title"],
        kind=LengthKind(line["kind"]),
        measure=measure,
        needs=(line["needs"],),
        rank=rank,
        rank_compact=rank_compact,
        least_points=least_points,
        is_paper=bool(line["is_paper"]),
        stands_in=bool(line["stands_in"]),
        color=line["color"],
    )


def plugin_of(method: str | Method) -> Plugin:
    """Return the line of the table of plug-ins that a method is.

    Raises
    ------
    KeyError
        If no method has the name.
    """
    if not isinstance(method, str):
        return Plugin.of("methods", method.measure, str(method.name))
    if method not in plugins("methods"):
        raise KeyError(f"no such method: {method}")
    return plugins("methods")[method]


def method_color(name: str) -> str:
    """Return the colour of a method's line, '#RRGGBB'; grey for one that is not installed here.

    Examples
    --------
    >>> method_color("M6"), method_color("no longer installed")
    ('#FFFFFF', '#999999')
    """
    try:
        return TableMethod.of(name).color
    except (KeyError, PluginError):
        return TableMethod.color


@OneThread()
def run_methods(
    region: Region, methods: Iterable[str | Method] = AVAILABLE
) -> dict[str, Measurement]:
    """Measure one fruit by each of the methods.

    M3 falls back on M2 below 50 valid pixels, M4 on M3 if an endpoint is missing, as `fallback` and
    `measured_by` of the measurement state.

    Parameters
    ----------
    region : Region
        The fruit.
    methods : iterable of str or Method
        Methods to run: names of the table, or methods of your own. Each is computed once, those of
        the table in its order.

    Returns
    -------
    dict of str to Measurement
        One for each method asked, by its name. That of another package's method which raised, or
        returned what is no length, has the reason 'plugin-failed' and the `error`.

    Raises
    ------
    KeyError
        For a name that is not in the table.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> mask = np.zeros((480, 640), bool)
    >>> mask[230:250, 220:420] = True
    >>> region = Region(depth, camera, np.array([219.5, 229.5, 419.5, 249.5]), mask)
    >>> for method, result in run_methods(region).items():
    ...     print(method, result.reason, result.fallback, result.measured_by)
    M1 ok () None
    M2 ok () None
    M3 ok () None
    M4 no-keypoints () None
    M5 ok () None
    M6 ok () None
    """
    chosen = {str(m) if isinstance(m, str) else str(m.name): m for m in methods}
    order = {name: number for number, name in enumerate(plugins("methods"))}
    names = sorted(chosen, key=lambda name: order.get(name, len(order)))
    return {name: _measured(region, chosen[name]) for name in names}


def _measured(region: Region, method: str | Method) -> Measurement:
    plugin = plugin_of(method)
    try:
        measurement: Measurement = plugin.call(TableMethod.of(method).measure, region)
        return measurement if plugin.is_own else plugin.call(_checked, plugin.name, measurement)
    except PluginError as error:
        return Measurement(plugin.name, reason=Reason.PLUGIN_FAILED, error=error)


def _checked(name: str, measurement: Measurement) -> Measurement:
    """Return another package's measurement under the name of its line.

    Raises
    ------
    ValueError
        If its length is none.
    """
    length_m = None if measurement.length_m is None else float(measurement.length_m)
    if length_m is not None and not 0 < length_m < np.inf:
        raise ValueError(f"a length of {length_m!r} m")
    if length_m is not None and measurement.kind not in (*LengthKind, *LengthDefinition):
        raise ValueError(f"a length of kind {measurement.kind!r}")
    return replace(measurement, method=name, length_m=length_m)


def or_else(failed: Measurement, method: str, substitute: Measurement) -> Measurement:
    """Return the substitute of a failed measurement under its name, or why there is none."""
    path = (f"{failed.method}:{failed.reason}", *substitute.fallback)
    if substitute.length_m is None:
        return replace(failed, fallback=(*path, f"{method}:{substitute.reason}"))
    return replace(
        substitute,
        method=failed.method,
        fallback=path,
        measured_by=substitute.measured_by or method,
    )
