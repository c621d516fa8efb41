"""The store: rounds, stops and fruit in a database, their images beside it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from math import hypot
from pathlib import Path
from typing import Any

from sqlalchemy import ColumnElement, Connection, Table, and_, func, insert, select, update

from cucumbervision.errors import StoreError, wrap_reader_errors
from cucumbervision.names import checked_name, same_house
from cucumbervision_greenhouse.store.engine import database_url, make_engine, named, prepare
from cucumbervision_greenhouse.store.images import ImageStore
from cucumbervision_greenhouse.store.marks import (
    IS_ACTIVE,
    NOT_UNDONE,
    Marks,
    check_place,
    find_fruit,
    forget_links,
    links_of,
    marks_of,
    round_id_of,
    write_mark,
)
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    DetectionDetail,
    FruitRow,
    LinkKind,
    LinkRecord,
    LogEntry,
    Round,
    StopRecord,
    Verdict,
    key_of,
)
from cucumbervision_greenhouse.store.schema import (
    CAPTURES,
    FRUIT,
    LINKS,
    MARKS,
    ROUNDS,
    SHAPES,
    STOPS,
)

_ROUND_CELLS = ("key", "name", "house", "started_s", "profile", "note")
_STOP_CELLS = (
    *("key", "row", "side", "position_m", "position_sd_m", "step", "taken_s", "pose", "note"),
    *("failures", "artifacts", "mirrored", "fitted_m", "fitted_sd_m"),
)
_CAPTURE_CELLS = ("name", "simulated", "color", "depth", "thumbnail")
_CAPTURE_RECORD = tuple(
    column.name for column in fields(CaptureRecord) if column.name not in (*_CAPTURE_CELLS, "fruit")
)
_ROW_CELLS = tuple(
    column
    for column in FRUIT.c
    if column.name not in ("id", "key", "capture_id", "round_id", "deleted")
)
_UNDONE_AMONG = 500  # newest lines of the log


def open_store(where: str | Path, *, images: Path | None = None, create: bool = True) -> Store:
    """Open a store; a new one is made where there is none.

    Parameters
    ----------
    where : str or Path
        The path of an SQLite file, or 'postgresql://user@host/database?images=FOLDER'.
    images : Path, optional
        Folder of the images; by default that of the address. Beside an SQLite file 'house.db' it
        is 'house.images'; with PostgreSQL it must be named before images are read or written.
    create : bool
        False refuses an SQLite file that is not there: for reading alone.

    Raises
    ------
    StoreVersionError
        If another version of the software wrote it; nothing is changed then.
    StoreError
        If it cannot be opened, or is no store.
    MissingExtraError
        If PostgreSQL's driver is not installed.

    Examples
    --------
    >>> import tempfile
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.store.records import CaptureRecord, FruitRow, Round
    >>> from cucumbervision_greenhouse.store.records import StopRecord, new_key
    >>> walk, stop = Round(name="morning"), new_key()
    >>> capture = CaptureRecord("a", fruit=(FruitRow(1, length=Length(0.31)),))
    >>> record = StopRecord("3", None, 1.2, key=stop, round_key=walk.key, captures=(capture,))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with open_store(Path(folder) / "house.db") as store:
    ...         print(store.save_round(walk), store.save_stop(record), store.save_stop(record))
    ...         [fruit] = store.detections(walk.key)
    ...         print(fruit.row, fruit.along_m, fruit.length_m)
    True True False
    3 1.2 0.31
    """
    url = database_url(where)
    folder = url.query.get("images", "")
    url = url.difference_update_query(["images"])
    if isinstance(folder, tuple):
        raise StoreError(
            f"names {len(folder)} folders of pictures", source=named(url), remedy="name one"
        )
    if not create and url.get_backend_name() == "sqlite" and not Path(url.database or "").exists():
        raise StoreError("is not there", source=named(url), remedy="check the path")
    engine = make_engine(url)
    try:
        prepare(engine)
    except BaseException:
        engine.dispose()
        raise
    if images is None and folder:
        images = Path(folder)
    elif images is None and url.get_backend_name() == "sqlite":
        images = Path(url.database or "").with_suffix(".images")
    if images is not None:
        ImageStore(images).clean()
    return Store(engine, images)


class Store(Marks):
    """An open store; `open_store` makes it. Any number of threads may use one.

    Each method is one transaction: what it writes is there whole or not at all, and on the disk
    when it returns; what it reads is as it was when it began. All raise `StoreError` where the
    database reports an error, or a key is not there.
    """

    def save_round(self, record: Round) -> bool:
        """Add a round and return True; the same one sent again changes nothing.

        Its house is the known one where their names differ by no more than case, spaces or the
        word 'house' (`names.same_house`).

        Raises
        ------
        NameRefusedError
            If one of its names is none.
        """
        house = checked_name(record.house, "house")
        cells = {name: getattr(record, name) for name in _ROUND_CELLS}
        cells["name"] = checked_name(record.name, "round's name")
        with self.writing() as connection:
            houses = select(ROUNDS.c.house).where(~ROUNDS.c.deleted).order_by(ROUNDS.c.id)
            cells["house"] = same_house(house, connection.execute(houses).scalars())
            line_id = _insert_new(connection, ROUNDS, cells)
        return line_id is not None

    def save_stop(self, stop: StopRecord) -> bool:
        """Add a stop with all that is in it and return True; the same key again changes nothing.

        Put its images into `images` first: an image without a stop can be found and removed
        (`check_store`), a stop without its image cannot be repaired.

        Raises
        ------
        NameRefusedError
            If its row, its side or a capture's name is none.
        StoreError
            If its round is not there, or it holds what no database takes.
        """
        check_place(stop)
        for capture in stop.captures:
            checked_name(capture.name, "capture's name", longest=None)
        with self.writing() as connection:
            round_id = round_id_of(connection, stop.round_key, remedy="save the round first")
            cells = {name: getattr(stop, name) for name in _STOP_CELLS}
            stop_id = _insert_new(connection, STOPS, {**cells, "round_id": round_id})
            if stop_id is None:
                return False
            for number, capture in enumerate(stop.captures):
                cells = {name: getattr(capture, name) for name in _CAPTURE_CELLS}
                cells |= {"stop_id": stop_id, "number": number}
                cells["record"] = {n: getattr(capture, n) for n in _CAPTURE_RECORD}
                line = insert(CAPTURES).values(**cells).returning(CAPTURES.c.id)
                capture_id = connection.execute(line).scalar_one()
                # The same keys on every machine: of the stop's, the capture's place, the number.
                keys = [key_of("fruit", stop.key, number, row.fruit) for row in capture.fruit]
                _add_fruit(connection, capture_id, round_id, keys, capture.fruit)
        return True

    def add_fruit(self, stop_key: str, capture: str, row: FruitRow) -> str:
        """Add a fruit that was not found, as a mark. Return its key.

        It is accepted, unless it is flagged as doubtful. Where that is taken back it is left out of
        all lists, and its number is not used again.

        Parameters
        ----------
        stop_key, capture : str
            Where it was seen: the stop, and the capture's name in it.
        row : FruitRow
            As it was measured; it gets the capture's next number.

        Raises
        ------
        StoreError
            If the stop is not there, or has no such capture.
        """
        query = (
            select(CAPTURES.c.id, CAPTURES.c.number, STOPS.c.round_id)
            .join(STOPS, STOPS.c.id == CAPTURES.c.stop_id)
            .where(STOPS.c.key == stop_key, CAPTURES.c.name == capture, ~STOPS.c.deleted)
        )
        with self.writing() as connection:
            line = connection.execute(query).one_or_none()
            if line is None:
                raise StoreError(
                    f"stop {stop_key} has no capture '{capture}'", remedy="look it up in stop()"
                )
            highest = select(func.max(FRUIT.c.fruit)).where(FRUIT.c.capture_id == line.id)
            number = (connection.execute(highest).scalar() or 0) + 1
            key = key_of("fruit", stop_key, line.number, number)
            _add_fruit(connection, line.id, line.round_id, [key], [row.with_(fruit=number)])
            details: dict[str, Any] = {"table": "fruit", "key": key}
            details |= {"before": {"deleted": True}, "after": {"deleted": False}}
            if "doubtful" not in row.flags.split():
                details["verdict"] = "accept"
            write_mark(connection, "add", line.round_id, [key], details)
        return key

    def save_merging(
        self,
        round_key: str,
        links: Sequence[LinkRecord],
        positions: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        """Replace a round's links of `LinkKind.SAME`, and its stops' fitted positions with SD."""
        with self.writing() as connection:
            round_id = round_id_of(connection, round_key)
            forget_links(connection, LinkKind.SAME, (round_id, round_id))
            stops = update(STOPS).where(STOPS.c.round_id == round_id)
            connection.execute(stops.values(fitted_m=None, fitted_sd_m=None))
            for key, (at_m, sd_m) in (positions or {}).items():
                fitted = stops.where(STOPS.c.key == key).values(fitted_m=at_m, fitted_sd_m=sd_m)
                connection.execute(fitted)
            _add_links(connection, LinkKind.SAME, links, (round_id, round_id))

    def save_growth(self, earlier: str, later: str, links: Sequence[LinkRecord]) -> None:
        """Replace the links of `LinkKind.GROWTH` between two rounds."""
        with self.writing() as connection:
            rounds = round_id_of(connection, earlier), round_id_of(connection, later)
            forget_links(connection, LinkKind.GROWTH, rounds)
            _add_links(connection, LinkKind.GROWTH, links, rounds)

    def rounds(self, *, deleted: bool = False) -> list[Round]:
        """Return the rounds, the newest first.

        `deleted` gives those that were deleted instead.
        """
        return self._rounds(ROUNDS.c.deleted == deleted)

    def round(self, key: str) -> Round | None:
        """Return a round; None where it is not there or was deleted.

        Much faster than `rounds`, which counts the fruit of all.
        """
        return next(iter(self._rounds(~ROUNDS.c.deleted, ROUNDS.c.key == key)), None)

    def _rounds(self, *only: ColumnElement[bool]) -> list[Round]:
        of_round = and_(STOPS.c.round_id == ROUNDS.c.id, ~STOPS.c.deleted)
        fruit = and_(FRUIT.c.round_id == ROUNDS.c.id, IS_ACTIVE)
        query = select(
            *(ROUNDS.c[name] for name in _ROUND_CELLS),
            select(func.count(STOPS.c.id)).where(of_round).scalar_subquery(),
            select(func.count(FRUIT.c.id)).where(fruit).scalar_subquery(),
            select(func.max(STOPS.c.taken_s)).where(of_round).scalar_subquery(),
        )
        newest_first = ROUNDS.c.started_s.desc(), ROUNDS.c.id.desc()
        with self.reading() as connection:
            lines: Any = connection.execute(query.where(*only).order_by(*newest_first))
            return [Round(*line) for line in lines]

    def stop_is_deleted(self, key: str) -> bool | None:
        """Return whether a stop was deleted; None where it never was in the store."""
        query = select(STOPS.c.deleted).where(STOPS.c.key == key)
        with self.reading() as connection:
            return connection.execute(query).scalar()

    def stops(self, round_key: str) -> list[StopRecord]:
        """Return a round's stops in the order in which they were made, without their fruit."""
        with self.reading() as connection, self._decoding():
            in_round = STOPS.c.round_id == round_id_of(connection, round_key)
            return _stops_of(connection, and_(in_round, ~STOPS.c.deleted))

    def stop(self, key: str) -> StopRecord:
        """Return a stop at its corrected place.

        Raises
        ------
        StoreError
            If it is not there.
        """
        with self.reading() as connection, self._decoding():
            for stop in _stops_of(connection, STOPS.c.key == key):
                return stop
        raise StoreError("stop {key} is not in the store", remedy="look it up in stops()", key=key)

    def detections(
        self, round_key: str, stop: str | None = None, *, shapes: bool = False
    ) -> list[FruitRow]:
        """Return a round's fruit in the order of its stops.

        Parameters
        ----------
        round_key : str
            The round.
        stop : str, optional
            Key of one stop, whose fruit are returned without their groups.
        shapes : bool
            Add mask, keypoints and path.
        """
        with self.reading() as connection, self._decoding():
            return _views_of(connection, round_id_of(connection, round_key), stop, shapes=shapes)

    def detection(self, key: str) -> DetectionDetail:
        """Return one fruit of one capture with everything.

        Raises
        ------
        StoreError
            If it is not there.
        """
        with self.reading() as connection, self._decoding():
            [line] = find_fruit(connection, [key])
            [view] = (x for x in _views_of(connection, line.round_id) if x.key == key)
            shaped = _views_of(connection, line.round_id, view.stop_key, shapes=True)
            [shape] = (x.shape for x in shaped if x.key == key)
            [stop] = _stops_of(connection, STOPS.c.key == view.stop_key)
            marks = _log_of(connection, view.round_key, None)
        [capture] = (capture for capture in stop.captures if capture.name == view.capture)
        log = tuple(mark for mark in marks if key in mark.fruit)
        return DetectionDetail(view.with_(**shape), capture, stop, log)

    def picked(self, round_key: str) -> dict[str, float]:
        """Return the times of picking by the fruit's keys."""
        with self.reading() as connection:
            marks = marks_of(connection, round_id_of(connection, round_key))
        times = {key: decided.get("picked_s") for key, decided in marks.items()}
        return {key: at_s for key, at_s in times.items() if at_s is not None}

    def links(self, round_key: str, kind: LinkKind | None = None) -> list[LinkRecord]:
        """Return the links that touch a round; of growth both from earlier and to later rounds."""
        with self.reading() as connection:
            return links_of(connection, round_id_of(connection, round_key), kind)

    def newest_action(self, round_key: str, without: Sequence[str] = ()) -> int:
        """Return the number of a round's newest mark but of some kinds; 0 where it has none."""
        with self.reading() as connection:
            newest = select(func.max(MARKS.c.id)).where(
                MARKS.c.round_id == round_id_of(connection, round_key), MARKS.c.kind.not_in(without)
            )
            return int(connection.execute(newest).scalar() or 0)

    def log(
        self, round_key: str | None = None, *, kind: str | None = None, limit: int | None = 200
    ) -> list[LogEntry]:
        """Return what people decided, of all kinds or one, the newest first."""
        with self.reading() as connection, self._decoding():
            return _log_of(connection, round_key, limit, kind)

    def own_actions(self, round_key: str) -> list[LogEntry]:
        """Return the marks in a round that the store's signer can undo, the newest first.

        That is what was done by that person from that device. Without any: what was done by nobody
        in particular, as by a command.
        """
        with self.reading() as connection, self._decoding():
            log = _log_of(connection, round_key, _UNDONE_AMONG)
        lines = [line for line in log if not line.undone and line.kind not in NOT_UNDONE]
        by = [(line.details.get("device", ""), line.by) for line in lines]
        own = (self._device, self._signed_by)
        of_person = [line for line, who in zip(lines, by, strict=True) if who == own]
        return of_person or [line for line, who in zip(lines, by, strict=True) if who == ("", "")]

    def restore_round(self, key: str) -> int:
        """Put a deleted round back into the list of rounds.

        Raises
        ------
        StoreError
            If it was not deleted.
        """
        for mark in self.log(key, limit=None):
            if mark.kind == "delete-round" and not mark.undone:
                return self.undo(number=mark.number)
        raise StoreError("round {key} is not deleted", remedy="see the list of rounds", key=key)

    def _decoding(self) -> Any:
        """Report what no record can be made of as damaged data."""
        remedy = "copy the database away, and check it with `round check`"
        return wrap_reader_errors(self.name, StoreError, remedy)


