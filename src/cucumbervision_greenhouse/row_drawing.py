"""The row as it hangs: one SVG, to scale, from the table of a round's fruit."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import pairwise

import numpy as np

from cucumbervision.arrays import Array
from cucumbervision.crop.grades import UNDECIDED, Grade, class_name
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.fruit_pictures import PICTURE_FILES, class_color
from cucumbervision_greenhouse.language import counted, number_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.rounds.walking import stored_pose
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import FruitRow, StopRecord

Box = tuple[float, float, float, float]

_REACH_MM = 500  # along the row: a camera shows the fruit this far from its stop
_EDGE_MM, _TEXT_MM, _APART_MM = 120, 34, 30
_USUAL_M, _USUAL_DIAMETER_M = 0.2, 0.04  # of a fruit that was not measured
_AROUND = (1 - np.cos(np.linspace(0, np.pi, 11))) / 2  # points along a fruit, dense at its ends
_STEPS_M = {"cm": (0.2, 0.5), "in": (0.3048, 0.6096)}  # of the scales: up and along
# Classes differ in form too: the dashes of a pale line along the middle, none in the best class.
_LINES = {"class II": "none", "class III": "40 20", "too long": "1 22", "no class": "14 14"}
_STYLE = f"<style>{(PICTURE_FILES / 'row.css').read_text(encoding='utf-8')}</style>"
_TURNED = 'width="22" height="22" patternUnits="userSpaceOnUse" patternTransform="rotate(45)"'
_PATTERNS = (
    '<pattern id="plants" width="500" height="800" patternUnits="userSpaceOnUse">'
    '<path class="string" d="M90 0C60 200 130 300 100 400S70 700 90 800"/></pattern>'
    f'<pattern id="gap" {_TURNED}><path class="gap" d="M0 0V22"/></pattern>'
)


def draw_rows(
    fruit: Iterable[FruitRow],
    stops: Iterable[StopRecord],
    grades: Mapping[str, Grade],
    units: Units,
) -> dict[str, str]:
    """Return each side of each row as an SVG in millimetres, seen from its aisle, by its title.

    Each fruit has its true size, bend, place and height: classes by colour and form, undecided ones
    hatched in the colours of the classes that they may be in, picked ones as outlines. Fruit at one
    place hang beside each other; what no stop shows is hatched. Fruit without a position are left
    out.

    Parameters
    ----------
    fruit : iterable of FruitRow
        The fruit, in order, with their paths where they are known.
    stops : iterable of StopRecord
        The stops of the round.
    grades : mapping of str to Grade
        By the keys of the fruit.
    units : Units
        Of lengths and positions.

    Returns
    -------
    dict of str to str
        In each SVG a fruit is an `a` with its key as `data-key`, for pages to make it a link.

    Examples
    --------
    >>> from cucumbervision.crop.grades import grade
    >>> from cucumbervision.crop.profiles import load_profile
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.settings import Units
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> length = Length(0.3, low_m=0.3, high_m=0.3)
    >>> fruit = FruitRow(1, key="a", row="3", side="left", along_m=1.2, length=length)
    >>> grades = {"a": grade(fruit, load_profile("long-cucumber"))}
    >>> [(title, drawn)] = draw_rows([fruit], [], grades, Units("cm")).items()
    >>> title, "1.20 m: 30.0 cm, class I" in drawn
    ('Row 3, left · 1 fruit', True)
    """
    sides: dict[tuple[str | None, str | None], list[FruitRow]] = {}
    for view in fruit:
        if view.along_m is not None:
            sides.setdefault((view.row, view.side), []).append(view)
    stops, drawn = list(stops), {}
    for side, views in sides.items():
        title = f"{texts.row_and_side(views[0])} · {counted(len(views), '{n} fruit', '{n} fruit')}"
        of_side = [stop for stop in stops if (stop.row, stop.side) == side]
        drawn[title] = _side(title, views, of_side, grades, units)
    return drawn


def sheet(drawn: Mapping[str, str]) -> str:
    """Return several drawings under each other as one, each with its title above."""
    parts, top, widest = [], 0, 0
    for title, svg in drawn.items():
        width, height = map(int, svg.split('viewBox="')[1].split('"')[0].split()[2:])
        place = f'y="{top + 60}" width="{width}" height="{height}"'
        parts += [
            f'<text y="{top + 50}">{escape(title)}</text>',
            svg.replace("<svg", f"<svg {place}", 1),
        ]
        top, widest = top + height + 100, max(widest, width)
    box = f'xmlns="http://www.w3.org/2000/svg" class="row" viewBox="0 0 {widest} {top}"'
    return f"<svg {box}>{''.join(parts)}</svg>"


def _side(
    title: str,
    fruit: Sequence[FruitRow],
    stops: Sequence[StopRecord],
    grades: Mapping[str, Grade],
    units: Units,
) -> str:
    poses = {stop.key: stored_pose(stop.pose_now, stop.side) for stop in stops}
    level = stored_pose((), fruit[0].side)
    tubes = np.stack([_tube(view, poses.get(view.stop_key, level)) for view in fruit])
    _move_apart(tubes)
    walked = sorted(1000 * stop.at_m for stop in stops if stop.at_m is not None)
    points = [*tubes[..., :2].reshape(-1, 2), *((stop_x, 0.0) for stop_x in walked)]
    x0, top = (np.min(points, axis=0) - _EDGE_MM).round().astype(int).tolist()
    x1, bottom = (np.max(points, axis=0) + _EDGE_MM).round().astype(int).tolist()
    hatches: dict[str, str] = {}
    body = [
        _ground(walked, (x0, top, x1, bottom)),
        *_scales((x0, top, x1, bottom), units),
        *_fruit(fruit, tubes, grades, units, hatches),
    ]
    legend, legend_mm = _legend(fruit, grades, hatches, (x0, bottom + 75))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="row" role="group"'
        f' viewBox="{x0 - 80} {top} {max(x1 - x0 + 120, legend_mm)} {bottom - top + 130}"'
        f' aria-label="{escape(title)}">{_STYLE}<defs>{_PATTERNS}{"".join(hatches.values())}</defs>'
        f"{''.join(body)}{legend}</svg>"
    )


def _tube(view: FruitRow, pose: Array) -> Array:
    """Return points of a fruit in the plane of its row, and half of its width there; mm."""
    centre_m = np.array([getattr(view, f"centre_{axis}_m") or 0.0 for axis in "xyz"])
    length_m = view.length_m or _USUAL_M
    path_m = np.array([[0.0, length_m / 2], [0.0, -length_m / 2]])  # straight down, if not known
    if len(view.path_m) > 2:
        path_m = ((np.array(view.path_m) - centre_m) @ pose[:3, :3].T)[:, :2]
    along_m = np.concatenate([[0.0], np.hypot(*np.diff(path_m, axis=0).T).cumsum()])
    at_m = _AROUND * along_m[-1]
    half_m = np.full(len(at_m), (view.diameter_max_m or _USUAL_DIAMETER_M) / 2)
    if len(view.diameter_m) == len(path_m):  # it begins and ends with 0
        half_m = np.interp(at_m, along_m[1:-1], np.array(view.diameter_m)[1:-1]) / 2
    to_end = np.minimum(at_m, along_m[-1] - at_m) / np.maximum(half_m, 1e-6)
    half_m *= np.sqrt(1 - (1 - np.minimum(to_end, 1)) ** 2)
    x_m = (view.along_m or 0.0) + np.interp(at_m, along_m, path_m[:, 0])
    up_m = (pose[:3, :3] @ centre_m)[1] + pose[1, 3] + np.interp(at_m, along_m, path_m[:, 1])
    return 1000 * np.stack([x_m, -up_m, half_m], axis=1)


def _move_apart(tubes: Array) -> None:
    """Move fruit that would be drawn over one another beside each other."""
    placed: list[tuple[float, float]] = []
    middles = tubes[..., :2].mean(axis=1)
    for k in np.argsort(middles[:, 0]):
        x, y = middles[k].tolist()
        while any(max(abs(x - x2), abs(y - y2)) < _APART_MM for x2, y2 in placed[-9:]):
            x += _APART_MM
        tubes[k, :, 0] += x - middles[k, 0]
        placed.append((x, y))


def _ground(walked: Sequence[float], box: Box) -> str:
    """Draw the plants, and hatch what no stop shows."""
    x0, top, x1, bottom = box
    drawn = [(x0, x1, "plants", "")]
    for before, after in pairwise(walked):
        if after - before > 2 * _REACH_MM:
            drawn.append((before + _REACH_MM, after - _REACH_MM, "gap", _("not walked")))
    return "".join(
        f'<path fill="url(#{fill})" d="M{x1:.0f} {top:.0f}H{x2:.0f}V{bottom:.0f}H{x1:.0f}Z"/>'
        f'<text x="{(x1 + x2) / 2:.0f}" y="{top + 50:.0f}" text-anchor="middle">{words}</text>'
        for x1, x2, fill, words in drawn
    )


def _scales(box: Box, units: Units) -> Iterator[str]:
    x0, top, x1, bottom = box
    unit, per_metre = units.along
    up, along = (1000 * step_m for step_m in _STEPS_M[units.name])
    yield '<g class="scale">'
    for k in range(math.ceil(top / up), math.floor(bottom / up) + 1):
        words = f"{number_words(abs(k) * up / 1000 * per_metre, 1)} {unit}"
        words = f"{'−' if k > 0 else '+'}{words}" if k else _("camera")
        yield f'<path d="M{x0:.0f} {k * up:.0f}H{x1:.0f}"/>'
        yield f'<text x="{x0 - 70:.0f}" y="{k * up - 8:.0f}">{words}</text>'
    for k in range(max(math.ceil(x0 / along), 0), math.floor(x1 / along) + 1):
        words = f"{number_words(k * along / 1000 * per_metre, 1)} {unit}"
        yield f'<path d="M{k * along:.0f} {bottom - 20:.0f}v20"/>'
        yield f'<text x="{k * along:.0f}" y="{bottom + 40:.0f}" text-anchor="middle">{words}</text>'
    yield "</g>"


def _fruit(
    fruit: Sequence[FruitRow],
    tubes: Array,
    grades: Mapping[str, Grade],
    units: Units,
    hatches: dict[str, str],
) -> Iterator[str]:
    """Draw the fruit, the farthest first, and their lengths so that no two overprint."""
    axes = tubes[..., :2]
    ahead = np.gradient(axes, axis=1)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=2, keepdims=True), 1e-9)
    across = np.stack([ahead[..., 1], -ahead[..., 0]], axis=2) * tubes[..., 2:]
    outlines = np.concatenate([axes + across, (axes - across)[:, ::-1]], axis=1)
    labels: list[tuple[float, float]] = []
    for k in sorted(range(len(fruit)), key=lambda k: -(fruit[k].centre_z_m or 0.0)):
        view, graded = fruit[k], grades[fruit[k].key]
        by_height = axes[k, np.argsort(axes[k, :, 1])].round().tolist()
        (stalk_x, stalk_y), (x, y) = by_height[0], by_height[-1]
        y += _TEXT_MM + 10
        neighbours = [y2 for x2, y2 in labels if abs(x - x2) < 3 * _TEXT_MM]
        while any(abs(y - y2) < _TEXT_MM for y2 in neighbours):
            y += 6
        labels.append((x, y))
        length = number_words(units.value(view.length_m) or 0.0, units.digits)
        label = f"{'≥ ' * view.at_least}{length if view.length_m else '?'}"
        label += " ✓" * (view.picked_s is not None)
        fill, dashes = _form(view, graded, hatches)
        line = f'<path class="line" d="{_line(axes[k, 2:-2])}" stroke-dasharray="{dashes}"/>'
        place, words = texts.position_words(view.along_m, units), texts.length_words(view, units)
        yield (
            f'<a data-key="{view.key}"><title>'
            f"{escape(f'{place}: {words}, {texts.grade_words(graded)}')}</title>"
            f'<path class="stalk" d="M{stalk_x:.0f} {stalk_y:.0f}v-45"/>'
            f'<path class="body" {fill} d="{_line(outlines[k])}Z"/>{line if dashes else ""}'
            f'<text x="{x:.0f}" y="{y:.0f}">{label}</text></a>'
        )


def _legend(
    fruit: Sequence[FruitRow],
    grades: Mapping[str, Grade],
    hatches: dict[str, str],
    place: tuple[int, int],
) -> tuple[str, int]:
    """Count the classes, each beside a sample of its colour and form; return also the width."""
    forms = {grades[view.key].label: _form(view, grades[view.key], hatches) for view in fruit}
    counts = Counter(grades[view.key].label for view in fruit)
    parts, (x0, y), x = [], place, place[0]
    for label, number in sorted(counts.items()):
        fill, dashes = forms[label]
        words = f"{number} {texts.label_words(label)}"
        line = f'<path class="line" d="M20 17H80" stroke-dasharray="{dashes}"/>' if dashes else ""
        parts.append(
            f'<g class="legend" transform="translate({x} {y})"><path class="body" {fill} '
            f'd="M17 0H83A17 17 0 0 1 83 34H17A17 17 0 0 1 17 0Z"/>{line}'
            f'<text x="112" y="29">{escape(words)}</text></g>'
        )
        x += 160 + 19 * len(words)
    return "".join(parts), x - x0 + 80


def _form(view: FruitRow, graded: Grade, hatches: dict[str, str]) -> tuple[str, str]:
    """Return how a fruit is filled, and the dashes of the line along its middle."""
    if view.picked_s is not None or view.length_m is None:
        return f'fill="none" stroke-dasharray="{"16 12" if view.length_m else "2 12"}"', ""
    if graded.name != UNDECIDED:
        return f'fill="{class_color(graded.label)}"', _LINES.get(graded.label, "")
    names = [class_name(name) for name in graded.possible] or [UNDECIDED]
    first, last = class_color(names[0]), class_color(names[-1]) if len(names) > 1 else "#FFFFFF"
    name = f"may-{first[1:]}-{last[1:]}"
    hatches[name] = (
        f'<pattern id="{name}" {_TURNED}><path fill="{first}" d="M0 0h22v22H0z"/>'
        f'<path fill="{last}" d="M0 0h11v22H0z"/></pattern>'
    )
    return f'fill="url(#{name})"', ""


def _line(points: Array) -> str:
    """Return a path of an SVG through points, each after the first by its step, which is short."""
    pixels = points.round().astype(int)
    steps = np.concatenate([pixels[:1], np.diff(pixels, axis=0)]).ravel().tolist()
    return "m" + " ".join(map(str, steps))
