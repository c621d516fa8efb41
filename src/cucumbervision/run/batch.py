"""List the captures of inputs, and measure each: in this process, in several, or on a cluster.

A caller combines a source of captures, a `Worker` that converts each result, and a loop over the
outcomes of `measure_all`; `measure` does all of it in one call. Failures are values: only a failure
to load the networks or the calibration ends the loop.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from multiprocessing.connection import wait
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import CaptureRef, unique_name
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    InstancesError,
    MissingExtraError,
)
from cucumbervision.files import as_path
from cucumbervision.fruit.instance import Instance
from cucumbervision.networks.runtime import CARD_RUNTIMES, limit_threads
from cucumbervision.plugins import plugins
from cucumbervision.run.fields import FIELDS
from cucumbervision.run.measurer import Boundary, CaptureResult, Failure, Measurer, plugin_failures
from cucumbervision.run.options import INSTANCE_SOURCES, MeasureOptions, PlugIns

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import ArrayLike

    from cucumbervision.arrays import Numbers, Pixels
    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision.capture.source import CaptureSource, ReadOptions
    from cucumbervision.fruit.label_files import InstanceFile
    from cucumbervision.methods.result import Fruit
    from cucumbervision.methods.table import Method, Trait
    from cucumbervision.plugins import Detector, Reader, Segmenter
    from cucumbervision.run.fields import Cell

_log = logging.getLogger(__name__)
_LONGEST_LIST = 300

T = TypeVar("T")
ItemT = TypeVar("ItemT", bound="Listed | Failure")
Opener: TypeAlias = Callable[[Path, "ReadOptions"], "CaptureSource"]


@dataclass(frozen=True)
class Listed:
    """A capture of an input, not read yet.

    Parameters
    ----------
    input : str
        The input as the user gave it.
    ref : CaptureRef
        The capture.
    name : str
        Name in tables and images, unique within a run.
    """

    input: str
    ref: CaptureRef
    name: str

    @classmethod
    def of(cls, capture: Capture) -> Listed:
        """Return a capture that is in memory."""
        ref = CaptureRef(capture.name, capture.frame or 0, partial(_itself, capture))
        return cls(capture.source or capture.name, ref, capture.name)


def _itself(capture: Capture) -> Capture:
    return capture


Item: TypeAlias = Listed | Failure
"""A capture that is to be measured, or why there is none."""


def load(item: Item) -> Capture | Failure:
    """Read a capture; a failure is returned."""
    if isinstance(item, Failure):
        return item
    failures: list[Failure] = []
    with Boundary(failures, item.input, item.name):
        return item.ref.load()
    return failures[0]


def portable(item: Item) -> Item:
    """Return an item that another process can read.

    A capture without files, such as a frame of a recording, is read here.
    """
    if isinstance(item, Failure) or item.ref.parts is not None:
        return item
    read = load(item)
    if isinstance(read, Failure):
        return read
    return replace(item, ref=replace(item.ref, load=partial(_itself, read)))


def _place(location: Path | str) -> str:
    """Return the place that a path leads to; several paths may lead to one place."""
    return str(location) if "://" in str(location) else os.path.realpath(location)


def list_captures(
    inputs: Iterable[Path],
    reading: ReadOptions,
    opener: Opener = open_source,
    say: Callable[[str], None] = _log.warning,
) -> Iterator[Item]:
    """List the captures of all inputs; each input is opened once, when it is reached.

    Parameters
    ----------
    inputs : iterable of Path
        Folders and files that `open_source` can read.
    reading : ReadOptions
        Reading options.
    opener : callable
        Opens each input.
    say : callable
        Called with a line for an input that was given before.

    Yields
    ------
    Listed or Failure
        A capture, or the failure of one or of a whole input.
    """
    places = set[str]()
    for path in inputs:
        if (place := _place(path)) in places:
            say(f"{path} is given twice: it is measured once")
            continue
        places.add(place)
        yield from list_source(str(path), partial(opener, path, reading))


def list_source(name: str, opener: Callable[[], CaptureSource]) -> Iterator[Item]:
    """List the captures of one source, as `list_captures`; `name` is used in failures."""
    failures: list[Failure] = []
    with Boundary(failures, name):
        source = opener()
        if unused := source.unused:
            names = shorten(", ".join(unused), _LONGEST_LIST, placeholder=" …")
            _log.warning("%s: %d pictures belong to no capture: %s", name, len(unused), names)
        for ref in source:
            yield Listed(name, ref, ref.name)
    yield from failures


def read_captures(
    inputs: Iterable[Path], reading: ReadOptions, opener: Opener = open_source
) -> Iterator[Capture | Failure]:
    """Read the captures of all inputs one after the other; parameters as for `list_captures`."""
    return map(load, list_captures(inputs, reading, opener))


def each_once(listed: Iterable[Item], say: Callable[[str], None]) -> Iterator[Item]:
    """Yield every capture once, with a unique name.

    A capture that cannot be read also reserves its name, so that the names of the others do not
    change when it is repaired.

    Parameters
    ----------
    listed : iterable of Listed or Failure
        Result of `list_captures`.
    say : callable
        Called at the end with a line for each input that repeats earlier captures.
    """
    names, places, repeats = set[str](), set[str](), Counter[str]()
    for entry in listed:
        if isinstance(entry, Failure):
            yield entry
            continue
        place = _place(entry.ref.location)
        if entry.ref.location and place in places:
            repeats[entry.input] += 1
            continue
        places.add(place)
        yield Listed(entry.input, entry.ref, unique_name(entry.name, names))
    for path, count in repeats.items():
        what = "1 capture was" if count == 1 else f"{count} captures were"
        say(f"{path}: {what} given before, and measured once")


def count_captures(
    inputs: Sequence[Path], reading: ReadOptions, opener: Opener = open_source
) -> int | None:
    """Return the number of captures in the inputs; None if it is known only after reading."""
    total = 0
    for path in {_place(path): path for path in inputs}.values():
        source = None
        with Boundary([], str(path)):
            source = opener(path, reading)
        if source is not None and source.total is None:
            return None
        # An input that cannot be opened counts as one step.
        total += 1 if source is None else source.total or 0
    return total


def label_file(instances: str) -> InstanceFile | None:
    """Return the file that `MeasureOptions.instances` names; None for other sources of fruit.

    Raises
    ------
    InstancesError
        If it cannot be read.
    """
    if (
        instances in INSTANCE_SOURCES
        or instances in plugins("detectors")
        or Path(instances).suffix.lower() == ".onnx"
    ):
        return None
    from cucumbervision.fruit.label_files import read_instances

    return read_instances(instances)


def labelled_once(
    file: InstanceFile | None, items: Iterable[Listed | Failure]
) -> Iterator[Listed | Failure]:
    """Yield items; a capture whose entry in the file an earlier one has becomes a failure."""
    used = dict[int, str]()
    for item in items:
        if file is None or isinstance(item, Failure):
            yield item
            continue
        entry = None
        with suppress(InstancesError):  # measuring the capture raises the error
            place = item.ref.location.removesuffix("/capture.json")
            entry = file.find((item.name, place), item.ref.frame)
        if entry is None or used.setdefault(id(entry), item.name) == item.name:
            yield item
            continue
        error = InstancesError(
            f"names {entry.name or entry.number} once, which both {used[id(entry)]} and "
            f"{item.name} are: only the first was measured, maybe with the other's fruit",
            source=file.source,
            remedy="name the pictures with their folders, and measure again",
        )
        yield Failure.of(error, item.input, item.name)


def instance_notes(
    file: InstanceFile, captures: Sequence[tuple[Sequence[str], int | None]]
) -> list[str]:
    """Return notes on captures and on images of a file without a counterpart.

    Parameters
    ----------
    file : InstanceFile
        The file.
    captures : sequence of (sequence of str, int or None)
        Names and frame number of each capture, as for `InstanceFile.for_capture`.

    Raises
    ------
    InstancesError
        If the file names none of the captures.
    """
    missing, unused = file.coverage(captures)
    if missing and len(missing) == len(captures):
        raise InstancesError(
            f"names none of the captures ({_shortened(missing)}); it names {_shortened(unused)}",
            source=file.source,
            remedy="name its pictures as the captures are called",
        )
    notes = [f"{file.source}: no fruit given for {', '.join(missing)}"] if missing else []
    if unused and captures:
        notes.append(f"{file.source}: no capture is called {', '.join(unused)}")
    if file.crowds:
        notes.append(
            f"{file.source}: {file.crowds} crowd regions, of several fruit each, are left out"
        )
    return notes


def _shortened(names: Sequence[str], most_names: int = 5) -> str:
    remainder = f" and {len(names) - most_names} more" if len(names) > most_names else ""
    return f"{', '.join(names[:most_names])}{remainder}"


@dataclass(frozen=True, eq=False)
class Outcome(Generic[T]):
    """The outcome of one capture, or of an input that could not be listed.

    Parameters
    ----------
    value : object, optional
        The worker's result. None without a failure: the capture needed no work, or the loop was
        cancelled before its turn.
    failures : tuple of Failure
        The failures.
    """

    value: T | None = None
    failures: tuple[Failure, ...] = ()


class Worker(ABC, Generic[T]):
    """Does the work of one capture, in this process or as a copy in another.

    Parameters
    ----------
    measurer : Measurer
        The measurer; its networks are loaded with the first capture.
    """

    def __init__(self, measurer: Measurer) -> None:
        self.measurer = measurer

    def __call__(self, item: Item) -> Outcome[T]:
        """Read and measure one item; errors are returned in the outcome.

        Raises
        ------
        CucumberVisionError
            If the networks or the calibration cannot be loaded, as `Measurer.load`.
        """
        read = self.read(item)
        return read if isinstance(read, Outcome) else self.measure(read)

    def read(self, item: Item) -> Outcome[T] | Capture:
        """Read a capture; an outcome means that there is nothing to measure."""
        if isinstance(item, Failure):
            return Outcome(failures=(item,))
        read = load(item)
        if isinstance(read, Failure):
            return Outcome(failures=(read,))
        return replace(read, name=item.name)

    @abstractmethod
    def measure(self, capture: Capture) -> Outcome[T]:
        """Measure a capture, and convert the result."""


class ResultWorker(Worker[CaptureResult]):
    """Returns results unchanged; a capture that could not be measured has an `error`."""

    def measure(self, capture: Capture) -> Outcome[CaptureResult]:
        """Measure a capture."""
        self.measurer.load()
        result = self.measurer.attempt(capture)
        return Outcome(result, result.failures)


Engine: TypeAlias = Callable[[Iterable[Item], Worker[Any]], Iterator[Outcome[Any]]]
"""Processes all items, and yields the outcome of each, in order, when it is available."""


def in_turn(items: Iterable[Item], worker: Worker[Any]) -> Iterator[Outcome[Any]]:
    """Process one item after the other, and request the next only when the previous one is done."""
    return map(worker, items)


def in_process(items: Iterable[Item], worker: Worker[Any]) -> Iterator[Outcome[Any]]:
    """Process two items at once in this process: the networks find one's fruit meanwhile."""
    with ThreadPoolExecutor(2) as threads:
        yield from _in_order(items, lambda item: threads.submit(worker, item).result, 2)


