"""Taps that a grower's tasks take, counted while Chromium does them as a tablet."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from figures import Figure

from cucumbervision_greenhouse.store.records import DetectionFilter, Verdict
from cucumbervision_greenhouse.store.repository import open_store
from speeds.chromium import Visit


class Tablet:
    """A page on which each tap counts; what is typed into a field counts as its tap."""

    def __init__(self, seen: Visit, store: Path, round_key: str) -> None:
        self.seen, self.page, self.store, self.round_key = seen, seen.page, store, round_key
        self.taps = 0

    def open(self, path: str, shown: str) -> None:
        """Open a page of the round, which is where the task begins; and count from zero."""
        self.seen.open(f"{path}?round={self.round_key}", shown)
        self.seen.idle()
        self.taps = 0

    def tap(self, element: Any) -> None:
        """Tap something, as soon as it is there."""
        element.first.tap()
        self.taps += 1

    def tap_button(self, name: str) -> None:
        """Tap a button."""
        self.tap(self.page.get_by_role("button", name=name))

    def tap_page(self, name: str) -> None:
        """Tap a page in the navigation."""
        self.tap(self.page.locator(".st-key-nav a").filter(has_text=name))

    def wait_for(self, words: str) -> None:
        """Wait until words are seen."""
        self.page.locator(f"text={words} >> visible=true").first.wait_for()


def ready_today(tablet: Tablet) -> None:
    """See what is ready today."""
    tablet.open("/", "text=Pick list")


def take_stop(tablet: Tablet) -> None:
    """Take a stop."""
    tablet.open("/capture", "button.take:enabled")
    tablet.page.wait_for_function("document.getElementById('color').naturalWidth > 0")
    with tablet.page.expect_response("**/api/press") as sent:
        tablet.tap(tablet.page.locator("button.take"))
    assert sent.value.ok


def another_row(tablet: Tablet) -> None:
    """Go on in another row."""
    tablet.open("/capture", "button.take:enabled")
    tablet.tap(tablet.page.locator("#row"))
    tablet.page.keyboard.type("9")
    assert tablet.page.locator("#row").input_value().endswith("9")


def delete_last_stop(tablet: Tablet) -> None:
    """Delete the last stop."""
    tablet.open("/capture", "#undo >> visible=true")
    with tablet.page.expect_response("**/api/undo") as undone:
        tablet.tap(tablet.page.locator("#undo"))
    assert undone.value.ok


def add_missed_fruit(tablet: Tablet) -> None:
    """Add a fruit that was missed: one that was marked as no fruit is outlined anew."""
    tablet.open("/capture", "#pictures svg.view image")
    with open_store(tablet.store) as store:
        stop = max(store.stops(tablet.round_key), key=lambda stop: stop.taken_s)
        view = store.detections(tablet.round_key, DetectionFilter(stop_key=stop.key))[0]
        store.set_verdict([view.key], Verdict.REJECTED)
    record = view
    middle = (record.box_x1_px + record.box_x2_px) / 2, (record.box_y1_px + record.box_y2_px) / 2
    tablet.tap_button("Add by tap")
    picture = tablet.page.locator("#pictures svg.view").first
    x, y = picture.evaluate(
        "(svg, [x, y]) => { const at = new DOMPoint(x, y).matrixTransform(svg.getScreenCTM()),"
        " box = svg.getBoundingClientRect(); return [at.x - box.x, at.y - box.y]; }",
        middle,
    )
    with tablet.page.expect_response("**/api/outline") as outlined:
        picture.tap(position={"x": x, "y": y})
        tablet.taps += 1
    assert outlined.value.ok


def start_round(tablet: Tablet) -> None:
    """Start a round."""
    tablet.open("/results", ".fruit button")
    tablet.tap_button("New round")
    tablet.tap_button("Start this round")
    tablet.wait_for("This round has no stops yet.")


def check_least_certain(tablet: Tablet) -> None:
    """Check the least certain fruit."""
    tablet.open("/", "text=Pick list")
    tablet.tap_page("Row map")
    tablet.tap_button("Show the least certain")
    tablet.tap_button("This is a fruit")
    tablet.wait_for("Marked: a fruit.")


def compare_days(tablet: Tablet) -> None:
    """See what changed since the last round."""
    tablet.open("/", "text=Pick list")
    tablet.tap_page("Days")
    tablet.wait_for("Compare with")


def tick_fruit(tablet: Tablet) -> None:
    """Tick a fruit off the pick list."""
    tablet.open("/", ".fruit button")
    tablet.tap(tablet.page.locator(".fruit button[aria-pressed=false]"))
    tablet.page.locator(".fruit button[aria-pressed=true]").first.wait_for()


def tick_row(tablet: Tablet) -> None:
    """Tick off a whole row."""
    tablet.open("/", "text=All of row")
    tablet.tap_button("All of row")
    tablet.tap_button("Yes, all are picked")
    tablet.page.get_by_role("button", name="Undo 'all picked'", disabled=False).wait_for()


def take_files(tablet: Tablet) -> None:
    """Take the files home."""
    tablet.open("/", "text=Pick list")
    tablet.tap_page("Results")
    tablet.tap(tablet.page.get_by_text("Files of this round"))
    with tablet.page.expect_download():
        tablet.tap(tablet.page.get_by_role("link", name="Download"))


TASKS: tuple[Callable[[Tablet], None], ...] = (
    *(ready_today, take_stop, another_row, delete_last_stop, add_missed_fruit, start_round),
    *(check_least_certain, compare_days, tick_fruit, tick_row, take_files),
)


def task_taps(seen: Visit, store: Path, round_key: str) -> Iterator[Figure]:
    """Do each task, and count its taps."""
    tablet = Tablet(seen, store, round_key)
    for task in TASKS:
        task(tablet)
        name = (task.__doc__ or "").partition("\n")[0].partition(":")[0].rstrip(".").lower()
        yield Figure(f"taps: {name}", tablet.taps, "", "<= 3")