def _insert_new(connection: Connection, table: Table, cells: dict[str, Any]) -> int | None:
    """Insert one line and return its id; None where one with its key is there already."""
    if connection.execute(select(table.c.id).where(table.c.key == cells["key"])).scalar():
        return None
    line = insert(table).values(**cells).returning(table.c.id)
    return int(connection.execute(line).scalar_one())


def _add_fruit(
    connection: Connection,
    capture_id: int,
    round_id: int,
    keys: Sequence[str],
    rows: Sequence[FruitRow],
) -> None:
    """Add fruit of a capture under these keys."""
    if not rows:
        return
    lines = [
        {**row.cells, "key": key, "capture_id": capture_id, "round_id": round_id}
        for key, row in zip(keys, rows, strict=True)
    ]
    add = insert(FRUIT).returning(FRUIT.c.id, sort_by_parameter_order=True)
    ids = connection.execute(add, lines).scalars().all()
    shapes = [
        {"fruit_id": fruit_id, "mask": shape.pop("mask"), "record": shape}
        for fruit_id, shape in zip(ids, (row.shape for row in rows), strict=True)
    ]
    connection.execute(insert(SHAPES), shapes)


def _add_links(
    connection: Connection, kind: LinkKind, links: Sequence[LinkRecord], rounds: tuple[int, int]
) -> None:
    fruit = select(FRUIT.c.key, FRUIT.c.id).where(FRUIT.c.round_id.in_(rounds), IS_ACTIVE)
    ids = {line.key: line.id for line in connection.execute(fruit)}
    lines = [
        {"kind": str(kind), "first_id": ids[link.first], "second_id": ids[link.second]}
        | {"first_round_id": rounds[0], "second_round_id": rounds[1], "score": link.score}
        for link in links
        if link.first in ids and link.second in ids  # none was deleted meanwhile
    ]
    if lines:
        connection.execute(insert(LINKS), lines)