def _in_order(
    items: Iterable[Item], submit: Callable[[Item], Callable[[], Outcome[Any]]], most_running: int
) -> Iterator[Outcome[Any]]:
    """Yield outcomes in the order of the items, of which some are submitted ahead."""
    remaining, running = iter(items), deque[Callable[[], Outcome[Any]]]()
    while True:
        running.extend(map(submit, islice(remaining, most_running - len(running))))
        if not running:
            return
        yield running.popleft()()


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Processes:
    """Processes items in several processes of this machine; each loads the networks once.

    Parameters
    ----------
    workers : int
        Number of processes; they share the cores of the machine.
    """

    workers: int

    def __call__(self, items: Iterable[Item], worker: Worker[Any]) -> Iterator[Outcome[Any]]:
        """Process the items; at most two per worker are running or queued.

        If a process is killed, its captures are measured again, each in a separate process. A
        capture whose process is killed twice becomes a failure.
        """

        def new_pool(workers: int = self.workers) -> ProcessPoolExecutor:
            # Forking a process that runs threads of OpenCV or a runtime may hang.
            context = multiprocessing.get_context("spawn")
            threads = max(1, cores() // self.workers)
            return ProcessPoolExecutor(workers, context, _begin, (worker, threads))

        pool = new_pool()

        def submit(item: Item) -> Callable[[], Outcome[Any]]:
            nonlocal pool
            ready = portable(item)
            try:
                future = pool.submit(_do, ready)
            except BrokenProcessPool:
                pool = new_pool()
                future = pool.submit(_do, ready)
            return partial(result, ready, future)

        def result(item: Item, future: Future[Outcome[Any]]) -> Outcome[Any]:
            with suppress(BrokenProcessPool):
                return future.result()
            with suppress(BrokenProcessPool), new_pool(1) as alone:
                return alone.submit(_do, item).result()
            return _outcome_of_killed(item)

        try:
            yield from _in_order(items, submit, 2 * self.workers)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _outcome_of_killed(item: Item) -> Outcome[Any]:
    """Return the outcome of a capture whose process was killed twice."""
    if isinstance(item, Failure):
        return Outcome(failures=(item,))
    error = CaptureError(
        "the process that measured it was killed twice",
        source=item.name,
        remedy="look whether there is enough memory, and room on the disk for temporary files, or "
        "measure it alone",
    )
    return Outcome(failures=(Failure.of(error, item.input, item.name),))


_worker: list[Worker[Any]] = []  # the worker of this process


def _begin(worker: Worker[Any], threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command stops its workers
    threading.Thread(target=end_with_parent, daemon=True).start()
    limit_threads(threads)
    _worker.append(worker)


def _do(item: Item) -> Outcome[Any]:
    return _worker[0](item)


def end_with_parent() -> None:
    """End this process if the command was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


@dataclass(frozen=True)
class RayEngine:
    """Processes items on a Ray cluster, whose processes load the networks once.

    Needs the extra 'cluster'.

    Parameters
    ----------
    address : str
        Address of the cluster, as in `ray.init`; 'local' starts one on this machine for the run.
    workers : int
        Number of items at once; 0 means one per CPU.
    """

    address: str = "local"
    workers: int = 0

    def __call__(self, items: Iterable[Item], worker: Worker[Any]) -> Iterator[Outcome[Any]]:
        """Process the items; at most two per worker are running or queued.

        A capture whose process is killed is measured again. One whose process is killed twice
        becomes a failure.

        Raises
        ------
        MissingExtraError
            If Ray is not installed.
        CucumberVisionError
            If the cluster cannot be reached, or networks or calibration cannot be loaded.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ModuleNotFoundError:
            raise MissingExtraError("ray", "cluster") from None
        try:
            # A local cluster needs no dashboard.
            local = {"include_dashboard": False} if self.address == "local" else {}
            ray.init(self.address, log_to_driver=False, logging_level="error", **local)
        except Exception as error:  # Ray's exceptions have no common base class
            raise CucumberVisionError(
                f"no Ray cluster can be reached ({error})",
                source=self.address,
                remedy="check --ray, or give local for this machine alone",
            ) from None
        try:
            resources = ray.cluster_resources()
            cpus, gpus = (float(resources.get(kind, 0)) for kind in ("CPU", "GPU"))
            workers = self.workers or max(1, int(cpus))
            share = cpus // workers or cpus / workers  # above 1, Ray takes whole numbers alone
            on_gpus = worker.measurer.options.runtime in CARD_RUNTIMES
            do = ray.remote(
                num_cpus=share,
                num_gpus=on_gpus * (gpus // workers or gpus / workers),
                max_retries=1,
            )(_do_on_cluster)
            shared = [ray.put(worker)]

            def submit(item: Item) -> Callable[[], Outcome[Any]]:
                ready = portable(item)
                return partial(result, ready, do.remote(shared, max(1, int(share)), ready))

            def result(item: Item, future: Any) -> Outcome[Any]:
                try:
                    outcome: Outcome[Any] = ray.get(future)
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None
                except ray.exceptions.RayError:
                    return _outcome_of_killed(item)
                return outcome

            yield from _in_order(items, submit, 2 * workers)
        finally:
            ray.shutdown()


def _do_on_cluster(shared: list[Any], threads: int, item: Item) -> Outcome[Any]:
    if not _worker:  # the first capture of this process
        import ray

        limit_threads(threads)
        _worker.append(ray.get(shared[0]))
    return _do(item)


def never() -> bool:
    """Return False: never stop the loop."""
    return False


@dataclass(frozen=True)
class LoopOptions:
    """Options of the loop, which do not change results.

    Parameters
    ----------
    opener : callable
        Opens each input.
    engine : Engine
        Where captures are processed.
    is_cancelled : callable
        Called before each capture; if it returns True, no further capture is started.
    """

    opener: Opener = open_source
    engine: Engine = in_process
    is_cancelled: Callable[[], bool] = never


def measure_all(
    items: Iterable[ItemT],
    worker: Worker[T],
    engine: Engine = in_process,
    is_cancelled: Callable[[], bool] = never,
) -> Iterator[tuple[ItemT, Outcome[T]]]:
    """Measure captures, and yield each item with its outcome, in order.

    Parameters
    ----------
    items : iterable of Listed or Failure
        The captures; failures are passed through in order.
    worker : Worker
        Reads and measures each capture, and converts the result.
    engine : Engine
        Where captures are processed: `in_turn`, `in_process`, `Processes` or `RayEngine`.
    is_cancelled : callable
        Once it returns True, running captures are finished and no more are started.

    Raises
    ------
    CucumberVisionError
        If a network or the calibration cannot be loaded.

    Examples
    --------
    >>> from cucumbervision import MeasureOptions, example_captures
    >>> worker = ResultWorker(Measurer(MeasureOptions(instances="dataset", methods=("M1",))))
    >>> listed = list_captures([example_captures()], worker.measurer.options.reading)
    >>> [(ref.name, len(outcome.value.fruit)) for ref, outcome in measure_all(listed, worker)]
    [('simulated-bench', 3), ('simulated-row-a', 3), ('simulated-row-b', 2)]
    """
    begun = deque[tuple[ItemT, bool]]()

    def started() -> Iterator[ItemT]:
        for item in items:
            is_dropped = isinstance(item, Listed) and is_cancelled()
            begun.append((item, is_dropped))
            if not is_dropped:
                yield item

    for outcome in engine(started(), worker):
        while begun[0][1]:
            yield begun.popleft()[0], Outcome()
        yield begun.popleft()[0], outcome
    yield from ((item, Outcome()) for item, _ in begun)


@dataclass(frozen=True, eq=False)
class Results:
    """Measured captures.

    Parameters
    ----------
    captures : tuple of CaptureResult
        One entry for each capture that could be read, in order.
    failures : tuple of Failure
        Captures that could not be read or measured.
    """

    captures: tuple[CaptureResult, ...]
    failures: tuple[Failure, ...] = ()

    @property
    def fruit(self) -> tuple[Fruit, ...]:
        """The fruit of all captures."""
        return tuple(fruit for result in self.captures for fruit in result.fruit)

    def rows(self) -> list[dict[str, Cell]]:
        """Return one row per fruit, with the columns of `measurements.csv`."""
        return [row for result in self.captures for row in result.rows()]

    def to_dataframe(self) -> pd.DataFrame:
        """Return the rows as a data frame.

        Raises
        ------
        MissingExtraError
            If pandas is not installed.
        """
        try:
            import pandas as pd
        except ModuleNotFoundError:
            raise MissingExtraError("pandas") from None
        fields = self.captures[0].fields if self.captures else FIELDS
        return pd.DataFrame(self.rows(), columns=[fruit_field.name for fruit_field in fields])

    def __iter__(self) -> Iterator[CaptureResult]:
        return iter(self.captures)

    def __len__(self) -> int:
        return len(self.captures)

    def __repr__(self) -> str:
        count, failed = len(self.fruit), len(self.failures)
        return f"<Results: {count} fruit in {len(self)} captures, {failed} failures>"


def measure(
    captures: Capture | Path | str | Pixels | Iterable[Capture | Path | str],
    depth: Numbers | None = None,
    intrinsics: Intrinsics | ArrayLike | None = None,
    *,
    masks: Iterable[Numbers] | None = None,
    instances: str | Path | Sequence[Instance] | Detector | None = None,
    segmenter: str | Segmenter | None = None,
    methods: str | Iterable[str | Method] = "all",
    traits: Iterable[Trait] = (),
    readers: Iterable[Reader] = (),
    depth_unit_m: float | None = None,
    options: MeasureOptions | None = None,
    **choices: Any,
) -> Results:
    """Measure captures, or the arrays of one.

    For repeated calls, use a `Measurer`: its networks are loaded once.

    Parameters
    ----------
    captures : Capture, Path or str, or several of them; or ndarray of uint8, shape (H, W, 3)
        Captures in memory; folders, files and URLs that `open_source` reads; or an image, red
        first.
    depth, intrinsics, depth_unit_m
        For an image, as in `Capture.from_arrays`.
    masks : iterable of ndarray, shape (H, W), optional
        The fruit of one capture, one mask each, as people drew them.
    instances : str, Path, sequence of Instance or Detector, optional
        Source of the fruit: as in `MeasureOptions.instances`; the instances of one capture; or a
        detector, which is called with each `Capture` and returns its instances.
    segmenter : str or Segmenter, optional
        Draws all masks: a name, as `MeasureOptions.segmenter`, or an object with `segment`.
    methods : str or iterable of str or Method
        Methods to run, as `MeasureOptions.methods`, and methods of your own.
    traits : iterable of Trait
        Traits of your own, each a column.
    readers : iterable of Reader
        Readers of your own, which see a folder before those of the package.
    options : MeasureOptions, optional
        How to measure.
    **choices
        Fields of `MeasureOptions`, in place of `options`.

    Returns
    -------
    Results
        A capture that cannot be read or measured is among its failures; the others are measured.

    Raises
    ------
    CucumberVisionError
        If arrays do not fit each other, a network or the calibration cannot be loaded, or an option
        is unknown.

    Examples
    --------
    >>> from cucumbervision import example_captures, measure
    >>> results = measure(example_captures(), instances="dataset")
    >>> results
    <Results: 8 fruit in 3 captures, 0 failures>
    >>> [f"{fruit.length.value_m:.2f} m" for fruit in results.fruit[:3]]
    ['0.16 m', '0.12 m', '0.25 m']

    Of arrays:

    >>> capture = results.captures[0].capture
    >>> measure(capture.color, capture.depth_m, capture.intrinsics.matrix, masks=capture.masks)
    <Results: 3 fruit in 1 captures, 0 failures>
    """
    if masks is not None:
        instances = [Instance.of_mask(mask) for mask in masks]
    detector: Detector | None = None
    if isinstance(instances, str | Path):
        choices = {**choices, "instances": str(instances)}
    elif instances is not None:
        detector = instances if callable(instances) else _always(instances)
    if isinstance(segmenter, str):
        choices, segmenter = {**choices, "segmenter": segmenter}, None
    method_names, own_methods = _sorted_methods(methods)
    if method_names != ["all"]:
        choices = {**choices, "methods": method_names}
    if options is not None and choices:
        raise TypeError("give options or their fields, not both")
    plug_ins = PlugIns(detector, segmenter, own_methods, tuple(traits))
    measurer = Measurer(options or MeasureOptions(**choices), plug_ins=plug_ins)
    measurer.load()
    if isinstance(captures, np.ndarray):
        if depth is None or intrinsics is None:
            raise CaptureError(
                "a picture alone has no lengths", remedy="give measure(color, depth, intrinsics)"
            )
        captures = Capture.from_arrays(captures, depth, intrinsics, depth_unit_m=depth_unit_m)
    elif not depth is intrinsics is depth_unit_m is None:
        raise CaptureError(
            "depth, intrinsics and depth_unit_m belong to a picture in memory",
            remedy="for files give options=MeasureOptions(reading=ReadOptions(...))",
        )
    inputs = [captures] if isinstance(captures, Capture | Path | str) else captures
    return _measured(measurer, inputs, partial(open_source, readers=tuple(readers)))


def _measured(
    measurer: Measurer, inputs: Iterable[Capture | Path | str], opener: Opener
) -> Results:
    """Measure captures in memory and those below paths."""

    def items() -> Iterator[Item]:
        for source in inputs:
            if isinstance(source, Capture):
                yield Listed.of(source)
            else:
                yield from list_captures([as_path(source)], measurer.options.reading, opener)

    chosen = measurer.options.instances
    labels = label_file(chosen) if measurer.plug_ins.detector is None else None
    listed = labelled_once(labels, items())
    outcomes = [outcome for _, outcome in measure_all(listed, ResultWorker(measurer))]
    results = [
        outcome.value
        for outcome in outcomes
        if outcome.value is not None and outcome.value.error is None
    ]
    failures = plugin_failures(measurer)
    failures += [failure for outcome in outcomes for failure in outcome.failures]
    if labels is not None:
        names = [((r.capture.name, r.capture.source), r.capture.frame) for r in results]
        with Boundary(failures, chosen):
            instance_notes(labels, names)
    return Results(tuple(results), tuple(failures))


def _sorted_methods(methods: str | Iterable[str | Method]) -> tuple[list[str], tuple[Method, ...]]:
    """Return the names among methods, 'all' if there are none, and the methods themselves."""
    listed = methods.split(",") if isinstance(methods, str) else list(methods)
    names = [method for method in listed if isinstance(method, str)]
    return names or ["all"], tuple(method for method in listed if not isinstance(method, str))


def _always(instances: Sequence[Instance]) -> Detector:
    return lambda _: instances
