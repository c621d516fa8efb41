"""A round as a page to print: A4, black on white, without any network."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from pathlib import Path

    from jinja2 import Template

    from cucumbervision.exports.tables import Charts, RoundTables
    from cucumbervision.pipeline.fields import Cell

__all__ = ["Bar", "bars", "render_sheet", "stacks", "write_sheet"]

_HEIGHT = 100.0
_FILLS = ("#2F6B3A", "#8BB174", "#D9D9D9", "#7A7A7A", "#C9A227", "#5B7DB1")
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
_DIGITS = {"cm": 1, "mm": 1, "m": 2, "h": 1, "g": 0, "ml": 0, "deg": 0}


@dataclass(frozen=True)
class Bar:
    """One bar of a chart: what it is of, its number, and its place from the top, 0 to 100."""

    label: str
    number: float
    top: float
    height: float
    fill: str = _FILLS[0]


def bars(charts: Charts) -> tuple[Bar, ...]:
    """Lay out the histogram of lengths.

    Examples
    --------
    >>> from cucumbervision.exports.tables import Charts
    >>> [(bar.label, bar.height) for bar in bars(Charts(bins=((20, 22, 1), (22, 24, 2))))]
    [('20', 50.0), ('22', 100.0)]
    """
    most = max((count for *_, count in charts.bins), default=0) or 1
    return tuple(
        Bar(str(low), count, _HEIGHT * (1 - count / most), _HEIGHT * count / most)
        for low, _, count in charts.bins
    )


def stacks(charts: Charts) -> tuple[tuple[int, tuple[Bar, ...]], ...]:
    """Lay out the forecast: for each day its classes, one on the other.

    Examples
    --------
    >>> from cucumbervision.exports.tables import Charts
    >>> found = stacks(Charts(classes=("I", "II"), days=((0, (1.0, 3.0)),)))
    >>> [(bar.label, bar.top, bar.height) for bar in found[0][1]]
    [('I', 75.0, 25.0), ('II', 0.0, 75.0)]
    """
    most = max((sum(counts) for _, counts in charts.days), default=0.0) or 1.0
    found = []
    for day, counts in charts.days:
        top, day_bars = _HEIGHT, []
        for k, (name, count) in enumerate(zip(charts.classes, counts, strict=True)):
            height = _HEIGHT * count / most
            top -= height
            day_bars.append(Bar(name, count, top, height, _FILLS[k % len(_FILLS)]))
        found.append((day, tuple(day_bars)))
    return tuple(found)


def write_sheet(tables: RoundTables, out: Path) -> list[Path]:
    """Write `round.html`.

    Raises
    ------
    MissingExtraError
        If Jinja is not installed.
    """
    path = out / "round.html"
    path.write_text(render_sheet(tables), encoding="utf-8")
    return [path]


def render_sheet(tables: RoundTables) -> str:
    """Return the page: summary, charts, forecast, work, pick list, fruit, and what it rests on.

    Every text of it is escaped, and it loads nothing from anywhere.
    """
    house = [line for line in tables["forecast"].records() if line["scope"] == "house"]
    return _template().render(
        title=tables.title,
        about=tables.provenance,
        note=tables.note,
        summary=[
            (column, cell)
            for column, cell in zip(
                tables["summary"].columns, tables["summary"].rows[0], strict=True
            )
            if cell is not None and column.name not in {"round", "round_key", "simulated"}
        ],
        simulated=tables.summary["simulated"],
        bars=bars(tables.charts),
        stacks=stacks(tables.charts),
        classes=tables.charts.classes,
        fills=_FILLS,
        house=house,
        work=tables["work"].records(),
        picks=tables["picks"].records(),
        fruit=tables["fruit"].records(),
    )


def _template() -> Template:
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ModuleNotFoundError:
        raise MissingExtraError("jinja2", "export") from None
    environment = Environment(
        loader=PackageLoader("cucumbervision.exports", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["figure"] = _figure
    return environment.get_template("round.html")


def _figure(cell: Cell, unit: str = "") -> Any:
    """Return a cell as people read it."""
    if cell is None:
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, str) and _TIME.fullmatch(cell):
        return cell.replace("T", " ").removesuffix("Z")
    if isinstance(cell, float):
        return f"{cell:.{_DIGITS.get(unit, 1)}f}"
    return cell