def _stops_of(connection: Connection, which: Any) -> list[StopRecord]:
    """Return stops with their captures, and the number of their fruit."""
    count = select(func.count(FRUIT.c.id)).join(CAPTURES, CAPTURES.c.id == FRUIT.c.capture_id)
    count = count.where(CAPTURES.c.stop_id == STOPS.c.id, IS_ACTIVE)
    query = (
        select(
            *(STOPS.c.id, ROUNDS.c.key.label("round_key"), count.scalar_subquery().label("fruit")),
            *(STOPS.c[name] for name in _STOP_CELLS),
        )
        .join(ROUNDS, ROUNDS.c.id == STOPS.c.round_id)
        .where(which)
        .order_by(STOPS.c.taken_s, STOPS.c.id)
    )
    captures, stops = _captures_of(connection, which), []
    for line in connection.execute(query).mappings():
        values = {**line, "captures": tuple(captures[line["id"]])}
        del values["id"]
        values |= {name: tuple(values[name]) for name in ("pose", "failures")}
        values["artifacts"] = tuple(ArtifactRecord(**made) for made in values["artifacts"])
        stops.append(StopRecord(**values))
    return stops


def _captures_of(connection: Connection, which: Any) -> dict[int, list[CaptureRecord]]:
    """Return the captures of stops by the stops' numbers."""
    columns = [CAPTURES.c[name] for name in (*_CAPTURE_CELLS, "record")]
    query = select(CAPTURES.c.stop_id, *columns).join(STOPS, STOPS.c.id == CAPTURES.c.stop_id)
    query = query.where(which).order_by(CAPTURES.c.stop_id, CAPTURES.c.number)
    captures: dict[int, list[CaptureRecord]] = defaultdict(list)
    for stop_id, *cells, record in connection.execute(query):
        values = dict(zip(_CAPTURE_CELLS, cells, strict=True)) | record
        values |= {name: values[name] and tuple(values[name]) for name in ("gravity", "doubts")}
        captures[stop_id].append(CaptureRecord(**values))
    return captures


