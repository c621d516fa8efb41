"""The class of a fruit from the interval of its length, its grade, and the rules behind it.

A fruit is in a class if its whole interval is, and undecided if the interval spans several. Of a
fruit that continues out of sight only a lower bound is known; it is never too short.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.arrays import Array
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.errors import Message, joined, with_reason
from cucumbervision.methods import result
from cucumbervision.methods.flags import is_length_unknown, is_lower_bound

UNDECIDED = "undecided"
"""What a fruit is called whose interval spans several classes."""

NO_CLASS = "no class"
"""What a fruit is called whose shape, weight or girth no class allows."""

NOT_MEASURED = "not measured"
"""What a fruit without a length is called."""

WITHOUT_CLASS = ("too short", "too long", NO_CLASS, UNDECIDED, NOT_MEASURED)
"""All names that are no class of a crop."""

_SAME_M = 1e-8  # lengths nearer than that are equal: 0.1 + 0.15 m is 25 cm


def possible_classes(
    low_m: float, high_m: float, edges_m: Array, names: Sequence[str]
) -> tuple[str, ...]:
    """Return the classes that an interval of the length spans, without repeats, shortest first.

    Parameters
    ----------
    low_m, high_m : float
        Ends of the interval, metres; the upper end of a lower bound is infinite.
    edges_m : ndarray of float64, shape (B - 1,)
        Limits between the classes, ascending; a class includes its lower limit.
    names : sequence of str, length B
        Class of each bin between the limits, including the two outer bins.

    Examples
    --------
    >>> edges, names = np.array([0.20, 0.25, 0.35]), ("too short", "II", "I", "too long")
    >>> possible_classes(0.26, 0.28, edges, names)
    ('I',)
    >>> possible_classes(0.24, 0.26, edges, names)
    ('II', 'I')
    >>> possible_classes(0.13, float("inf"), edges, names)
    ('too short', 'II', 'I', 'too long')
    """
    first = int(np.searchsorted(edges_m, low_m + _SAME_M, side="right"))
    last = int(np.searchsorted(edges_m, max(high_m, low_m) - _SAME_M, side="right"))
    return tuple(dict.fromkeys(names[first : max(first, last) + 1]))


def class_of(possible: Sequence[str]) -> str:
    """Return the only possible class, or 'undecided'.

    Examples
    --------
    >>> class_of(("I",)), class_of(("II", "I"))
    ('I', 'undecided')
    """
    return possible[0] if len(possible) == 1 else UNDECIDED


def class_name(name: str) -> str:
    """Return the name of a class for people.

    Examples
    --------
    >>> class_name("I"), class_name("too long")
    ('class I', 'too long')
    """
    return Message(name) if name in WITHOUT_CLASS else Message("class {name}", name=name)


def choice_words(names: Iterable[str]) -> str:
    """Return several classes for people.

    Examples
    --------
    >>> choice_words(("II", "I")), choice_words(("I", "too long"))
    ('class II or I', 'class I or too long')
    >>> choice_words(("too short", "II", "I", "too long"))
    'too short, class II, I or too long'
    """
    words: list[str] = []
    for name in names:
        # 'class' once before a run of classes.
        follows = bool(words) and words[-1] not in WITHOUT_CLASS
        words.append(name if follows and name not in WITHOUT_CLASS else class_name(name))
    return joined(words, "{first} or {second}")


def share_below(length: result.Length, limit_m: ArrayLike) -> Array:
    """Return the probability that a length with an interval is below each limit in metres, float64.

    The intervals are conformal, with a miss rate of 5 % on each side. Their ends and the median
    (`Length.sides`) are calibrated; the shape of the distribution between them is an assumption.

    Examples
    --------
    >>> from cucumbervision.methods.result import Length
    >>> share_below(Length(0.252, low_m=0.246, high_m=0.258), [0.25, 0.35]).round(2).tolist()
    [0.29, 1.0]
    """
    from scipy.special import ndtr

    limit = np.asarray(limit_m, np.float64)
    if length.sides is None:
        return np.full(limit.shape, np.nan)
    median_m, low_sd, high_sd = length.sides
    gap = np.log(np.maximum(limit, 1e-12) / median_m)
    sd = np.where(gap < 0, low_sd, high_sd)
    # Without spread on a side, no probability lies beyond the median.
    z = np.where(sd > 0, gap / np.maximum(sd, 1e-12), np.where(gap > 0, np.inf, -np.inf))
    return np.asarray(ndtr(z), np.float64)


class GradeStatus(StrEnum):
    """Status of a grade; stable codes for tables."""

    IN_CLASS = "in-class"
    NO_CLASS = "no-class"
    UNDECIDED = "undecided"
    REFUSED = "refused"
    MISSING = "missing"


@dataclass(frozen=True)
class GradingTraits:
    """The traits of a fruit that grading uses; None if unknown.

    Parameters
    ----------
    thread_m, centreline_m, chord_m : float, optional
        The three lengths of a fitted tube, metres.
    length : Length, optional
        The fruit's length with its interval; a site's calibration corrects only this one.
    inner_arc_mm_per_10cm : float, optional
        Inner arc height in mm for each 10 cm of chord.
    diameter_max_m : float, optional
        Largest diameter, metres.
    volume_m3 : float, optional
        Volume, cubic metres.
    flags : str
        The measurement's flags, separated by blanks.
    """

    thread_m: float | None = None
    centreline_m: float | None = None
    chord_m: float | None = None
    length: result.Length | None = None
    inner_arc_mm_per_10cm: float | None = None
    diameter_max_m: float | None = None
    volume_m3: float | None = None
    flags: str = ""

    @property
    def at_least(self) -> bool:
        """Whether the fruit continues out of sight, so that its length is a lower bound."""
        return is_lower_bound(self.flags.split())

    @classmethod
    def from_row(cls, row: Mapping[str, object]) -> GradingTraits:
        """Read a row of `measurements.csv` (or JSON), whose cells may be text or empty.

        Examples
        --------
        >>> row = {"thread_cm": "23.5", "chord_cm": 22.1, "volume_ml": ""}
        >>> traits = GradingTraits.from_row(row)
        >>> traits.thread_m, traits.volume_m3
        (0.235, None)
        """
        kinds: dict[str, Any] = {
            str(kind): kind for kind in (*result.LengthKind, *result.LengthDefinition)
        }
        kind, interval_of = (kinds.get(str(row.get(x))) for x in ("length_kind", "interval_of"))
        length = None
        if (value_m := _number(row, "length_cm", 100)) is not None and kind is not None:
            low_m, high_m = (_number(row, f"interval_{end}_cm", 100) for end in ("low", "high"))
            length = result.Length(value_m, kind, low_m, high_m, interval_of)
        return cls(
            thread_m=_number(row, "thread_cm", 100),
            centreline_m=_number(row, "centreline_cm", 100),
            chord_m=_number(row, "chord_cm", 100),
            length=length,
            inner_arc_mm_per_10cm=_number(row, "inner_arc_mm_per_10cm"),
            diameter_max_m=_number(row, "diameter_max_mm", 1000),
            volume_m3=_number(row, "volume_ml", 1e6),
            flags=str(row.get("flags") or ""),
        )


def _length(fruit: Any, kind: result.LengthDefinition) -> result.Length | None:
    """Return a fruit's length of one kind, with its interval if that is of the same kind."""
    measured: result.Length | None = fruit.length
    is_of_kind = measured is not None and measured.kind == kind
    value_m = measured.value_m if measured and is_of_kind else getattr(fruit, f"{kind}_m")
    if measured is None or measured.interval_of != kind:
        return result.Length(value_m, kind) if value_m else None
    return replace(measured, value_m=value_m, kind=kind) if value_m else None


