"""What drawing a set looks like on screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console

from cucumbervision.cli.console import progress_bar
from cucumbervision_lab.synthesis.generate import generate

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision_lab.synthesis.generate import SynthOptions

__all__ = ["run_and_show"]


def run_and_show(options: SynthOptions, out: Path, workers: int, *, quiet: bool) -> None:
    """Draw the set, show progress, and say what is in it."""
    with progress_bar(Console(stderr=True, quiet=quiet, highlight=False)) as bar:
        task = bar.add_task("drawing", total=options.frames)

        def advance(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        data = generate(options, out, workers, advance)
    if quiet:
        return
    fruit = sum(len(picture.labels) for picture in data.pictures)
    ignored = sum(label.ignore for picture in data.pictures for label in picture.labels)
    parts = ", ".join(f"{len(data.in_split(s))} {s}" for s in ("train", "val", "test"))
    Console(highlight=False).print(
        f"{len(data.pictures)} pictures ({parts}) with {fruit} cucumbers, {ignored} of them too "
        f"hidden or too small to count, are in {out}/",
        soft_wrap=True,
    )