def _shape_of(mask: str | None, record: Mapping[str, Any]) -> dict[str, Any]:
    points = {name: tuple(map(tuple, record[name])) for name in ("keypoints", "path_m")}
    return {"mask": mask, **points, "diameter_m": tuple(record["diameter_m"])}


def _views_of(
    connection: Connection, round_id: int, stop: str | None = None, *, shapes: bool = False
) -> list[FruitRow]:
    """Return fruit in the order of their stops, with marks: a round's grouped, or one stop's."""
    place = ("position_m", "position_sd_m", "fitted_m", "fitted_sd_m", "mirrored")
    query = (
        select(
            FRUIT.c.key,
            *_ROW_CELLS,
            *(STOPS.c.key.label("stop_key"), ROUNDS.c.key.label("round_key")),
            CAPTURES.c.name.label("capture"),
            *(CAPTURES.c[name] for name in ("simulated", "thumbnail")),
            *(STOPS.c[name] for name in ("row", "side", "step", "taken_s", *place)),
            *((SHAPES.c.mask, SHAPES.c.record) if shapes else ()),
        )
        .join(CAPTURES, CAPTURES.c.id == FRUIT.c.capture_id)
        .join(STOPS, STOPS.c.id == CAPTURES.c.stop_id)
        .join(ROUNDS, ROUNDS.c.id == FRUIT.c.round_id)
        .where(FRUIT.c.round_id == round_id, ~FRUIT.c.deleted, ~STOPS.c.deleted)
        .order_by(STOPS.c.taken_s, STOPS.c.id, CAPTURES.c.number, FRUIT.c.fruit)
    )
    if shapes:
        query = query.join(SHAPES, SHAPES.c.fruit_id == FRUIT.c.id)
    if stop is not None:
        query = query.where(STOPS.c.key == stop)
    marks, views = marks_of(connection, round_id), []
    for line in connection.execute(query).mappings():
        values, decided = dict(line), marks.get(line["key"], {})
        at_m, sd_m, fitted_m, fitted_sd_m, mirrored = (values.pop(name) for name in place)
        if shapes:
            values |= _shape_of(values.pop("mask"), values.pop("record"))
        if "row" in decided:
            corrected = dict(decided["row"])
            shape = _shape_of(corrected.pop("mask"), corrected)
            values |= {name: corrected.get(name) for name in line if name in corrected}
            values |= shape if shapes else {}
        if fitted_m is not None:
            at_m, sd_m = fitted_m, fitted_sd_m
        if at_m is not None:
            values["along_m"] = at_m + (values["offset_m"] or 0.0) * (-1.0 if mirrored else 1.0)
            if sd_m is not None:
                values["along_sd_m"] = hypot(sd_m, values["offset_sd_m"] or 0.0)
        values |= {"verdict": decided.get("verdict"), "picked_s": decided.get("picked_s")}
        values |= {"corrected": "row" in decided, "group": line["key"]}
        views.append(FruitRow(**values))
    return views if stop is not None else _grouped(views, links_of(connection, round_id))