@dataclass(frozen=True)
class Grade:
    """A fruit's grade.

    Parameters
    ----------
    verdict : GradeStatus
        Its status.
    name : str
        The class, 'too short', 'too long', 'no class', 'undecided' or 'not measured'.
    rules : tuple of str
        Explanations, the deciding rule first.
    probabilities : dict of str to float
        Probability of each possible name; empty without an interval, or for a lower bound.
    missing : tuple of str
        Traits that are needed and unknown.
    best_class : str
        The best class that the fruit's shape allows, for the forecast.
    shape, weight_class, diameter_class : str
        Further classes; empty if the profile has none, or a trait is missing or not known.
    mass_g : float, optional
        Volume times the profile's density; None where the size is not known.
    possible : tuple of str
        The classes that the interval spans, shortest first; a single one if it is decided.
    reason : str
        Why the class is not better ('by length', 'slightly crooked', 'too thin'), or undecided;
        empty in the best class, and if an interval spans several classes.
    """

    verdict: GradeStatus
    name: str
    rules: tuple[str, ...]
    probabilities: dict[str, float]
    missing: tuple[str, ...] = ()
    best_class: str = ""
    shape: str = ""
    weight_class: str = ""
    diameter_class: str = ""
    mass_g: float | None = None
    possible: tuple[str, ...] = ()
    reason: str = ""

    @property
    def label(self) -> str:
        """The class alone, for people: 'class II', 'too short', 'undecided'."""
        return class_name(self.name)

    @property
    def words(self) -> str:
        """The class with its reason, for people: 'class II (slightly crooked)'.

        Examples
        --------
        >>> grade = Grade(GradeStatus.UNDECIDED, UNDECIDED, (), {}, possible=("II", "I"))
        >>> grade.words
        'undecided: class II or I'
        """
        name = class_name(self.name)
        if self.reason:
            return with_reason(name, self.reason)
        if self.verdict is GradeStatus.UNDECIDED:
            return Message("{name}: {classes}", name=name, classes=choice_words(self.possible))
        return name


