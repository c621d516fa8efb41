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
from numpy.typing import ArrayLike

from cucumbervision import errors
from cucumbervision.arrays import Numbers, Pixels
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, unique_name
from cucumbervision.files import as_path
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.label_files import InstanceFile, LabelledImage, read_instances
from cucumbervision.methods.result import Fruit
from cucumbervision.methods.table import Method, Trait
from cucumbervision.networks.runtime import CARD_RUNTIMES, limit_threads
from cucumbervision.plugins import Detector, Reader, Segmenter, plugins
from cucumbervision.run.fields import FIELDS, Cell
from cucumbervision.run.measurer import Boundary, CaptureResult, Failure, Measurer, plugin_failures
from cucumbervision.run.options import INSTANCE_SOURCES, MeasureOptions, PlugIns

if TYPE_CHECKING:
    import pandas as pd

_log = logging.getLogger(__name__)
_LONGEST_LIST = 300

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
ItemT = TypeVar("ItemT", bound="CaptureRef | Failure")

Item: TypeAlias = CaptureRef | Failure
"""A capture to measure, or the reason why it cannot be listed."""


def load(item: Item) -> Capture | Failure:
    """Read a capture under the name of its item; a failure is returned."""
    if isinstance(item, Failure):
        return item
    failures: list[Failure] = []
    with Boundary(failures, item.input, item.name):
        capture = item.load()
        return capture if capture.name == item.name else replace(capture, name=item.name)
    return failures[0]


def portable(item: Item) -> Item:
    """Return an item that another process can read.

    A capture without files, such as a frame of a recording, is read here.
    """
    if isinstance(item, Failure) or item.parts is not None:
        return item
    read = load(item)
    return read if isinstance(read, Failure) else replace(item, load=CaptureRef.of(read).load)


def _place(location: Path | str) -> str:
    """Return the place that a path leads to; several paths may lead to one place."""
    return str(location) if "://" in str(location) else os.path.realpath(location)


def list_captures(
    inputs: Iterable[Path],
    reading: ReadOptions,
    readers: Sequence[Reader] = (),
    say: Callable[[str], None] = _log.warning,
) -> Iterator[Item]:
    """List the captures of all inputs; each input is opened once, when it is reached.

    Parameters
    ----------
    inputs : iterable of Path
        Folders and files that `open_source` can read.
    reading : ReadOptions
        Reading options.
    readers : sequence of Reader
        Further readers, as for `open_source`.
    say : callable
        Called with a line for an input that was given before.

    Yields
    ------
    CaptureRef or Failure
        A capture, or the failure of one or of a whole input.
    """
    places = set[str]()
    for path in inputs:
        if (place := _place(path)) in places:
            say(f"{path} is given twice: it is measured once")
            continue
        places.add(place)
        yield from list_source(str(path), partial(open_source, path, reading, readers))


def list_source(name: str, open_it: Callable[[], CaptureSource]) -> Iterator[Item]:
    """List the captures of one source, as `list_captures`; `name` is the input in failures."""
    failures: list[Failure] = []
    with Boundary(failures, name):
        source = open_it()
        if unused := source.unused:
            names = shorten(", ".join(unused), _LONGEST_LIST, placeholder=" …")
            _log.warning("%s: %d images belong to no capture: %s", name, len(unused), names)
        for ref in source:
            yield replace(ref, input=name)
    yield from failures


def read_captures(inputs: Iterable[Path], reading: ReadOptions) -> Iterator[Capture | Failure]:
    """Read the captures of all inputs one after the other; parameters as for `list_captures`."""
    return map(load, list_captures(inputs, reading))


def each_once(listed: Iterable[Item], say: Callable[[str], None]) -> Iterator[Item]:
    """Yield every capture once, with a unique name.

    A capture that cannot be read also reserves its name, so that the names of the others do not
    change when it is repaired.

    Parameters
    ----------
    listed : iterable of CaptureRef or Failure
        Result of `list_captures`.
    say : callable
        Called at the end with a line for each input that repeats earlier captures.
    """
    names, places, repeats = set[str](), set[str](), Counter[str]()
    for item in listed:
        if isinstance(item, Failure):
            yield item
            continue
        place = _place(item.location)
        if item.location and place in places:
            repeats[item.input] += 1
            continue
        places.add(place)
        yield replace(item, name=unique_name(item.name, names))
    for path, count in repeats.items():
        what = "1 capture was" if count == 1 else f"{count} captures were"
        say(f"{path}: {what} given before, and measured once")