def group_detections(keys: Iterable[str], links: Iterable[LinkRecord]) -> list[set[str]]:
    """Group the detections that links identify as the same fruit.

    What was linked by hand joins first, then the surest. A link that would bring two detections
    together that were parted by hand joins nothing.

    Parameters
    ----------
    keys : iterable of str
        The detections.
    links : iterable of LinkRecord
        Links of any kind; links of growth are ignored.

    Returns
    -------
    list of set
        The detections of each fruit.

    Examples
    --------
    >>> same, apart = LinkKind.SAME, LinkKind.APART
    >>> links = [LinkRecord(same, "a", "b", 0.9), LinkRecord(same, "b", "c", 0.5)]
    >>> [sorted(group) for group in group_detections("abcd", links)]
    [['a', 'b', 'c'], ['d']]
    >>> parted = [*links, LinkRecord(apart, "a", "c", by_hand=True)]
    >>> [sorted(group) for group in group_detections("abcd", parted)]
    [['a', 'b'], ['c'], ['d']]
    """
    groups = {key: {key} for key in keys}
    foes: dict[str, set[str]] = {}
    same = []
    for link in links:
        if link.first not in groups or link.second not in groups:
            continue
        if link.kind is LinkKind.SAME:
            same.append(link)
        elif link.kind is LinkKind.APART:
            foes.setdefault(link.first, set()).add(link.second)
            foes.setdefault(link.second, set()).add(link.first)
    for link in sorted(same, key=lambda link: (not link.by_hand, -(link.score or 0.0))):
        a, b = groups[link.first], groups[link.second]
        if a is b or any(not b.isdisjoint(foes[key]) for key in a if key in foes):
            continue
        small, large = sorted((a, b), key=len)
        large |= small
        for key in small:
            groups[key] = large
    return list({id(group): group for group in groups.values()}.values())


