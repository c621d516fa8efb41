"""Measure many captures on a cluster by Ray Data; needs the extra 'cluster'."""

from __future__ import annotations

import logging
import os
import pickle
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError, MissingExtraError
from cucumbervision.networks.runtime import CARD_RUNTIMES, limit_threads
from cucumbervision.run.batch import Outcome, outcome_of_killed, portable
from cucumbervision.run.measurer import Failure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from cucumbervision.run.batch import Item, Worker

_SHARE = 0.9
"""Of the CPUs that the actors claim together: if they claim every core, Ray's own tasks starve."""

_TRIES = 2  # of a capture whose worker is killed


@dataclass(frozen=True)
class RayEngine:
    """Does tasks on a Ray cluster, in actors that load the networks once.

    Parameters
    ----------
    address : str
        Address of the cluster, as in `ray.init`; 'local' starts one on this machine for the run.
    workers : int
        Number of measuring actors; 0 means one per CPU.
    """

    address: str = "local"
    workers: int = 0

    def __call__(
        self, items: Iterable[Item], worker: Worker[Any], is_cancelled: Callable[[], bool]
    ) -> Iterator[Outcome[Any]]:
        """Process the items; Ray Data limits the number of captures in memory.

        If a worker is killed, its captures are measured again. A capture whose worker is killed
        twice becomes a failure.

        Raises
        ------
        MissingExtraError
            If Ray is not installed.
        CucumberVisionError
            If the cluster cannot be reached, or networks or calibration cannot be loaded.
        """
        ray = _import_ray()
        listed = list(items)
        done = 0
        if not all(isinstance(entry, Failure) for entry in listed):
            self._connect(ray)
            try:
                for row in self._dataset(ray, listed, worker).iter_rows():
                    while done < row["number"]:
                        yield outcome_of_killed(listed[done])
                        done += 1
                    outcome = pickle.loads(row["done"])
                    if isinstance(outcome, CucumberVisionError):
                        raise outcome
                    done += 1
                    yield outcome
                    if is_cancelled():
                        break
                else:
                    for item in listed[done:]:
                        yield outcome_of_killed(item)
                    done = len(listed)
            finally:
                ray.shutdown()
        for entry in listed[done:]:
            yield Outcome(failures=(entry,)) if isinstance(entry, Failure) else Outcome()

    def _connect(self, ray: Any) -> None:
        try:
            # A local cluster needs neither dashboard nor log output.
            local = self.address == "local"
            local_options = {"include_dashboard": False, "num_cpus": None} if local else {}
            ray.init(self.address, log_to_driver=False, logging_level="error", **local_options)
        except Exception as error:  # Ray's exceptions have no common base class
            raise CucumberVisionError(
                f"no Ray cluster can be reached ({error})",
                source=self.address,
                remedy="check --ray, or give local for this machine alone",
            ) from None

    def _dataset(self, ray: Any, listed: list[Item], worker: Worker[Any]) -> Any:
        resources = ray.cluster_resources()
        cpus, gpus = float(resources.get("CPU", 1)), float(resources.get("GPU", 0))
        workers = self.workers or max(1, int(cpus))
        share = _SHARE * cpus / workers
        context = ray.data.DataContext.get_current()
        context.execution_options.preserve_order = True
        context.enable_progress_bars = False
        logging.getLogger("ray.data").setLevel(logging.CRITICAL)
        # Ray would begin a capture that kills its worker again and again, without end.
        context.max_errored_blocks = -1
        items = [
            {"number": number, "item": pickle.dumps(portable(entry))}
            for number, entry in enumerate(listed)
        ]
        on_gpus = worker.measurer.options.runtime in CARD_RUNTIMES
        dataset = ray.data.from_items(items, override_num_blocks=len(items))
        return dataset.map(
            _Measuring,
            fn_constructor_args=(worker, max(1, int(share))),
            compute=ray.data.ActorPoolStrategy(size=workers),
            num_cpus=share,
            num_gpus=gpus / workers if on_gpus else 0,
            max_restarts=-1,
            max_task_retries=_TRIES - 1,
        )


class _Measuring:
    """Measures captures in an actor, whose networks are loaded once."""

    def __init__(self, worker: Worker[Any], threads: int) -> None:
        limit_threads(threads)
        self._worker = worker

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        outcome: Outcome[Any] | CucumberVisionError
        try:
            outcome = self._worker(pickle.loads(row["item"]))
        except CucumberVisionError as error:  # networks or calibration cannot be loaded
            outcome = error
        return {"number": row["number"], "done": pickle.dumps(outcome)}


def _import_ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        import ray.data
    except ModuleNotFoundError:
        raise MissingExtraError("ray", "cluster") from None
    return ray