def count_captures(inputs: Sequence[Path], reading: ReadOptions) -> int | None:
    """Return the number of captures in the inputs; None if it is known only after reading."""
    total = 0
    for path in {_place(path): path for path in inputs}.values():
        source = None
        with Boundary([], str(path)):
            source = open_source(path, reading)
        if source is not None and source.total is None:
            return None
        # An input that cannot be opened counts as one step.
        total += 1 if source is None else source.total or 0
    return total


class Labels:
    """Compares the captures of a run with the file of fruit that its options name.

    Parameters
    ----------
    instances : str
        `MeasureOptions.instances`; if it names no file, nothing is compared.

    Raises
    ------
    InstancesError
        If the file cannot be read.
    """

    def __init__(self, instances: str) -> None:
        self._file: InstanceFile | None = None
        self._names: dict[int, str] = {}  # of the capture that an entry of the file belongs to
        self._missing: list[str] = []
        is_network = Path(instances).suffix.lower() == ".onnx"
        if not (is_network or instances in INSTANCE_SOURCES or instances in plugins("detectors")):
            self._file = read_instances(instances)

    def checked(self, items: Iterable[ItemT]) -> Iterator[ItemT | Failure]:
        """Yield items; a capture whose entry in the file an earlier one has becomes a failure."""
        for item in items:
            if self._file is None or isinstance(item, Failure):
                yield item
                continue
            with suppress(errors.InstancesError):  # measuring the capture raises the error
                place = item.location.removesuffix("/capture.json")
                entry = self._file.find((item.name, place), item.frame)
                if entry is None:
                    self._missing.append(item.name)
                elif self._names.setdefault(id(entry), item.name) != item.name:
                    yield Failure.of(self._twice(entry, item.name), item.input, item.name)
                    continue
            yield item

    def _twice(self, entry: LabelledImage, name: str) -> errors.InstancesError:
        return errors.InstancesError(
            f"names {entry.name or entry.number} once, which both {self._names[id(entry)]} and "
            f"{name} are: only the first was measured, maybe with the other's fruit",
            source=self._file and self._file.source,
            remedy="name the images with their folders, and measure again",
        )

    def notes(self) -> list[str]:
        """Return notes on captures and on images of the file without a counterpart.

        Raises
        ------
        InstancesError
            If the file names none of the captures.
        """
        file, missing = self._file, self._missing
        if file is None or not (missing or self._names):
            return []
        unused = [
            image.name or f"image id {image.number}"
            for image in file.pictures
            if id(image) not in self._names
        ]
        if not self._names:
            raise errors.InstancesError(
                f"names none of the captures ({_shortened(missing)}); it names "
                f"{_shortened(unused)}",
                source=file.source,
                remedy="name its images as the captures are called",
            )
        notes = [f"no fruit given for {', '.join(missing)}"] if missing else []
        notes += [f"no capture is called {', '.join(unused)}"] if unused else []
        if file.crowds:
            notes.append(f"{file.crowds} crowd regions, of several fruit each, are left out")
        return [f"{file.source}: {note}" for note in notes]


def _shortened(names: Sequence[str], most_names: int = 5) -> str:
    remainder = f" and {len(names) - most_names} more" if len(names) > most_names else ""
    return f"{', '.join(names[:most_names])}{remainder}"


class Worker(ABC, Generic[T_co]):
    """Does the work of one capture, in this process or as a copy in another.

    Parameters
    ----------
    measurer : Measurer
        The measurer; its networks are loaded with the first capture.
    """

    def __init__(self, measurer: Measurer) -> None:
        self.measurer = measurer

    def __call__(self, item: Item) -> T_co | Failure | None:
        """Read and measure one item; None if there is nothing to measure.

        Raises
        ------
        CucumberVisionError
            If the networks or the calibration cannot be loaded, as `Measurer.load`.
        """
        read = load(item)
        return read if isinstance(read, Failure) else self.measure(read)

    @abstractmethod
    def measure(self, capture: Capture) -> T_co | Failure:
        """Measure a capture, and convert the result."""