def _grouped(views: list[FruitRow], links: list[LinkRecord]) -> list[FruitRow]:
    """Return views with the group of each; a fruit is picked when the first of its views was.

    A view that was not rejected represents its fruit before one with a length, before one of the
    whole fruit, before one with a higher view score, before the first.
    """
    of_key, place = {view.key: view for view in views}, {v.key: -n for n, v in enumerate(views)}

    def goodness(view: FruitRow) -> tuple[object, ...]:
        shown = view.verdict is not Verdict.REJECTED, view.length_m is not None, not view.partial
        return (*shown, view.view_score, place[view.key])

    for group in group_detections(of_key, links):
        members = [of_key[key] for key in group]
        best = max(members, key=goodness).key
        picked_s = min((v.picked_s for v in members if v.picked_s is not None), default=None)
        for view in members:
            view.group, view.views, view.picked_s = best, len(members), picked_s
    return views


def _log_of(
    connection: Connection, round_key: str | None, limit: int | None, kind: str | None = None
) -> list[LogEntry]:
    undo = MARKS.alias()
    query: Any = (
        select(
            *(MARKS.c[name] for name in ("id", "at_s", "by", "kind")),
            ROUNDS.c.key,
            MARKS.c.fruit,
            MARKS.c.details,
            undo.c.id,
        )
        .outerjoin(ROUNDS, ROUNDS.c.id == MARKS.c.round_id)
        .outerjoin(undo, undo.c.undoes_id == MARKS.c.id)
        .order_by(MARKS.c.id.desc())
        .limit(limit)
    )
    if round_key is not None:
        query = query.where(ROUNDS.c.key == round_key)
    if kind is not None:
        query = query.where(MARKS.c.kind == kind)
    return [
        LogEntry(number, at_s, by, kind, key, tuple(fruit), details, undone=undone is not None)
        for number, at_s, by, kind, key, fruit, details, undone in connection.execute(query)
    ]