@dataclass(frozen=True)
class _Check:
    """Result of the rules on shape, weight or width, with the classes that they forbid."""

    name: str = ""
    forbidden: frozenset[str] = frozenset()
    rule: str = ""
    missing: str = ""
    reason: str = ""


def grade(fruit: Any, profile: CropProfile) -> Grade:
    """Grade a fruit by its length, and lower the class by the rules for shape, weight and width.

    Parameters
    ----------
    fruit : GradingTraits
        The fruit's traits, or any object with the same attributes, such as a stored row.
    profile : CropProfile
        The crop.

    Returns
    -------
    Grade
        If a rule forbids the class given by the length, the next worse allowed one, or none.
        Undecided if the 90 % interval of the length, or the range above a lower bound, spans
        several classes, and if the fruit's depth cannot be its distance; shape, mass and diameter
        count as exact.

    Examples
    --------
    >>> from cucumbervision.crop.profiles import load_profile
    >>> profile = load_profile("long-cucumber")
    >>> graded = grade(GradingTraits(centreline_m=0.234), profile)
    >>> graded.words, graded.rules[0]
    ('class II (by length)', 'class II: centreline length 23.4 cm is in [20, 25) (greenhouse ...')
    >>> grade(GradingTraits(centreline_m=0.13, flags="end-hidden"), profile).words
    'undecided (only part of it is seen)'
    """
    length = _length(fruit, profile.length)
    # A hidden part adds to mass and diameter, too.
    is_sized = not (fruit.at_least or is_length_unknown(fruit.flags.split()))
    mass_g = profile.mass_g(fruit.volume_m3) if is_sized and fruit.volume_m3 is not None else None
    length_cm = round(100 * length.value_m, 6) if length else 0.0
    is_possible = profile.acceptance.min_cm <= length_cm <= profile.acceptance.max_cm
    if length is None:
        words = f"{profile.length} length: no tube could be fitted, or it was not measured"
        is_measured = fruit.length is not None
        name = UNDECIDED if is_measured else NOT_MEASURED
        reason = f"no {profile.length} length" if is_measured else ""
        ungraded = Grade(GradeStatus.MISSING, name, (), {}, (words,), reason=reason)
        return replace(ungraded, mass_g=mass_g, possible=profile.outcomes)
    if not is_possible:
        rules, reason = (_refusal(length_cm, profile),), "such a length cannot be"
        ungraded = Grade(GradeStatus.REFUSED, UNDECIDED, rules, {}, reason=reason)
        return replace(ungraded, mass_g=mass_g, possible=profile.outcomes)
    checks = shape, weight, width = (
        _shape(fruit.inner_arc_mm_per_10cm, profile),
        _weight(mass_g, fruit.chord_m, profile) if is_sized else _Check(),
        _width(fruit.diameter_max_m, profile) if is_sized else _Check(),
    )
    by_bin = _classes_of_bins(profile, checks)
    range_m = _range_m(fruit, length)
    possible = possible_classes(*range_m, profile.edges_m, by_bin)
    name = class_of(possible)
    verdict = GradeStatus.NO_CLASS if name in WITHOUT_CLASS else GradeStatus.IN_CLASS
    chances = {} if math.isinf(range_m[1]) else _chances(length, profile, by_bin)
    missing = tuple(c.missing for c in checks if c.missing)
    if not chances and math.isfinite(range_m[1]):
        missing += (f"interval of the {profile.length} length: no probabilities",)
    return Grade(
        verdict=GradeStatus.UNDECIDED if name == UNDECIDED else verdict,
        name=name,
        rules=_rules(profile, length_cm, range_m, possible, checks),
        probabilities=chances,
        missing=missing,
        best_class=next((c.name for c in profile.classes if c.name not in shape.forbidden), ""),
        shape=shape.name,
        weight_class=weight.name,
        diameter_class=width.name,
        mass_g=mass_g,
        possible=possible,
        reason=_reason(name, profile, range_m, checks),
    )