class ResultWorker(Worker[CaptureResult]):
    """Returns results unchanged."""

    def measure(self, capture: Capture) -> CaptureResult | Failure:
        """Measure a capture."""
        self.measurer.load()
        result = self.measurer.attempt(capture)
        return result if result.error is None else result.failures[0]


Engine: TypeAlias = Callable[[Iterable[Item], Worker[Any]], Iterator[Any]]
"""Processes all items, and yields the worker's result of each, in order, when it is available."""


def in_turn(items: Iterable[Item], worker: Worker[Any]) -> Iterator[Any]:
    """Process one item after the other, and request the next only when the previous one is done."""
    return map(worker, items)


def in_process(items: Iterable[Item], worker: Worker[Any]) -> Iterator[Any]:
    """Process two items at once in this process: the networks find one's fruit meanwhile."""
    with ThreadPoolExecutor(2) as threads:
        yield from _in_order(items, lambda item: threads.submit(worker, item).result, 2)


def _in_order(
    items: Iterable[Item], submit: Callable[[Item], Callable[[], Any]], most_running: int
) -> Iterator[Any]:
    """Yield results in the order of the items, of which some are submitted ahead."""
    remaining, running = iter(items), deque[Callable[[], Any]]()
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

    def __call__(self, items: Iterable[Item], worker: Worker[Any]) -> Iterator[Any]:
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

        def submit(item: Item) -> Callable[[], Any]:
            nonlocal pool
            ready = portable(item)
            try:
                future = pool.submit(_do, ready)
            except BrokenProcessPool:
                pool = new_pool()
                future = pool.submit(_do, ready)
            return partial(result, ready, future)

        def result(item: Item, future: Future[Any]) -> Any:
            with suppress(BrokenProcessPool):
                return future.result()
            with suppress(BrokenProcessPool), new_pool(1) as alone:
                return alone.submit(_do, item).result()
            return _killed(item)

        try:
            yield from _in_order(items, submit, 2 * self.workers)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _killed(item: Item) -> Failure:
    """Return the failure of a capture whose process was killed twice."""
    if isinstance(item, Failure):
        return item
    error = errors.CaptureError(
        "the process that measured it was killed twice",
        source=item.name,
        remedy="look whether there is enough memory, and room on the disk for temporary files, or "
        "measure it alone",
    )
    return Failure.of(error, item.input, item.name)


_worker: list[Worker[Any]] = []  # the worker of this process


