"""Classes under other names, and classes left out."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from cucumbervision.errors import DataSetError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision_lab.datasets.labels import DataSet

__all__ = ["class_index", "keep_classes"]


def class_index(
    names: Sequence[str], keep: Mapping[int | str, str]
) -> tuple[dict[int, int], tuple[str, ...]]:
    """Give each kept class's new number, and the new names.

    Raises
    ------
    DataSetError
        If a class is not there.
    """
    wanted = {str(k): v for k, v in keep.items()}
    unknown = [k for k in wanted if k not in names and not (k.isdecimal() and int(k) < len(names))]
    if unknown:
        raise DataSetError(
            f"no class is called {', '.join(unknown)}", remedy=f"there are {', '.join(names)}"
        )
    categories = tuple(dict.fromkeys(wanted.values()))
    index = {}
    for k, name in enumerate(names):
        new = wanted.get(name, wanted.get(str(k)))
        if new is not None:
            index[k] = categories.index(new)
    return index, categories


def keep_classes(dataset: DataSet, keep: Mapping[int | str, str]) -> DataSet:
    """Rename classes; what is not kept becomes background.

    Parameters
    ----------
    dataset : DataSet
    keep : mapping of int or str to str
        Number or name of each class to keep, and what it becomes; several may become one.

    Raises
    ------
    DataSetError
        If a class is not there.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture
    >>> both = tuple(Label(np.array([0.0, 0, 9, 9]), category=k) for k in (0, 1))
    >>> data = DataSet(Path("x"), (LabelledPicture("a", 64, 48, both),), ("zucchini", "carrot"))
    >>> kept = keep_classes(data, {"zucchini": "cucumber"})
    >>> kept.categories, len(kept.pictures[0].labels)
    (('cucumber',), 1)
    """
    index, categories = class_index(dataset.categories, keep)
    pictures = tuple(
        replace(
            p,
            labels=tuple(
                replace(x, category=index[x.category]) for x in p.labels if x.category in index
            ),
        )
        for p in dataset.pictures
    )
    return replace(dataset, pictures=pictures, categories=categories)
