"""The intervals that come with the package: one model a method, learnt on simulated fruit."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import ModelError
from cucumbervision.measurement.uncertainty import Band, IntervalModel

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["BASIS", "SCALE_SD", "IntervalBook", "read_book", "shipped_book", "write_book"]

BASIS = "simulated"
SCALE_SD = 0.01  # of a D4xx that nobody calibrated: the data sheet allows 2 % at 2 m
_SHIPPED = Path(__file__).with_name("interval_models.json")


@dataclass(frozen=True)
class IntervalBook:
    """Interval models by what they are the interval of.

    Parameters
    ----------
    level : float
        The level of every interval.
    models : dict of str to IntervalModel
        Keys 'M1' … 'M6' (all about the centreline), 'M6 thread', 'M6 chord'.
    fruit : int
        Simulated fruit behind them.
    """

    level: float
    models: dict[str, IntervalModel]
    fruit: int

    def interval(
        self, key: str, length_m: float, features: Mapping[str, float], *, scale_known: bool
    ) -> tuple[float, float] | None:
        """Give the interval of a length; None where there is no model of that key.

        Parameters
        ----------
        key : str
            A key of `models`.
        length_m : float
            The length in metres.
        features : mapping of str to float
            From `measurement.interval_features`.
        scale_known : bool
            Whether the camera's depth scale was measured with a bar of known length.
        """
        model = self.models.get(key)
        if model is None:
            return None
        return model.interval(length_m, features, 0.0 if scale_known else SCALE_SD)


def write_book(path: Path, book: IntervalBook) -> None:
    """Write a book as JSON, numbers to nine digits."""
    models = [_rounded(asdict(model)) for model in book.models.values()]
    content = {"basis": BASIS, "level": book.level, "fruit": book.fruit, "models": models}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.9g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value


def read_book(path: Path) -> IntervalBook:
    """Read a book.

    Raises
    ------
    ModelError
        If the file is none.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "book.json"
    >>> bands = {"": Band(0.001, 1.5, 1.7, 700)}
    >>> model = IntervalModel("M6", 0.9, ("tilt",), (-4.5, 0.5), bands, (("tilt", (0.25,)),))
    >>> book = IntervalBook(0.9, {"M6": model}, 700)
    >>> write_book(path, book)
    >>> read_book(path) == book
    True
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        models = {}
        for item in content["models"]:
            models[item["method"]] = IntervalModel(
                item["method"],
                item["level"],
                tuple(item["features"]),
                tuple(item["weights"]),
                {group: Band(**band) for group, band in item["bands"].items()},
                tuple((name, tuple(limits)) for name, limits in item["edges"]),
            )
        return IntervalBook(float(content["level"]), models, int(content["fruit"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ModelError(
            f"is no book of intervals ({error})", source=path, remedy="install the package anew"
        ) from None


@lru_cache(maxsize=1)
def shipped_book() -> IntervalBook:
    """Give the book that comes with the package."""
    return read_book(_SHIPPED)
