"""What the pages say of a fruit: its class, length, height and remarks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.agronomy import classes
from cucumbervision.agronomy.classes import UNDECIDED, class_name
from cucumbervision.measurement.flags import FLAGS
from cucumbervision_greenhouse.backend.core_words import words_of
from cucumbervision_greenhouse.backend.language import gettext as _
from cucumbervision_greenhouse.backend.language import (
    marked,
    number_words,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision.agronomy.grades import Grade
    from cucumbervision_greenhouse.agronomy.picking import Pick
    from cucumbervision_greenhouse.backend.settings import Units
    from cucumbervision_greenhouse.store.records import DetectionRecord


def pick_words(pick: Pick) -> str:
    """Return the class of a fruit on the pick list: 'class I', 'undecided: class I or too long'.

    Examples
    --------
    >>> from cucumbervision_greenhouse.agronomy.length_draws import FruitState
    >>> from cucumbervision_greenhouse.agronomy.picking import Pick, PickKind
    >>> fruit = FruitState("a", "1", 0.5, 0.25, 0.01)
    >>> pick_words(Pick(fruit, "I", 0.99))
    'class I'
    >>> pick_words(Pick(fruit, "undecided", 0.5, PickKind.UNDECIDED, ("II", "I")))
    'undecided: class II or I'
    """
    if pick.name != UNDECIDED:
        return class_words(pick.name)
    if pick.fruit.at_least:
        return f"{_(UNDECIDED)} ({_('only part of it is seen')})"
    return f"{_(UNDECIDED)}: {choice_words(pick.possible)}"


# Where an outline is from, as `MaskSource.words` names it.
_OUTLINES = (marked("data set"), marked("detector"), marked("hand"))


# Verdicts, as the filters of a list name them.
_VERDICTS = (marked("accepted"), marked("rejected"))


# Names and sources of the crops that the program brings.
_CROPS = (
    marked("long greenhouse cucumber"),
    marked("mini cucumber"),
    marked("aubergine, elongated"),
    marked("courgette"),
    marked("green bean"),
    marked("greenhouse classes of the CucumberVision paper"),
    marked("UNECE FFV-15, crookedness; crooked fruit are class II, packed apart"),
    marked("Regulation (EEC) No 1677/88, III: grown under glass"),
    marked("Regulation (EEC) No 1677/88, III: shortest length for the weight, Extra and I"),
    marked("assumption: lengths that are usual in trade"),
    *(marked("50 to 100 g"), marked("100 to 225 g"), marked("100 to 300 g")),
    *(marked("225 to 450 g"), marked("250 to 500 g"), marked("300 to 500 g")),
    marked("500 g and more"),
)


def class_words(name: str) -> str:
    """Return the name of a class for people, in the language that is shown.

    Examples
    --------
    >>> class_words("I"), class_words("too long")
    ('class I', 'too long')
    """
    return words_of(class_name(name))


def label_words(label: str) -> str:
    """Return the label of a grade in the language that is shown.

    Examples
    --------
    >>> label_words("class I"), label_words("too long")
    ('class I', 'too long')
    """
    name = label.removeprefix("class ")
    return _(label) if name == label else class_words(name)


def choice_words(names: Iterable[str]) -> str:
    """Return several classes for people.

    Examples
    --------
    >>> choice_words(("too short", "II", "I", "too long"))
    'too short, class II, I or too long'
    """
    return words_of(classes.choice_words(names))


# Reasons that the core gives for a class; those of a crop profile of one's own stay as they are.
_REASONS = (
    marked("by length"),
    marked("practically straight"),
    marked("slightly crooked"),
    marked("crooked"),
    marked("too thin"),
    marked("too light"),
    marked("short for its weight"),
    marked("such a length cannot be"),
    marked("no centreline length"),
    marked("no thread length"),
    marked("no chord length"),
    marked("only part of it is seen"),
    marked("the length is uncertain"),
)


def grade_words(graded: Grade) -> str:
    """Return a class with its reason, as `Grade.words` does in English.

    Examples
    --------
    >>> from cucumbervision.agronomy.grades import Grade
    >>> grade_words(Grade(GradeStatus.UNDECIDED, UNDECIDED, (), {}, possible=("II", "I")))
    'undecided: class II or I'
    """
    return words_of(graded.words)


def length_words(record: DetectionRecord, units: Units) -> str:
    """Return a length in words: 'at least' for a lower bound, 'not measured' for none.

    Examples
    --------
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> from cucumbervision.measurement.result import Length
    >>> from cucumbervision_greenhouse.store.records import DetectionRecord
    >>> length_words(DetectionRecord(1, length=Length(0.241), flags="end-hidden"), Units("cm"))
    'at least 24.1 cm'
    """
    if record.length_m is None:
        return _("not measured")
    length = units.text(record.length_m)
    return _("at least {length}").format(length=length) if record.at_least else length


def interval_words(record: DetectionRecord, units: Units, words: str = "") -> str | None:
    """Return a length's interval from end to end; None where it has none, or is a lower bound.

    Parameters
    ----------
    record : DetectionRecord
        The fruit.
    units : Units
        Unit of lengths.
    words : str
        Other words around {low} and {high}.

    Examples
    --------
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> from cucumbervision.measurement.result import Length
    >>> from cucumbervision_greenhouse.store.records import DetectionRecord
    >>> record = DetectionRecord(1, length=Length(0.24, low_m=0.235, high_m=0.247))
    >>> interval_words(record, Units("cm"))
    '23.5 to 24.7 cm'
    """
    length = record.length
    if length is None or record.at_least or not (length.low_m and length.high_m):
        return None
    return (words or _("{low} to {high}")).format(
        low=number_words(units.value(length.low_m) or 0.0, units.digits),
        high=units.text(length.high_m),
    )


def kind_words(kind: str | None) -> str:
    """Return the kind of a length in words.

    Examples
    --------
    >>> kind_words("centreline"), kind_words(None)
    ('Length along the middle', 'Length')
    """
    return {
        "centreline": _("Length along the middle"),
        "thread": _("Length over the outer side"),
        "chord": _("Length straight from end to end"),
    }.get(kind or "", _("Length"))


def height_words(record: DetectionRecord, units: Units) -> str:
    """Return how high a fruit hangs in words; empty if unknown.

    Examples
    --------
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> from cucumbervision_greenhouse.store.records import DetectionRecord
    >>> height_words(DetectionRecord(1, centre_y_m=-0.312), Units("cm"))
    '31 cm above the camera'
    """
    if record.centre_y_m is None:
        return ""
    height = units.value(abs(record.centre_y_m)) or 0.0
    if round(height) == 0:
        return _("as high as the camera")
    below, above = _("{height} below the camera"), _("{height} above the camera")
    words = below if record.centre_y_m > 0 else above
    return words.format(height=f"{height:.0f} {units.name}")


def added_words(*, doubtful: bool) -> str:
    """Return the outcome of adding a fruit in words."""
    if doubtful:
        return _(
            "Added, but it does not look like a fruit. It is not on the pick list until someone "
            "accepts it. 'Undo' removes it."
        )
    return _("Added to the round. 'Undo' removes it.")


def remarks(record: DetectionRecord, units: Units) -> str:
    """Return the remarks on a fruit, as short sentences; technical flags are left out.

    Examples
    --------
    >>> from cucumbervision_greenhouse.backend.settings import Units
    >>> from cucumbervision.measurement.result import Length
    >>> from cucumbervision_greenhouse.store.records import DetectionRecord
    >>> fruit = DetectionRecord(1, length=Length(0.24), flags="ends-unsure end-hidden")
    >>> remarks(fruit, Units("cm"))
    'an end is hidden: at least 24.0 cm'
    """
    meanings = [FLAGS.get(code) for code in record.flags.split()]  # type: ignore[call-overload]
    remarks = dict.fromkeys(_(x.remark) for x in meanings if x is not None and x.remark)
    words = "; ".join(remarks)
    if not (record.at_least and record.length_m is not None):
        return words
    return f"{words or _('partly hidden')}: {length_words(record, units)}"
