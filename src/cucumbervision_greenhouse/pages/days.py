"""Days: what changed in the house since an earlier round, and how its fruit develop."""

from __future__ import annotations

from datetime import date
from functools import partial

import streamlit as st

from cucumbervision_greenhouse import resources, round_view
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.language import counted, marked, plain
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.round_choice import label_options, of_round
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds import day_comparison
from cucumbervision_greenhouse.rounds.merge_and_link import earlier_rounds
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import FruitRow, Round

_SEASON = 200  # rounds in the chart
_CHANGES = {
    day_comparison.Change.STAYED: marked("Seen on both days"),
    day_comparison.Change.PICKED: marked("Picked"),
    day_comparison.Change.GONE: marked("Not seen again"),
    day_comparison.Change.NEW: marked("New"),
    day_comparison.Change.NOT_WALKED: marked("Not walked"),
}


@of_round
def page(walk: RoundView) -> None:
    """Draw the page."""
    round_summary = walk.round
    earlier = {x.key: x for x in earlier_rounds(resources.store(), round_summary.key)}
    if not round_summary.fruit or not earlier:
        st.info(
            _(
                "Nothing to compare yet: this house has no fruit of an earlier day. Walk it again "
                "on another day, and this page shows what grew, what was picked and what is new."
            ),
            icon=":material/date_range:",
        )
        page_elements.link("capture", _("Capture"))
        return
    before = earlier[_choose_day(earlier)]
    comparison = round_view.comparison_of(before, round_summary)
    fruit_key = st.query_params.get("fruit", "")
    views = [view for fruit in comparison.changes for view in (fruit.before, fruit.after) if view]
    if fruit_key in [view.key for view in views]:
        _fruit_days(round_summary, fruit_key)
        return
    _metrics(comparison, before, round_summary)
    _offer(comparison, before, round_summary)
    _rows(comparison)
    _classes(comparison, before, round_summary)
    _each_fruit(comparison)
    _trend(round_summary, [round_summary, *earlier.values()])


def _choose_day(earlier: dict[str, Round]) -> str:
    names = {key: texts.day_words(x.walked_s) for key, x in earlier.items()}
    label = label_options("compared_with", names)
    if st.session_state.get("compared_with") not in earlier:
        named = st.query_params.get("day")
        st.session_state["compared_with"] = named if named in earlier else next(iter(earlier))
    key = st.selectbox(_("Compare with"), list(earlier), format_func=label, key="compared_with")
    page_elements.name_in_address("day", key)
    return str(key)


def _metrics(counts: day_comparison.DayComparison, before: Round, after: Round) -> None:
    metrics: dict[str, int | str] = {
        _("On {day}").format(day=texts.day_words(before.walked_s)): counts.before,
        _("Picked"): counts.number(day_comparison.Change.PICKED),
        _("Not seen again"): counts.number(day_comparison.Change.GONE),
        _("New"): counts.number(day_comparison.Change.NEW),
        _("On {day}").format(day=texts.day_words(after.walked_s)): counts.after,
        _("Growth"): texts.daily_growth_words(counts.growth_m_per_day, resources.settings().units),
    }
    page_elements.metrics(metrics)
    stayed = counts.of(day_comparison.Change.STAYED)
    if (
        counts.of(day_comparison.Change.GONE)
        and counts.of(day_comparison.Change.NEW)
        and not stayed
    ):
        words = _(
            "No fruit of one day is surely one of the other: 'not seen again' and 'new' may be the "
            "same fruit."
        )
        st.warning(words, icon=":material/link_off:")
    notes = []
    if n := counts.number(day_comparison.Change.NOT_WALKED):
        notes.append(
            counted(
                n,
                "{n} fruit hangs where only one of the two rounds went: not compared.",
                "{n} fruit hang where only one of the two rounds went: not compared.",
            )
        )
    if n := sum(fruit.is_back for fruit in counts.changes):
        notes.append(
            counted(
                n,
                "{n} fruit was ticked off as picked and seen again all the same.",
                "{n} fruit were ticked off as picked and seen again all the same.",
            )
        )
    notes.append(
        _(
            "'Not seen again' are fruit that were picked without being ticked off, fell, or were "
            "missed. 'New' may have been missed before. Growth is the median of the fruit seen on "
            "both days."
        )
    )
    st.caption(" ".join(notes))


def _offer(comparison: day_comparison.DayComparison, before: Round, after: Round) -> None:
    """Ask whether a fruit that was not seen again is a new one, with both pictures."""
    store, contents = resources.store(), [round_view.view_of(x).content for x in (before, after)]
    pairs = day_comparison.offered_pairs(store, comparison, contents)
    page_elements.draw_undo(after.key)
    if not pairs:
        return
    words = counted(
        len(pairs),
        "**The same fruit?** {n} pair may be one fruit. Growth is learnt from sure ones.",
        "**The same fruit?** {n} pairs may be one fruit. Growth is learnt from sure ones.",
    )
    st.markdown(words)
    units = resources.settings().units
    page_elements.pictures(pairs[0], lambda view: _day_words(view, units))
    keys = [view.key for view in pairs[0]]
    for column, label, same in zip(
        st.columns(2), (_("The same fruit"), _("Two fruit")), (True, False), strict=True
    ):
        act = partial(store.decide_growth, *keys, same=same)
        icon = "link" if same else "link_off"
        page_elements.button(column, label, icon, act, key=f"{icon}_{keys[0]}")


