"""One fruit: its picture, measurements, 3D, ruler, all its views; accept, reject, correct."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlencode, urljoin

import numpy as np
import streamlit as st
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.errors import CucumberVisionError
from cucumbervision.fruit.instance import MaskSource
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.fruit.masks import mask_window
from cucumbervision.run.fields import FIELDS
from cucumbervision_greenhouse import fruit_pictures, resources, round_view
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.language import counted, decimal_words, marked, plain, sentence
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.accuracy import hand_file, hand_lengths
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.adding import stored_calibration
from cucumbervision_greenhouse.rounds.fruit_table import least_sure_first
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import DetectionDetail, FruitRow, Verdict


def show(walk: RoundView, key: str, listed: Sequence[FruitRow]) -> None:
    """Draw a fruit in place of the list; `listed` are the fruit that its filters leave."""
    detail = resources.store().detection(key)
    following = _head(walk, key, listed)
    with st.container(key="halves"):  # under each other where a tablet is held upright
        picture_side, right = st.columns([3, 2], gap="medium")
    # Each in its own container, so that elements above do not move the buttons.
    with right.container():
        _figures(walk, detail)
    with right.container():
        _verdict(walk, detail, following)
    with picture_side:
        _pictures(detail)
    _show_stops(walk, detail.view)
    _corrections(detail)


def _neighbours(
    walk: RoundView, key: str, listed: Sequence[FruitRow]
) -> tuple[str | None, str | None]:
    """Return the fruit before and after one in the list.

    One that has just left the list, since it was judged or deleted, keeps its place of the walk.
    """
    keys = [view.key for view in listed]
    if key not in keys:
        order = {fruit: number for number, fruit in enumerate(walk.grades)}
        later = (k for k, later_key in enumerate(keys) if order[later_key] > order[key])
        keys.insert(next(later, len(keys)), key)
    index = keys.index(key)
    return (keys[index - 1] if index else None), next(iter(keys[index + 1 :]), None)


def _head(walk: RoundView, key: str, listed: Sequence[FruitRow]) -> str | None:
    """Draw the way to other fruit, and return the next one of the list that nobody checked."""
    before, after = _neighbours(walk, key, listed)
    unsure = [view.key for view in least_sure_first(walk.fruit)]
    following = unsure.index(key) + 1 if key in unsure else 0
    next_unsure = next((k for k in (*unsure[following:], *unsure[:following]) if k != key), None)

    def go(to: str | None) -> None:
        page_elements.name_in_address("fruit", to)
        st.session_state.pop("ruler", None)

    with st.container(horizontal=True, gap="small", key="fruit_head"):
        page_elements.button(st, _("All fruit"), "arrow_back", go, None, shortcut="esc")
        for label, target, icon, shortcut in (
            (_("Previous"), before, "chevron_left", "left"),
            (_("Next"), after, "chevron_right", "right"),
            (_("Next unsure"), next_unsure, "help", "U"),
        ):
            how: dict[str, Any] = {"disabled": target is None, "key": f"{icon}_{key}"}
            page_elements.button(st, label, icon, go, target, shortcut=shortcut, **how)
    keys = [view.key for view in listed]
    place = keys.index(key) + 1 if key in keys else 0
    later = (*listed[place:], *listed[:place])
    return next((x.key for x in later if x.verdict is None and x.key != key), None)


def _figures(walk: RoundView, detail: DetectionDetail) -> None:
    record = next(fruit for fruit in walk.best if fruit.key == detail.view.key)
    units, graded_fruit = resources.settings().units, walk.grades[record.key]
    by_hand = hand_lengths(hand_file(resources.where(), walk.key), [record]).get(record.key)
    kind = texts.kind_words(None if record.length is None else str(record.length.kind))
    interval = texts.interval_words(record, units, _("Likely between {low} and {high}"))
    page_elements.metrics({kind: texts.length_words(record, units)}, {kind: interval or ""})
    st.markdown(f"**{sentence(texts.grade_words(graded_fruit))}**")
    traits = {
        _("Thickest"): None
        if not record.diameter_max_m
        else f"{1000 * record.diameter_max_m:.0f} mm",
        _("Weight, about"): None if not graded_fruit.mass_g else f"{graded_fruit.mass_g:.0f} g",
        _("Distance"): units.text(record.distance_m),
        _("Measured by hand"): " / ".join(units.text(x) for x in by_hand or () if x is not None),
        _("Outline by"): record.mask_source and _(MaskSource(record.mask_source).words),
        _("Hidden by leaves"): None
        if record.hidden_share is None
        else f"{100 * record.hidden_share:.0f} %",
    }
    st.write(" · ".join(f"{name}: {value}" for name, value in traits.items() if value))
    if words := texts.remarks(record, units):
        st.caption(sentence(f"{words}."))
    with st.expander(_("Details"), icon=":material/list:"):
        for rule in graded_fruit.rules:
            st.caption(plain(rule))
        site = stored_calibration(detail.stop)
        name = _("none") if site is None else plain(site.name)
        st.caption(_("Measured with the calibration: {name}").format(name=name))
        if record.method:
            st.caption(_("Method: {name}").format(name=record.method))
        if record.fallback:
            st.caption(_("Methods tried first: {methods}").format(methods=plain(record.fallback)))
        page_elements.table(figure_lines(record))


def figure_lines(record: FruitRow) -> list[dict[str, str]]:
    """Return a line with description and value for each stored figure of a fruit.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> figure_lines(FruitRow(1, diameter_max_m=0.0412))[-1]
    {'What': 'Largest diameter', 'Value': '41.2 mm'}
    """
    lines = []
    for column in FIELDS:
        cell = column.cell(getattr(record, column.si_name, None), column.digits)
        if column.type == "number" and cell is not None and not column.name.startswith("box_"):
            value = f"{decimal_words(f'{cell:g}')} {column.unit}".strip()
            says = _(column.says)
            lines.append({_("What"): says[0].upper() + says[1:], _("Value"): value})
    return lines


def _verdict(walk: RoundView, detail: DetectionDetail, following: str | None) -> None:
    key, verdict_before, store = detail.view.key, detail.view.verdict, resources.store()
    is_picked = detail.view.picked_s is not None

    def mark(verdict: Verdict | None) -> None:
        page_elements.judge(detail.view.round_key, key, verdict)
        if verdict is not None and following is not None:  # reviewing goes on
            page_elements.name_in_address("fruit", following)
        elif verdict is not None:
            st.toast(_("All fruit of this list are checked."), icon=":material/done_all:")

    def pick() -> None:
        store.unpick([key]) if is_picked else store.pick([key])

    with st.container(horizontal=True, key="verdict"):
        for verdict, name, done, icon, shortcut in (
            (Verdict.ACCEPTED, _("Accept"), _("Accepted"), "check", "A"),
            (Verdict.REJECTED, _("Not a fruit"), _("Marked: not a fruit"), "delete", "X"),
        ):
            how = {"shortcut": shortcut}
            # Keyed by the fruit, so that a press acts on the fruit on the screen, not on the next.
            if verdict_before is verdict:
                page_elements.button(
                    st, done, icon, mark, None, type="primary", key=f"clear_{key}", **how
                )
            else:
                page_elements.button(st, name, icon, mark, verdict, key=f"{verdict}_{key}", **how)
        words, name = (_("Not picked"), "unpick") if is_picked else (_("Picked"), "pick")
        page_elements.button(st, words, "shopping_basket", pick, key=f"{name}_{key}", shortcut="P")
    with st.container(horizontal=True, vertical_alignment="center"):
        checked = sum(view.verdict is not None for view in walk.best)
        words = _("{n} of {all} checked").format(n=checked, all=len(walk.best))
        st.caption(words, width="stretch")
        page_elements.draw_undo(detail.view.round_key)
    address = f"/results?{urlencode(page_elements.here(fruit=key))}"
    with st.popover(_("Send a link to this fruit"), icon=":material/link:", width="stretch"):
        st.code(urljoin(st.context.url or "", address), language=None)


def _pictures(detail: DetectionDetail) -> None:
    try:
        capture = round_view.capture_of(detail.stop, detail.capture)
    except CucumberVisionError as error:
        st.warning(plain(error), icon=":material/broken_image:")
        return
    # Thousands of points are sent, and drawn by the tablet, only while somebody looks at them.
    picture_tab, turned = st.tabs([_("Picture"), "3D"], key="fruit_tabs", on_change="rerun")
    with picture_tab:
        _picture(detail, capture)
    if turned.open:
        with turned:
            _cloud(capture, detail.view)


def _cloud(capture: Capture, record: FruitRow) -> None:
    deck = point_cloud(capture, record)
    if deck is None:
        st.info(_("There is no depth on this fruit to show in 3D."))
        return
    with st.container(key="point_cloud"):
        st.pydeck_chart(deck, height=_CLOUD_PX)
    st.caption(
        _(
            "Depth points (surroundings pale), rings of the fitted tube in blue, its axis in "
            "white, its ends in yellow, the place to cut in orange; the bar is 5 cm long. Drag to "
            "turn, pinch or wheel to zoom."
        )
    )


def _picture(detail: DetectionDetail, capture: Capture) -> None:
    view, units = detail.view, resources.settings().units
    depth, words = fruit_pictures.depth_picture(capture.depth_m, units)
    ruler, key = st.session_state.get("ruler"), f"fruit_{view.key}"

    def corrected() -> None:
        st.session_state[f"correction_{key}"] = st.session_state[key].corrected

    action = st.session_state.get(f"correction_{key}")
    outcome = _("Saved: measured with this outline. 'Undo' removes it.")
    data = {
        "images": {
            _("Colour"): fruit_pictures.as_data_url(capture.color),
            _("Depth"): fruit_pictures.as_data_url(depth),
        },
        "width": capture.width,
        "height": capture.height,
        "layers": [*fruit_pictures.fruit_layers(view, capture.intrinsics), *_others(detail)],
        "bar": fruit_pictures.scale_bar(capture.intrinsics, view.distance_m, units),
        "tools": ["ruler", "point", "box"],
        "rulerText": ruler or "",
        "title": _("Fruit {number} of {capture}").format(number=view.fruit, capture=view.capture),
        "focus": [view.box_x1_px, view.box_y1_px, view.box_x2_px, view.box_y2_px],
        **{"stop": view.stop_key, "capture": view.capture, "fruit": view.key},
        "adds": st.session_state.get("adds_fruit", False),
        "job": action,
        "told": outcome if action is not None else "",
    }
    # The page reads the ruler; a callback is needed for the component to send it.
    acts = {"on_ruler_change": lambda: None, "on_corrected_change": corrected}
    drawn = page_elements.component("picture")(key=key, data=data, **acts)
    name = plain(view.capture)
    if capture.simulated:
        name = _("{capture}, computer-made example").format(capture=name)
    st.caption(_("{capture}. Depth: {range}.").format(capture=name, range=words))
    if drawn.ruler:
        x1, y1, x2, y2 = (float(x) for x in drawn.ruler)
        length_m = fruit_pictures.ruler_m(capture, (x1, y1), (x2, y2))
        text = units.text(length_m) if length_m is not None else _("no depth there")
        st.session_state["ruler"] = text
        st.rerun()
    if ruler:
        st.markdown(_("Ruler: **{length}**, straight distance").format(length=ruler))
    st.toggle(
        _("Tap or draw a box to add a missed fruit"),
        key="adds_fruit",
        help=_("Off: this corrects the outline of this fruit."),
    )
    _accept_others(detail)


def _others(detail: DetectionDetail) -> list[dict[str, Any]]:
    """Return the other fruit of the picture as a layer, so that one that was added is seen."""
    neighbours = [
        view
        for view in _of_picture(detail.view)
        if view.key != detail.view.key and view.verdict is not Verdict.REJECTED
    ]
    names = dict.fromkeys((view.key for view in neighbours), marked("Other fruit"))
    return fruit_pictures.stop_layers(detail.capture, neighbours, names, resources.settings().units)


def _of_picture(view: FruitRow) -> list[FruitRow]:
    """Return all fruit of the picture that a view is of."""
    return [
        detection
        for detection in resources.store().detections(view.round_key, view.stop_key, shapes=True)
        if detection.capture == view.capture
    ]


def _accept_others(detail: DetectionDetail) -> None:
    view = detail.view

    def accept() -> None:
        if unjudged := [x.key for x in _of_picture(view) if x.verdict is None]:
            resources.store().set_verdict(unjudged, Verdict.ACCEPTED)

    label = _("Accept the rest of this picture")
    page_elements.button(st, label, "done_all", accept, key=f"rest_{view.key}")


def _corrections(detail: DetectionDetail) -> None:
    if detail.log:
        with st.expander(_("Corrections"), icon=":material/history:"):
            for action in detail.log:
                when = texts.round_day(action.at_s)
                undone = f" ({_('undone')})" if action.undone else ""
                st.write(plain(f"{when}, {action.by or _('unnamed')}: {action.kind}{undone}"))


def _show_stops(walk: RoundView, fruit: FruitRow) -> None:
    """Draw the views of a fruit, the representative one first; nothing if there is only one."""
    units = resources.settings().units
    of_fruit = [view for view in walk.content.views if view.group == fruit.group]
    views = sorted(of_fruit, key=lambda view: not view.best)
    if len(views) < 2:
        return
    line = next((x for x in walk.fruit if x.group == fruit.group), None)
    st.markdown(f"**{counted(len(views), 'Seen {n} time', 'Seen {n} times')}**")
    chosen = _("representative") if line is None else _("best view")

    def words(view: FruitRow) -> str:
        best = f" · {chosen}" if view.best else ""
        return f"{texts.step_words(view.step)}: {_length(view, units)}{best}"

    page_elements.pictures(views, words)
    if line is not None:
        st.caption(f"{_('All that show it whole, together')}: {_length(line, units)}")


def _length(record: FruitRow, units: Units) -> str:
    words = texts.length_words(record, units)
    interval = texts.interval_words(record, units)
    return f"{words} ({interval})" if interval else words


_POINTS, _RINGS, _RING_POINTS = 3500, 16, 20
_MARGIN_PX = 12
_SLAB_M = 0.08  # points farther in front of or behind the fruit are left out
_CLOUD_PX = 420
_MOST_PERCENT = 97
_RING_COLOR, _AXIS_COLOR = (86, 180, 233), (255, 255, 255)
_ENDS = {"stem": (240, 228, 66), "blossom": (240, 228, 66), "cut": (213, 94, 0)}


def point_cloud(capture: Capture, record: FruitRow) -> Any:
    """Return a fruit's depth points and the fitted tube as a scene that can be rotated.

    Parameters
    ----------
    capture : Capture
        The frame.
    record : FruitRow
        The fruit, with mask and methods.

    Returns
    -------
    pydeck.Deck or None
        In millimetres about the fruit's middle, y up and z towards the camera: the fruit's points
        in their colours, what is near it paler, rings and axis of the tube, its two ends, the place
        to cut, and a bar of 5 cm. None where the fruit has no mask or no depth.
    """
    import pydeck

    if record.mask is None:
        return None
    mask = decode_rle(record.mask, capture.height, capture.width)
    readings, window = valid_depth(capture.depth_m), mask_window(mask, _MARGIN_PX)
    inside = mask & readings
    if window is None or not inside.any():
        return None
    around = np.zeros_like(mask)
    slab = np.abs(capture.depth_m - np.median(capture.depth_m[inside])) < _SLAB_M
    around[window] = (readings & slab & ~mask)[window]
    points, colors = _sample(capture, inside, _POINTS)
    surroundings, pale = _sample(capture, around, _POINTS // 3)
    middle = np.median(points, axis=0)

    def at_mm(place_m: Any) -> list[Any]:
        placed: list[Any] = np.round(1000 * (place_m - middle) * (1, -1, -1), 1).tolist()
        return placed

    lines = [(at_mm(ring), _RING_COLOR, 0.5) for ring in _tube_rings(record)]
    if lines:
        lines.append((at_mm(np.array(record.path_m)), _AXIS_COLOR, 1.5))
    # Readings at the outline that lie far behind would make the fruit small.
    reach_mm = np.percentile(np.abs(at_mm(points)), _MOST_PERCENT, axis=0).tolist()
    lines.append(([[x, -reach_mm[1] - 15, 0.0] for x in (-25.0, 25.0)], _AXIS_COLOR, 2.0))
    places = [(points, colors), (surroundings, pale // 2 + 90)]
    dots = [
        {"at": place, "color": color}
        for at_m, colors in places
        for place, color in zip(at_mm(at_m), colors.tolist(), strict=True)
    ]
    ends = {name: [getattr(record, f"{name}_{axis}_m") for axis in "xyz"] for name in _ENDS}
    marks = [
        {"at": at_mm(np.array(at_m)), "color": _ENDS[name]}
        for name, at_m in ends.items()
        if None not in at_m
    ]
    how: dict[str, Any] = {"get_position": "at", "get_color": "color", "material": False}
    how["size_units"] = "'common'"
    width = {"get_width": "width", "width_units": "'common'", "width_min_pixels": 1}
    paths = [dict(zip(("path", "color", "width"), line, strict=True)) for line in lines]
    layers = [
        pydeck.Layer("PointCloudLayer", dots, point_size=0.6, **how),
        pydeck.Layer("PointCloudLayer", marks, point_size=2.5, **how),
        pydeck.Layer(
            "PathLayer", paths, get_path="path", get_color="color", billboard=True, **width
        ),
    ]
    zoom = math.log2(_CLOUD_PX / (2.8 * max(reach_mm)))
    turned = pydeck.ViewState(target=[0, 0, 0], rotation_x=15, rotation_orbit=-30, zoom=zoom)
    view = pydeck.View("OrbitView", orbit_axis="Y", controller=True)
    # No map provider, so that no other machine is contacted.
    return pydeck.Deck(layers, [view], initial_view_state=turned, map_provider=None, map_style=None)


def _tube_rings(record: FruitRow) -> NDArray[np.float64]:
    """Return circles about the axis of the fitted tube, as closed lines of points.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> axis = [(0.01 * k, 0.0, 0.5) for k in range(16)]
    >>> rings = _tube_rings(FruitRow(1, path_m=axis, diameter_m=(0.04,) * 16))
    >>> rings.shape, round(float(np.linalg.norm(rings[3, 0] - axis[3])), 6)
    ((16, 21, 3), 0.02)
    """
    if not record.diameter_m:
        return np.zeros((0, _RING_POINTS + 1, 3))
    axis_m = np.array(record.path_m, np.float64)
    chosen = np.unique(np.linspace(0, len(axis_m) - 1, _RINGS).round().astype(int))
    ahead = np.gradient(axis_m, axis=0)[chosen]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    # A circle may start at any vector that is not parallel to the axis.
    normal = np.cross(ahead, np.eye(3)[np.abs(ahead).mean(axis=0).argmin()])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn = np.linspace(0, 2 * np.pi, _RING_POINTS + 1)[:, None]
    around = np.cos(turn) * normal[:, None] + np.sin(turn) * np.cross(ahead, normal)[:, None]
    rings: NDArray[np.float64] = axis_m[chosen, None] + (
        np.array(record.diameter_m)[chosen, None, None] / 2 * around
    )
    return rings


def _sample(
    capture: Capture, where: NDArray[np.bool_], limit: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the 3D points and colours of at most about `limit` pixels."""
    v, u = np.nonzero(where)
    v, u = (x[:: max(1, len(v) // limit)] for x in (v, u))
    z = capture.depth_m[v, u].astype(np.float64)
    x, y = capture.intrinsics.rays(u.astype(np.float64), v.astype(np.float64))
    return np.stack([x * z, y * z, z], axis=1), capture.color[v, u]