def _begin(worker: Worker[Any], threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command stops its workers
    threading.Thread(target=end_with_parent, daemon=True).start()
    limit_threads(threads)
    _worker.append(worker)


def _do(item: Item) -> Any:
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

    def __call__(self, items: Iterable[Item], worker: Worker[Any]) -> Iterator[Any]:
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
            raise errors.MissingExtraError("ray", "cluster") from None
        try:
            # A local cluster needs no dashboard.
            local = {"include_dashboard": False} if self.address == "local" else {}
            ray.init(self.address, log_to_driver=False, logging_level="error", **local)
        except Exception as error:  # Ray's exceptions have no common base class
            raise errors.CucumberVisionError(
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

            def submit(item: Item) -> Callable[[], Any]:
                ready = portable(item)
                return partial(result, ready, do.remote(shared, max(1, int(share)), ready))

            def result(item: Item, future: Any) -> Any:
                try:
                    return ray.get(future)
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None
                except ray.exceptions.RayError:
                    return _killed(item)

            yield from _in_order(items, submit, 2 * workers)
        finally:
            ray.shutdown()


def _do_on_cluster(shared: list[Any], threads: int, item: Item) -> Any:
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
    engine : Engine
        Where captures are processed.
    is_cancelled : callable
        Called before each capture; if it returns True, no further capture is started.
    """

    engine: Engine = in_process
    is_cancelled: Callable[[], bool] = never


def measure_all(
    items: Iterable[ItemT],
    worker: Worker[T],
    engine: Engine = in_process,
    is_cancelled: Callable[[], bool] = never,
) -> Iterator[tuple[ItemT, T | Failure | None]]:
    """Measure captures, and yield each item with the worker's result, in order.

    Parameters
    ----------
    items : iterable of CaptureRef or Failure
        The captures; failures are passed through in order.
    worker : Worker
        Reads and measures each capture, and converts the result.
    engine : Engine
        Where captures are processed: `in_turn`, `in_process`, `Processes` or `RayEngine`.
    is_cancelled : callable
        Once it returns True, running captures are finished and no more are started.

    Yields
    ------
    item : CaptureRef or Failure
        The item.
    result : object, Failure or None
        None if the capture needed no work, or the loop was cancelled before its turn.

    Raises
    ------
    CucumberVisionError
        If a network or the calibration cannot be loaded.

    Examples
    --------
    >>> from cucumbervision import MeasureOptions, example_captures
    >>> worker = ResultWorker(Measurer(MeasureOptions(instances="dataset", methods=("M1",))))
    >>> listed = list_captures([example_captures()], worker.measurer.options.reading)
    >>> [(ref.name, len(result.fruit)) for ref, result in measure_all(listed, worker)]
    [('simulated-bench', 3), ('simulated-row-a', 3), ('simulated-row-b', 2)]
    """
    begun = deque[tuple[ItemT, bool]]()

    def started() -> Iterator[ItemT]:
        for item in items:
            is_dropped = isinstance(item, CaptureRef) and is_cancelled()
            begun.append((item, is_dropped))
            if not is_dropped:
                yield item

    for result in engine(started(), worker):
        while begun[0][1]:
            yield begun.popleft()[0], None
        yield begun.popleft()[0], result
    yield from ((item, None) for item, _ in begun)


def results_of(
    items: Iterable[Item], worker: Worker[T], is_cancelled: Callable[[], bool] = never
) -> tuple[list[T], list[Failure]]:
    """Measure captures as `measure_all`; return results and failures, each in order."""
    results, failures = list[T](), list[Failure]()
    for _, result in measure_all(items, worker, is_cancelled=is_cancelled):
        if isinstance(result, Failure):
            failures.append(result)
        elif result is not None:
            results.append(result)
            failures += getattr(result, "failures", ())
    return results, failures


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
            raise errors.MissingExtraError("pandas") from None
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
            raise errors.CaptureError(
                "a picture alone has no lengths", remedy="give measure(color, depth, intrinsics)"
            )
        captures = Capture.from_arrays(captures, depth, intrinsics, depth_unit_m=depth_unit_m)
    elif not depth is intrinsics is depth_unit_m is None:
        raise errors.CaptureError(
            "depth, intrinsics and depth_unit_m belong to a picture in memory",
            remedy="for files give options=MeasureOptions(reading=ReadOptions(...))",
        )
    inputs = [captures] if isinstance(captures, Capture | Path | str) else captures
    return _measured(measurer, inputs, tuple(readers))


def _measured(
    measurer: Measurer, inputs: Iterable[Capture | Path | str], readers: Sequence[Reader]
) -> Results:
    """Measure captures in memory and those below paths."""

    def items() -> Iterator[Item]:
        for source in inputs:
            if isinstance(source, Capture):
                yield CaptureRef.of(source)
            else:
                yield from list_captures([as_path(source)], measurer.options.reading, readers)

    chosen = measurer.options.instances
    labels = Labels(chosen if measurer.plug_ins.detector is None else "auto")
    results, failed = results_of(labels.checked(items()), ResultWorker(measurer))
    failures = [*plugin_failures(measurer), *failed]
    with Boundary(failures, chosen):
        labels.notes()
    return Results(tuple(results), tuple(failures))


def _sorted_methods(methods: str | Iterable[str | Method]) -> tuple[list[str], tuple[Method, ...]]:
    """Return the names among methods, 'all' if there are none, and the methods themselves."""
    listed = methods.split(",") if isinstance(methods, str) else list(methods)
    names = [method for method in listed if isinstance(method, str)]
    return names or ["all"], tuple(method for method in listed if not isinstance(method, str))


def _always(instances: Sequence[Instance]) -> Detector:
    return lambda _: instances
