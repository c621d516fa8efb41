"""`cucumbervision models pull`: fetch a network and export it, which takes torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def pull(
    name: Annotated[str, typer.Argument(help="A name that `models list` shows.")],
    given: Annotated[
        Path | None,
        typer.Option("--from", help="The publisher's file, downloaded by hand.", metavar="FILE"),
    ] = None,
) -> None:
    """Fetch a network from its publisher, check its hash and export it to ONNX."""
    from cucumbervision_lab.cli.screen import DownloadBar, show
    from cucumbervision_lab.training.export_sam import pull_model

    show(*pull_model(name, given=given, progress=DownloadBar(name)).values())