def _refusal(length_cm: float, profile: CropProfile) -> Message:
    return Message(
        "refused: {kind} length {length:.1f} cm cannot be, {crop} is accepted from {low:g} to "
        "{high:g} cm; measure again",
        kind=Message(profile.length),
        length=length_cm,
        crop=Message(profile.title),
        low=profile.acceptance.min_cm,
        high=profile.acceptance.max_cm,
    )


def _range_m(fruit: Any, length: result.Length) -> tuple[float, float]:
    """Return the range of a fruit's length: its interval, or from a lower bound to infinity.

    Nothing is known of a length whose interval is too wide, or whose depth cannot be its distance.
    A length that was measured by a method and has no interval is as uncertain as in forecasts.
    """
    measured: result.Length | None = fruit.length
    if fruit.at_least:
        return length.value_m, math.inf
    if is_length_unknown(fruit.flags.split()):
        return 0.0, math.inf
    if measured is None:
        return length.value_m, length.value_m
    if measured.low_m is None or measured.high_m is None or measured.interval_of != measured.kind:
        spread = math.exp(result.INTERVAL_Z * result.UNKNOWN_SD)
        return length.value_m / spread, length.value_m * spread
    # The three lengths of a tube have the same relative error.
    share = length.value_m / measured.value_m
    return measured.low_m * share, measured.high_m * share


def _rules(
    profile: CropProfile,
    length_cm: float,
    range_m: tuple[float, float],
    possible: tuple[str, ...],
    checks: tuple[_Check, ...],
) -> tuple[str, ...]:
    """Return the rules behind a grade, the deciding one first."""
    lowering = tuple(check.rule for check in checks if check.rule)
    edges_cm = [-math.inf, *(profile.edges_m * 100), math.inf]
    k = int(np.searchsorted(edges_cm[1:-1], length_cm + 1e-6, side="right"))
    parts: dict[str, object] = {"kind": Message(profile.length), "length": length_cm}
    parts |= {"low": edges_cm[k], "high": edges_cm[k + 1]}
    rule = "class {name}: {kind} length {length:.1f} cm is in [{low:g}, {high:g})"
    if class_of(possible) == UNDECIDED:
        low_cm, high_cm = parts["low"], parts["high"] = 100 * range_m[0], 100 * range_m[1]
        rule = "undecided: {kind} length {low:.1f} to {high:.1f} cm: {classes}"
        if math.isinf(high_cm):
            rule = "undecided: {kind} length the length is uncertain"
            if low_cm:
                rule = "undecided: {kind} length at least {low:.1f} cm: only part of it is seen"
    elif k == 0:
        rule = "too short: {kind} length {length:.1f} cm is under {high:g}"
    elif k == len(edges_cm) - 2:
        rule = "too long: {kind} length {length:.1f} cm is {low:g} or more"
    parts |= {"name": profile.outcomes[profile.outcome_of_bin[k]]}
    message = Message(rule, **parts, classes=choice_words(possible))
    by_length = _sourced(message, profile, "classes")
    is_lowered = len(possible) == 1 and possible != (_classes_of_bins(profile, ())[k],)
    return (*lowering, by_length) if is_lowered else (by_length, *lowering)


_PART, _UNCERTAIN = "only part of it is seen", "the length is uncertain"


def _reason(
    name: str, profile: CropProfile, range_m: tuple[float, float], checks: tuple[_Check, ...]
) -> str:
    """Return why a fruit is in no better class; empty in the best class or if the name shows it."""
    if name == UNDECIDED and math.isinf(range_m[1]):
        return _PART if range_m[0] else _UNCERTAIN
    if name in (profile.classes[0].name, UNDECIDED, *profile.outcomes[-2:]):
        return ""
    by_length = possible_classes(*range_m, profile.edges_m, _classes_of_bins(profile, ()))
    if by_length == (name,):
        return "by length"
    return joined(check.reason for check in checks if check.forbidden and check.reason)


def _classes_of_bins(profile: CropProfile, checks: tuple[_Check, ...]) -> list[str]:
    """Return the class of each bin of the length, the next worse one where a rule forbids it."""
    names = [c.name for c in profile.classes]
    forbidden = frozenset().union(*(c.forbidden for c in checks))
    classes = []
    for outcome in profile.outcome_of_bin:
        allowed = [name for name in names[outcome:] if name not in forbidden]
        fallback = profile.outcomes[outcome] if outcome >= len(names) else NO_CLASS
        classes.append(allowed[0] if allowed else fallback)
    return classes


