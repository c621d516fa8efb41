"""Summary of a run, accumulated by capture, for the screen, the workbook and the JSON."""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field
from statistics import fmean, median, stdev
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import Message, joined
from cucumbervision.methods.flags import Flag, data_doubts, is_length_unknown, is_lower_bound
from cucumbervision.methods.result import Choice
from cucumbervision.methods.table import AVAILABLE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from cucumbervision.run.fields import Cell


# Depth steps other than 1 mm, in mm: D405 cameras, TUM's, L515 cameras, micrometres, cm, metres.
_STEPS = (0.1, 0.2, 0.25, 0.001, 10.0, 1000.0)
_USUAL_CM = (5.0, 50.0)


def _by_class(counts: Mapping[str, int]) -> Message:
    named = ((name or "without a name", count) for name, count in counts.items())
    return joined(Message("{count} of class {name}", count=n, name=name) for name, n in named)


@dataclass
class Summary:
    """Counts and lengths of a run; uses eight bytes per fruit.

    Parameters
    ----------
    captures, fruit : int
        Number of captures and of fruit, including fruit without a length.
    lengths_cm : array of float
        Lengths that are neither lower bounds nor unknown.
    lower_bounds_cm : array of float
        Lower bounds of fruit that continue out of sight.
    unknown_cm : array of float
        Lengths of which nothing is known (`flags.is_length_unknown`).
    refused_cm : list of float
        Lengths of fruit of implausible size.
    too_large : int
        Number of these that are too long or too thick.
    methods, masks : Counter
        Number of fruit by chosen method, and by source of the mask; '' for none.
    labels, left_out : Counter
        Number of fruit by class, and of detections of excluded classes.
    flags : Counter
        Number of fruit by flag.
    simulated : bool
        Whether some captures are simulated.
    models : list of dict
        The networks that were used.

    Examples
    --------
    >>> cells = {"length_cm": 12.5, "method": "M6", "mask_source": None, "simulated": False}
    >>> summary = Summary()
    >>> summary.add([cells, cells | {"length_cm": None, "method": None}])
    >>> summary.captures, summary.fruit, summary.measured, summary.methods
    (1, 2, 1, Counter({'M6': 1, '': 1}))
    """

    captures: int = 0
    fruit: int = 0
    lengths_cm: array[float] = field(default_factory=lambda: array("d"))
    lower_bounds_cm: array[float] = field(default_factory=lambda: array("d"))
    unknown_cm: array[float] = field(default_factory=lambda: array("d"))
    refused_cm: list[float] = field(default_factory=list)
    too_large: int = 0
    methods: Counter[str] = field(default_factory=Counter)
    masks: Counter[str] = field(default_factory=Counter)
    labels: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    flags: Counter[str] = field(default_factory=Counter)
    simulated: bool = False
    models: list[dict[str, Any]] = field(default_factory=list)

    @property
    def measured(self) -> int:
        """Number of fruit with a length."""
        return len(self.lengths_cm) + len(self.lower_bounds_cm) + len(self.unknown_cm)

    def add(
        self,
        rows: Iterable[Mapping[str, Cell]],
        models: Iterable[dict[str, Any]] = (),
        left_out: Mapping[str, int] | None = None,
    ) -> None:
        """Count a capture."""
        self.captures += 1
        self.left_out.update(left_out or {})
        for row in rows:
            self.fruit += 1
            flags = str(row.get("flags") or "").split()
            if row["length_cm"] is not None:
                self._lengths_of_kind(flags).append(float(row["length_cm"]))
            self.methods[str(row["method"] or "")] += 1
            refused = row.get("reason")
            large = Flag.DEPTH_UNIT in flags
            if refused == Choice.IMPLAUSIBLE or (refused == Choice.IMPLAUSIBLE_DIAMETER and large):
                self.too_large += large
                read = [row[f"{method.lower()}_cm"] for method in reversed(AVAILABLE)]
                self.refused_cm.append(next(float(x) for x in read if x is not None))
            self.masks[str(row["mask_source"] or "")] += 1
            self.labels[str(row.get("label") or "")] += 1
            self.flags.update(flags)
            self.simulated = self.simulated or bool(row["simulated"])
        self.models += [model for model in models if model not in self.models]

    def _lengths_of_kind(self, flags: list[str]) -> array[float]:
        if is_lower_bound(flags):
            return self.lower_bounds_cm
        return self.unknown_cm if is_length_unknown(flags) else self.lengths_cm

    def doubts(self) -> list[str]:
        """Return one line for each doubt about the data, with the remedy."""
        return [*self.unit_hints(), *self._class_notes(), *data_doubts(self.flags, self.fruit)]

    def _class_notes(self) -> list[str]:
        """Return a note on measured and excluded classes, if there are several.

        Examples
        --------
        >>> Summary(labels=Counter(cucumber=2, leaf=1))._class_notes()
        ['measured as fruit: 2 of class cucumber, 1 of class leaf; --classes chooses among them']
        """
        notes: list[str] = []
        if len(self.labels) > 1:
            note = "measured as fruit: {classes}; --classes chooses among them"
            notes.append(Message(note, classes=_by_class(self.labels)))
        if self.left_out:
            notes.append(Message("left out: {classes}", classes=_by_class(self.left_out)))
        return notes

    def unit_hints(self) -> list[str]:
        """Return likely explanations if all sizes are impossible, or half too large.

        Examples
        --------
        >>> Summary(refused_cm=[148.0, 180.0], fruit=2).unit_hints()[0]
        'no fruit has a possible size (median 164 cm): is one step of depth really 1 mm? ...'
        """
        sized = len(self.refused_cm) + self.measured
        if not self.refused_cm or (self.measured and 2 * self.too_large < sized):
            return []
        middle = median(self.refused_cm)
        fault = "no fruit has a possible size (median {size:.3g} cm)"
        if self.measured:
            fault = "{count} of {fruit} fruit are too large (median {size:.3g} cm)"
        fault = Message(fault, count=self.too_large, fruit=sized, size=middle)
        steps = [s / 1000 for s in _STEPS if _USUAL_CM[0] <= middle * s <= _USUAL_CM[1]]
        doubt = "is one step of depth really 1 mm? --depth-unit {steps} would explain it"
        if not steps:
            doubt = "do the intrinsics belong to this camera's colour at this size?"
        asked = joined((Message("{step:g}", step=s) for s in steps), "{first} or {second}")
        return [Message("{fault}: {doubt}", fault=fault, doubt=Message(doubt, steps=asked))]

    def lines(self, failures: int, provenance: Mapping[str, Any]) -> list[tuple[str, Any]]:
        """Return pairs of label and value for the first sheet of the workbook.

        Parameters
        ----------
        failures : int
            Number of captures that could not be read, measured or written.
        provenance : mapping
            As `tables.provenance_of` returns it.
        """
        lines: list[tuple[str, Any]] = [
            ("Captures", self.captures),
            ("Fruit", self.fruit),
            ("Fruit measured", self.measured),
            ("of these only in part (lower bounds)", len(self.lower_bounds_cm)),
            ("of these uncertain (left out of the statistics)", len(self.unknown_cm)),
            ("Inputs that could not be read", failures),
        ]
        if self.simulated:
            lines.append(("Note", "some of these captures are simulated"))
        lines += self._statistics()
        for what, counts in (("method", self.methods), ("source of the mask", self.masks)):
            named = sorted((name or "none", count) for name, count in counts.items())
            lines += [(f"Fruit by {what} {name}", count) for name, count in named]
        lines += [
            ("Software", provenance["software"]),
            ("Licence", provenance["licence"]),
            ("Source", provenance["source"]),
            ("Started (UTC)", provenance["started"]),
            ("Configuration SHA-256", provenance["config_sha256"]),
        ]
        if provenance["calibration"]:
            lines.append(("Calibration", provenance["calibration"]["tag"]))
        return lines + [
            (f"Plug-in {m['name']}", f"{m['package']} {m['version']}".strip())
            if "package" in m
            else (f"Model {m['name']}", f"{m['runtime']} {m['sha256']}")
            for m in self.models
        ]

    def _statistics(self) -> list[tuple[str, Any]]:
        lengths_cm = self.lengths_cm
        if not lengths_cm:
            return []
        lines = [
            ("Mean length [cm]", round(fmean(lengths_cm), 2)),
            ("Median length [cm]", round(median(lengths_cm), 2)),
            ("Shortest [cm]", round(min(lengths_cm), 2)),
            ("Longest [cm]", round(max(lengths_cm), 2)),
        ]
        if len(lengths_cm) > 1:
            lines.append(("Standard deviation [cm]", round(stdev(lengths_cm), 2)))
        return lines
