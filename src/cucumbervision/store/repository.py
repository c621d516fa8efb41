"""The store: rounds, stops and fruit in a database, their pictures beside it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.errors import StoreError
from cucumbervision.store import derived, details, manual, reading, writing
from cucumbervision.store.engine import begin, database_url, make_engine, named
from cucumbervision.store.images import ImageStore
from cucumbervision.store.migrate import migrate
from cucumbervision.store.views import FruitFilter, LinkKind

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import TracebackType
    from typing import Self

    from sqlalchemy import Engine

    from cucumbervision.store.records import (
        FruitRecord,
        MethodRecord,
        RoundRecord,
        StopRecord,
    )
    from cucumbervision.store.views import (
        ActionView,
        CameraAt,
        FruitDetail,
        FruitView,
        LinkRecord,
        Position,
        RoundView,
        Saved,
        ShiftRecord,
        StopView,
        Verdict,
    )

__all__ = ["Store", "open_store"]


def open_store(where: str | Path, *, images: Path | None = None, create: bool = True) -> Store:
    """Open a store; a new one is made, an older one brought up to date.

    Parameters
    ----------
    where : str or Path
        The path of an SQLite file, or 'postgresql://user@host/database'.
    images : Path, optional
        Folder of the pictures. Beside an SQLite file 'house.db' it is 'house.images'; with
        PostgreSQL it must be named before pictures are read or written.
    create : bool
        False refuses an SQLite file that is not there, for who only wants to read.

    Raises
    ------
    StoreVersionError
        If a newer version of the software wrote it; nothing is changed then.
    StoreError
        If it cannot be opened, or is no store.
    MissingExtraError
        If PostgreSQL's driver is not installed.

    Examples
    --------
    >>> import tempfile
    >>> from cucumbervision.store.records import CaptureRecord, FruitRecord, RoundRecord
    >>> from cucumbervision.store.records import StopRecord, new_key
    >>> walk, stop = RoundRecord(name="morning"), new_key()
    >>> capture = CaptureRecord("a", fruit=(FruitRecord(1, length_m=0.31),))
    >>> record = StopRecord(stop, walk.key, row="3", position_m=1.2, captures=(capture,))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with open_store(Path(folder) / "house.db") as store:
    ...         print(store.save_round(walk), store.save_stop(record), store.save_stop(record))
    ...         [fruit] = store.fruit(walk.key)
    ...         print(fruit.row, fruit.along_m, fruit.record.length_m)
    new new already-there
    3 1.2 0.31
    """
    url = database_url(where)
    if not create and url.get_backend_name() == "sqlite" and not Path(url.database or "").exists():
        raise StoreError("is not there", source=named(url), remedy="check the path")
    engine = make_engine(url)
    try:
        migrate(engine)
    except BaseException:
        engine.dispose()
        raise
    if images is None and url.get_backend_name() == "sqlite":
        images = Path(url.database or "").with_suffix(".images")
    return Store(engine, images)


class Store:
    """An open store; `open_store` makes it. Any number of threads may use one.

    Each method is one transaction: what it writes is there whole or not at all, and on the disk
    when it returns. All raise `StoreError` where the database says no, or a key is not there.
    """

    def __init__(self, engine: Engine, images: Path | None) -> None:
        self.engine = engine
        self._images = images

    @property
    def name(self) -> str:
        """The database's name, without its password."""
        return named(self.engine.url)

    @property
    def images(self) -> ImageStore:
        """The pictures beside the database."""
        if self._images is None:
            raise StoreError(
                "it is not said where the pictures lie",
                source=self.name,
                remedy="open the store with images=FOLDER",
            )
        return ImageStore(self._images)

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    # Writing what was measured.

    def save_round(self, record: RoundRecord) -> Saved:
        """Add a round; the same one sent again changes nothing.

        Raises
        ------
        StoreConflictError
            If another round has its key.
        """
        with begin(self.engine, write=True) as connection:
            return writing.save_round(connection, record)

    def save_stop(self, stop: StopRecord) -> Saved:
        """Add a stop with all that is in it; the same one sent again changes nothing.

        Put its pictures into `images` first: a picture without a stop can be found and removed
        (`check_store`), a stop without its picture cannot be repaired.

        Raises
        ------
        StoreConflictError
            If another stop has its key.
        """
        stop = writing.checked_stop(stop)
        with begin(self.engine, write=True) as connection:
            return writing.save_stop(connection, stop)

    # Reading.

    def rounds(self, house: str | None = None) -> list[RoundView]:
        """List rounds, the newest first."""
        with begin(self.engine) as connection:
            return reading.round_views(connection, house)

    def stops(self, round_key: str) -> list[StopView]:
        """List a round's stops in the order in which they were made."""
        with begin(self.engine) as connection:
            return reading.stop_views(connection, round_key)

    def fruit(self, round_key: str, only: FruitFilter | None = None) -> list[FruitView]:
        """List a round's detections in the order of its stops, or those that a filter keeps.

        `FruitFilter(best=True)` gives every fruit once, however often it was seen.
        """
        with begin(self.engine) as connection:
            views = reading.fruit_views(connection, round_key)
        return views if only is None else [view for view in views if only.keeps(view)]

    def measurements(self, round_key: str) -> dict[str, tuple[MethodRecord, ...]]:
        """Give every method's first measurement by fruit key, without the paths."""
        with begin(self.engine) as connection:
            return reading.method_records(connection, round_key)

    def cameras(self, round_key: str) -> dict[str, CameraAt]:
        """Give where the cameras of a round stood, by the stops' keys."""
        with begin(self.engine) as connection:
            return reading.cameras_at(connection, round_key)

    def stop(self, stop_key: str) -> StopRecord:
        """Give a stop with everything, as it was saved."""
        with begin(self.engine) as connection:
            return details.stop_record(connection, stop_key)

    def one_fruit(self, fruit_key: str) -> FruitDetail:
        """Give a detection with everything: mask, methods, paths, capture, links and log."""
        with begin(self.engine) as connection:
            return details.fruit_detail(connection, fruit_key)

    def links(self, round_key: str, kind: LinkKind | None = None) -> list[LinkRecord]:
        """List the links that touch a round; of growth both from earlier and to later rounds."""
        with begin(self.engine) as connection:
            return reading.link_records(connection, round_key, kind)

    def shifts(self, later: str) -> list[ShiftRecord]:
        """List how far rows were moved between earlier rounds and this one."""
        with begin(self.engine) as connection:
            return reading.shift_records(connection, later)

    # What algorithms say of whole rounds.

    def save_merging(
        self,
        round_key: str,
        links: Sequence[LinkRecord],
        positions: Mapping[str, Position] | None = None,
    ) -> int:
        """Replace a round's links of `LinkKind.SAME` and its stops' fitted positions.

        What was linked or parted by hand stands; the number of links written is given.
        """
        with begin(self.engine, write=True) as connection:
            return derived.save_merging(connection, round_key, links, positions or {})

    def save_growth(
        self,
        earlier: str,
        later: str,
        links: Sequence[LinkRecord],
        shifts: Sequence[ShiftRecord] = (),
    ) -> int:
        """Replace the links of `LinkKind.GROWTH` between two rounds, and their rows' shifts.

        What was linked or parted by hand stands; the number of links written is given.
        """
        with begin(self.engine, write=True) as connection:
            return derived.save_growth(connection, earlier, later, links, shifts)

    # What people do by hand; each gives its line's number in the log.

    def set_verdict(self, fruit: Sequence[str], verdict: Verdict | None, *, by: str = "") -> int:
        """Accept or reject fruit; None takes the verdict away."""
        with begin(self.engine, write=True) as connection:
            return manual.set_verdict(connection, fruit, verdict, by)

    def pick(self, fruit: Sequence[str], *, at_s: float | None = None, by: str = "") -> int:
        """Say that fruit were picked: now, or when."""
        with begin(self.engine, write=True) as connection:
            return manual.pick(connection, fruit, time.time() if at_s is None else at_s, by)

    def unpick(self, fruit: Sequence[str], *, by: str = "") -> int:
        """Say that fruit were not picked."""
        with begin(self.engine, write=True) as connection:
            return manual.pick(connection, fruit, None, by)

    def correct(self, fruit_key: str, fruit: FruitRecord, *, by: str = "") -> int:
        """Let a fruit measured anew, with a corrected mask, stand for the first measurement."""
        with begin(self.engine, write=True) as connection:
            return manual.correct(connection, fruit_key, fruit, by)

    def merge(self, first: str, second: str, *, by: str = "") -> int:
        """Say that two detections of a round are one fruit, and so all that each is merged with."""
        with begin(self.engine, write=True) as connection:
            return manual.merge(connection, first, second, by)

    def unmerge(self, fruit_key: str, *, by: str = "") -> int:
        """Say that a detection is another fruit than all that it is merged with.

        Raises
        ------
        StoreError
            If it is merged with none.
        """
        with begin(self.engine, write=True) as connection:
            return manual.unmerge(connection, fruit_key, by)

    def link_growth(self, earlier: str, later: str, *, by: str = "") -> int:
        """Say that a fruit of a later round is this fruit of an earlier one."""
        with begin(self.engine, write=True) as connection:
            return manual.link(connection, LinkKind.GROWTH, [(earlier, later)], "link-growth", by)

    def unlink_growth(self, earlier: str, later: str, *, by: str = "") -> int:
        """Say that two fruit of different rounds are not one."""
        with begin(self.engine, write=True) as connection:
            return manual.link(connection, LinkKind.APART, [(earlier, later)], "unlink-growth", by)

    def log(self, round_key: str | None = None, *, limit: int | None = 200) -> list[ActionView]:
        """List what was done by hand, the newest first."""
        with begin(self.engine) as connection:
            return details.action_views(connection, round_key, limit)

    def undo(self, round_key: str | None = None, *, number: int | None = None, by: str = "") -> int:
        """Take back an action: the round's newest that was not taken back, or the one named.

        Raises
        ------
        StoreConflictError
            If a later action stands on it.
        StoreError
            If there is nothing to take back.
        """
        with begin(self.engine, write=True) as connection:
            round_id = None if round_key is None else writing.round_id_of(connection, round_key)
            return manual.undo(connection, by, number, round_id)