def _chances(length: result.Length, profile: CropProfile, by_bin: list[str]) -> dict[str, float]:
    if length.sides is None:
        return {}
    below = np.concatenate([[0.0], share_below(length, profile.edges_m), [1.0]])
    chances = dict.fromkeys((*profile.outcomes, *by_bin), 0.0)
    for name, share in zip(by_bin, np.diff(below), strict=True):
        chances[name] += float(share)
    return chances


def _shape(arc_mm: float | None, profile: CropProfile) -> _Check:
    if not profile.shape or arc_mm is None:
        missing = "inner arc height: taken as straight" if profile.shape else ""
        return _Check(missing=missing)
    names, bands = [c.name for c in profile.classes], profile.shape
    band = next((b for b in bands if arc_mm <= (b.max_mm_per_10cm or math.inf)), bands[-1])
    better = frozenset(names[: names.index(band.best_class)])
    if not better:
        return _Check(band.name)
    rule = "at best class {name}, {shape}: inner arc {arc:.1f} mm for each 10 cm of chord"
    parts = {"name": band.best_class, "shape": Message(band.name), "arc": arc_mm}
    rule = _sourced(Message(rule, **parts), profile, "shape")
    return _Check(band.name, better, rule, reason=band.name)


def _weight(mass_g: float | None, chord_m: float | None, profile: CropProfile) -> _Check:
    if profile.minimum_g is None and not profile.weights:
        return _Check()
    if mass_g is None:
        return _Check(missing="volume: no weight class")
    if profile.minimum_g is not None and mass_g < profile.minimum_g:
        rule = "too light: about {mass:.0f} g, at least {limit:g} g required"
        rule = Message(rule, mass=mass_g, limit=profile.minimum_g)
        return _forbidding(profile, "", rule, "minimum_g", "too light")
    bands = (b for b in profile.weights if b.min_g <= mass_g < (b.max_g or math.inf))
    band = next(bands, None)
    if band is None or band.shortest_cm is None:
        return _Check(band.name if band else "")
    if chord_m is None:
        return _Check(band.name, missing="chord: not compared with the weight")
    if round(100 * chord_m, 6) >= band.shortest_cm:
        return _Check(band.name)
    rule = Message(
        "not class {classes}: chord {length:.1f} cm, {weight} must be {limit:g} cm long",
        classes=joined(band.shortest_for, "{first} or {second}"),
        length=100 * chord_m,
        weight=Message(band.name),
        limit=band.shortest_cm,
    )
    reason = "short for its weight"
    return _forbidding(profile, band.name, rule, "weights", reason, band.shortest_for)


def _width(diameter_m: float | None, profile: CropProfile) -> _Check:
    least_mm = profile.minimum_diameter_mm
    if least_mm is None and not profile.diameters:
        return _Check()
    if diameter_m is None:
        return _Check(missing="largest diameter: no width class")
    width_mm = round(1000 * diameter_m, 6)
    if least_mm is not None and width_mm < least_mm:
        rule = "too thin: {width:.1f} mm, at least {limit:g} mm required"
        rule = Message(rule, width=width_mm, limit=least_mm)
        return _forbidding(profile, "", rule, "minimum_diameter_mm", "too thin")
    bands = (b.name for b in profile.diameters if b.max_mm is None or width_mm <= b.max_mm)
    return _Check(next(bands, ""))


def _forbidding(
    profile: CropProfile,
    name: str,
    rule: Message,
    key: str,
    reason: str,
    forbidden: Iterable[str] | None = None,
) -> _Check:
    """Return a check on weight or width that forbids classes, all by default, or only remarks."""
    rule = _sourced(rule, profile, key)
    if profile.size_rules == "remark":
        return _Check(name, rule=Message("remark: {rule}", rule=rule))
    every_class = (c.name for c in profile.classes)
    return _Check(name, frozenset(forbidden or every_class), rule, reason=reason)


def _sourced(rule: Message, profile: CropProfile, key: str) -> Message:
    """Return a rule with the source that the profile names for it."""
    return with_reason(rule, profile.rules[key]) if key in profile.rules else rule


def _number(row: Mapping[str, object], key: str, per_unit: float = 1.0) -> float | None:
    cell = row.get(key)
    value = math.nan if cell is None or cell == "" else float(str(cell)) / per_unit
    return value if math.isfinite(value) else None
