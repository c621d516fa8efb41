"""A data set's card: what is in it, from whom, and under which licence, in Markdown."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision_lab.datasets.labels import SPLITS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

_HIDDEN = ((0.0, 0.01), (0.01, 0.1), (0.1, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0))


def dataset_card(dataset: DataSet, title: str = "Data set") -> str:
    """Describe a data set.

    Parameters
    ----------
    dataset : DataSet
    title : str
        The page's head.

    Returns
    -------
    str
        Markdown: counts by split, source and licence, sizes, how much is hidden, distances.
        Nothing in it depends on when or where it is made.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture
    >>> one = LabelledPicture("a.jpg", 64, 48, scene="s", source="mine", licence="CC0-1.0")
    >>> print(dataset_card(DataSet(Path("x"), (one,)), "One picture").split("## ")[0].strip())
    # One picture
    <BLANKLINE>
    1 pictures of 1 scenes, 0 labelled fruit, 0 labels to ignore.
    """
    pictures = dataset.pictures
    fruit = [label for p in pictures for label in p.labels if not label.ignore]
    ignored = sum(label.ignore for p in pictures for label in p.labels)
    scenes = len({p.scene for p in pictures if p.scene})
    sizes = [
        100 * float(np.hypot(*(x.box[2:] - x.box[:2])) / np.hypot(p.width, p.height))
        for p in pictures
        for x in p.labels
        if not x.ignore
    ]
    # Files of others may say anything there; a number is one.
    said = (x.extras.get("distance_m") for x in fruit)
    numbers = (x for x in said if isinstance(x, int | float) and not isinstance(x, bool))
    distances = [float(x) for x in numbers if abs(x) < 1e6]
    return "\n".join(
        [
            f"# {title}",
            "",
            f"{len(pictures)} pictures of {scenes} scenes, {len(fruit)} labelled fruit, "
            f"{ignored} labels to ignore.",
            "",
            *_counts("Splits", "split", pictures, lambda p: p.split or "none", SPLITS),
            *_counts("Sources", "source", pictures, lambda p: p.source or "not stated"),
            *_counts("Licences", "licence", pictures, lambda p: p.licence or "not stated"),
            *_classes(dataset, fruit),
            *_truth(fruit),
            *_spread("Size", "box's diagonal, % of the picture's", sizes),
            *_hidden(fruit),
            *_spread("Distance", "distance, m", distances),
        ]
    )


def _table(head: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    lines = [f"## {head}", "", f"| {' | '.join(columns)} |"]
    lines.append("|---" + "|--:" * (len(columns) - 1) + "|")
    # A licence's text may hold anything; a bar would end the cell.
    lines += ["| " + " | ".join(str(c).replace("|", "\\|") for c in row) + " |" for row in rows]
    return [*lines, ""]


def _counts(
    head: str,
    column: str,
    pictures: Sequence[LabelledPicture],
    key: Callable[[LabelledPicture], str],
    order: Sequence[str] = (),
) -> list[str]:
    groups: dict[str, list[LabelledPicture]] = {}
    for picture in pictures:
        groups.setdefault(key(picture), []).append(picture)
    names = [n for n in order if n in groups] + sorted(n for n in groups if n not in order)
    columns = (column, "pictures", "scenes", "with fruit", "fruit", "pseudo masks")
    return _table(head, columns, [(name, *_row(groups[name])) for name in names])


def _row(pictures: Sequence[LabelledPicture]) -> tuple[int, ...]:
    fruit = [[label for label in p.labels if not label.ignore] for p in pictures]
    return (
        len(pictures),
        len({p.scene for p in pictures if p.scene}),
        sum(bool(labels) for labels in fruit),
        sum(map(len, fruit)),
        sum(label.pseudo for labels in fruit for label in labels),
    )


def _classes(dataset: DataSet, fruit: Sequence[Label]) -> list[str]:
    counts = Counter(label.category for label in fruit)
    rows = [(name, counts[k]) for k, name in enumerate(dataset.categories)]
    return _table("Classes", ("class", "fruit"), rows)


def _truth(fruit: Sequence[Label]) -> list[str]:
    rows = [
        ("box", len(fruit)),
        ("visible mask", sum(x.mask_code is not None for x in fruit)),
        ("of these drawn by a network", sum(x.pseudo for x in fruit)),
        ("whole (amodal) mask", sum(x.amodal_code is not None for x in fruit)),
        ("keypoints", sum(x.keypoints is not None for x in fruit)),
        ("length", sum("centreline_m" in x.extras for x in fruit)),
        ("cut off by the border", sum(x.cut_off for x in fruit)),
    ]
    return _table("What is known of a fruit", ("known", "fruit"), rows)


def _spread(head: str, what: str, values: Sequence[float]) -> list[str]:
    if not values:
        return []
    marks = (0, 5, 25, 50, 75, 95, 100)
    columns = (what, *("least" if m == 0 else "most" if m == 100 else f"{m} %" for m in marks))
    return _table(head, columns, [("", *(f"{v:.2f}" for v in np.percentile(values, marks)))])


def _hidden(fruit: Sequence[Label]) -> list[str]:
    shares = np.array([x.hidden_share for x in fruit if x.hidden_share is not None])
    if not len(shares):
        return []
    rows: list[tuple[str, int]] = []
    for low, high in _HIDDEN:
        inside = (shares >= low) & ((shares < high) | (high == 1.0))
        rows.append((f"{100 * low:.0f} to {100 * high:.0f} %", int(inside.sum())))
    return _table("Hidden share", ("of the fruit's outline", "fruit"), rows)
