"""What `cucumbervision train ends` looks like on screen: two bars, and a table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from cucumbervision.cli.console import progress_bar

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from cucumbervision_lab.training.ends import EndsResult

__all__ = ["train_ends"]


def train_ends(
    folders: Sequence[Path],
    out: Path,
    name: str,
    *,
    epochs: int,
    seed: int,
    threads: int,
    credits: Sequence[str],
) -> None:
    """Cut fruit out of the sets, train, and write the network and its card into `out`."""
    from cucumbervision_lab.datasets.checks import open_dataset
    from cucumbervision_lab.training import ends
    from cucumbervision_lab.training.export_yolo import import_ultralytics

    import_ultralytics()
    import torch

    if threads:
        torch.set_num_threads(threads)
    sets = [open_dataset(folder) for folder in folders]
    with progress_bar(Console(stderr=True, highlight=False)) as bar:
        task = bar.add_task("cutting", total=sum(len(one.pictures) for one in sets))
        strips = ends.collect_strips(sets, seed, lambda count: bar.advance(task, count))
        task = bar.add_task("learning", total=epochs)
        result = ends.train_ends(
            strips,
            out / f"{name}.onnx",
            epochs=epochs,
            seed=seed,
            progress=lambda *_: bar.advance(task, 1),
        )
    ends.write_ends_card(result, name, epochs=epochs, seed=seed, credits=credits)
    Console(highlight=False).print(_table(result))


def _table(result: EndsResult) -> Table:
    table = Table("fruit of scenes not learnt from", "ends told rightly")
    table.title, table.title_justify = f"{result.network}", "left"
    for kind, share in result.right.items():
        table.add_row(kind, f"{100 * share:.1f} %")
    sure = f"those at least 90 % sure ({100 * result.sure:.0f} % of all)"
    table.add_row(sure, f"{100 * result.sure_right:.1f} %")
    return table