def _rows(comparison: day_comparison.DayComparison) -> None:
    lines = [
        {
            _("Row"): row or "?",
            _("Before"): counts.before,
            _("Picked"): counts.number(day_comparison.Change.PICKED),
            _("Not seen again"): counts.number(day_comparison.Change.GONE),
            _("New"): counts.number(day_comparison.Change.NEW),
            _("Now"): counts.after,
            _("Growth"): texts.daily_growth_words(
                counts.growth_m_per_day, resources.settings().units
            ),
        }
        for row, counts in comparison.by_row().items()
    ]
    if len(lines) > 1:
        page_elements.table(lines)


def _classes(comparison: day_comparison.DayComparison, before: Round, after: Round) -> None:
    """Show the compared fruit by class, on both days."""
    compared = [x for x in comparison.changes if x.change is not day_comparison.Change.NOT_WALKED]
    views = [x.before for x in compared], [x.after for x in compared]
    profiles = (resources.profile_of(day)[1] for day in (before, after))
    first, last = map(round_view.class_counts, (filter(None, x) for x in views), profiles)
    lines = [
        {
            _("Class"): texts.label_words(name),
            _("Before"): first[name],
            _("Now"): last[name],
            _("Change"): f"{last[name] - first[name]:+d}".replace("+0", "0").replace("-", "−"),
        }
        for name in sorted({*first, *last})
    ]
    page_elements.table(lines)


def _each_fruit(comparison: day_comparison.DayComparison) -> None:
    kinds = [change for change in day_comparison.Change if comparison.of(change)]
    if st.session_state.get("change") not in kinds:
        st.session_state["change"] = kinds[0]
    words = {kind: _(_CHANGES[kind]) for kind in kinds}
    segments = partial(page_elements.choose, st.segmented_control, required=True)
    kind = segments(_("Fruit"), words, key="change")
    changes, units = comparison.of(kind or kinds[0]), resources.settings().units
    drawn = page_elements.first_of(changes, "days_page", round_view.LINES)
    views = [(fruit.after or fruit.before, fruit) for fruit in drawn]
    lines = [
        {
            "key": view.key,
            "picture": round_view.thumbnail_of(view),
            "says": _change_words(fruit, units),
        }
        for view, fruit in views
        if view is not None
    ]
    title = counted(
        len(changes), "{n} fruit: tap one to see its days", "{n} fruit: tap one to see its days"
    )
    page_elements.fruit_list("days_list", _("Fruit of both days"), lines, title)
    page_elements.draw_more(changes, "days_page", round_view.LINES)


def _fruit_days(round_summary: Round, key: str) -> None:
    """Show one fruit on all its days: pictures, lengths, and a chart of them."""
    units = resources.settings().units
    views = round_view.fruit_days_of(round_summary, key)
    page_elements.button(
        st, _("All fruit"), "arrow_back", page_elements.name_in_address, "fruit", None
    )
    st.header(f"{texts.row_name(views[-1].row)}: {counted(len(views), '{n} day', '{n} days')}")
    page_elements.pictures(views, lambda view: _day_words(view, units))
    if sum(view.length is not None for view in views) > 1:
        from cucumbervision_greenhouse.pages import charts

        st.altair_chart(charts.growth_chart(views, units))
        st.caption(_("Length on each day, with its 90 % interval where one is given."))
    if views[-1].round_key == round_summary.key:
        page_elements.link("results", _("Open this fruit"), fruit=views[-1].key)


def _change_words(fruit: day_comparison.FruitChange, units: Units) -> list[str]:
    """Return the words for a fruit of two rounds: its place, its two lengths, its growth."""
    views = [view for view in (fruit.before, fruit.after) if view is not None]
    growth, last = fruit.growth_m_per_day, views[-1]
    return [
        f"{texts.row_and_side(last)}, {texts.position_words(last.along_m, units)}",
        " → ".join(texts.length_words(view, units) for view in views),
        "" if growth is None else texts.daily_growth_words(growth, units),
        _("picked") if last.picked_s is not None else "",
    ]


def _day_words(view: FruitRow, units: Units) -> str:
    """Return a fruit on one day in lines: the date, its length and interval."""
    length, interval = texts.length_words(view, units), texts.interval_words(view, units)
    return "  \n".join(filter(None, (texts.day_words(view.taken_s), length, interval)))


def _trend(round_summary: Round, rounds: list[Round]) -> None:
    """Draw the fruit on the plant by day, when it is asked for: a season takes long to read."""
    title = _("All days of this house")
    if house := round_summary.house:
        title = _("All days of {house}").format(house=plain(house))
    section = page_elements.section(title, "bar_chart", "trend")
    if section is None:
        return
    last: dict[str, Round] = {}  # of each day, the newest first
    for x in sorted(rounds, key=lambda x: -x.walked_s):
        last.setdefault(date.fromtimestamp(x.walked_s).isoformat(), x)
    lines = [
        {"day": day, "class": label, "fruit": number}
        for day, x in list(last.items())[:_SEASON]
        for label, number in round_view.class_counts_of(x).items()
    ]
    from cucumbervision_greenhouse.pages import charts

    section.altair_chart(charts.trend_chart(lines))
    section.caption(_("Fruit that the last round of each day showed, by class."))
