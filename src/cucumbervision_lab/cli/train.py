"""`cucumbervision train`: train the detector and the keypoints, and export what was trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["app"]

app = typer.Typer(
    name="train",
    help="Train the networks on labelled pictures (extra 'train'), and export them.",
    no_args_is_help=True,
)

Data = Annotated[Path | None, typer.Argument(help="A data set's folder or data.yaml.")]
Out = Annotated[Path, typer.Option("--out", help="The run's folder.", metavar="RUN")]
Init = Annotated[
    str | None,
    typer.Option("--init", help="Weights to begin with (.pt), or an Ultralytics .yaml."),
]
Stages = Annotated[
    str | None, typer.Option("--stages", help="Sizes and epochs, as in 320x8,448x6,640x2.")
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on with RUN; a longer --stages prolongs it.")
]
Batch = Annotated[int, typer.Option("--batch", min=2, help="Pictures at a time.")]
Device = Annotated[str, typer.Option("--device", help="auto, cpu, or a CUDA card's number.")]
Precision = Annotated[str, typer.Option("--precision", help="auto, f32 or bf16 (on the CPU).")]
Freeze = Annotated[int, typer.Option("--freeze", min=0, help="Layers left as they are.")]
Patience = Annotated[int, typer.Option("--patience", min=1, help="Epochs without gain.")]
Seed = Annotated[int, typer.Option("--seed", help="Of the random numbers.")]
Cache = Annotated[
    str, typer.Option("--cache", help="Decoded pictures: ram, disk (beside them) or none.")
]
Threads = Annotated[int, typer.Option("--threads", min=0, help="0: as many as cores.")]
Workers = Annotated[int, typer.Option("--workers", min=0, help="Processes that load.")]
Minutes = Annotated[
    float | None,
    typer.Option("--epochs-limit-minutes", min=0, help="End after the epoch that passes this."),
]
Check = Annotated[
    bool, typer.Option("--check/--no-check", help="Refuse a data set with faults or leaks.")
]
Rate = Annotated[float, typer.Option("--learning-rate", min=0, help="Of the first stage.")]


@app.command()
def seg(
    out: Out,
    data: Data = None,
    init: Init = None,
    stages: Stages = None,
    resume: Resume = False,
    batch: Batch = 8,
    device: Device = "auto",
    precision: Precision = "auto",
    freeze: Freeze = 0,
    patience: Patience = 20,
    seed: Seed = 0,
    cache: Cache = "ram",
    threads: Threads = 0,
    workers: Workers = 0,
    minutes: Minutes = None,
    learning_rate: Rate = 0.001,
    check: Check = True,
) -> None:
    """Train boxes and masks."""
    _train("seg", **locals())


@app.command()
def pose(
    out: Out,
    data: Data = None,
    init: Init = None,
    stages: Stages = None,
    resume: Resume = False,
    batch: Batch = 8,
    device: Device = "auto",
    precision: Precision = "auto",
    freeze: Freeze = 0,
    patience: Patience = 20,
    seed: Seed = 0,
    cache: Cache = "ram",
    threads: Threads = 0,
    workers: Workers = 0,
    minutes: Minutes = None,
    learning_rate: Rate = 0.001,
    check: Check = True,
) -> None:
    """Train boxes and the five keypoints."""
    _train("pose", **locals())


def _train(
    task: str,
    out: Path,
    data: Path | None,
    init: str | None,
    stages: str | None,
    resume: bool,
    **options: object,
) -> None:
    from cucumbervision_lab.cli.train_console import TrainConsole
    from cucumbervision_lab.training.train import TrainOptions, train

    with TrainConsole() as console:
        best = train(
            task,
            data,
            out,
            init=init,
            stages=stages,
            resume=resume,
            options=TrainOptions(**options),  # type: ignore[arg-type]
            watcher=console,
        )
    console.close(best)


@app.command()
def ends(
    sets: Annotated[
        list[Path], typer.Argument(help="Labelled sets with keypoints.", metavar="SET...")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder to write into.", metavar="DIR")],
    name: Annotated[str, typer.Option("--name", help="The network's name.")] = "cucumber-ends",
    epochs: Annotated[int, typer.Option(min=1, help="Rounds through all fruit.")] = 20,
    seed: Seed = 0,
    threads: Threads = 0,
    credit: Annotated[
        list[str] | None, typer.Option("--credit", help="Whom the card is to name; repeatable.")
    ] = None,
) -> None:
    """Train what tells a fruit's stem end from its blossom end, and write it with its card."""
    from cucumbervision_lab.cli.ends_console import train_ends

    train_ends(sets, out, name, epochs=epochs, seed=seed, threads=threads, credits=credit or ())


@app.command()
def export(
    source: Annotated[Path, typer.Argument(help="A run's folder, or a checkpoint (.pt).")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write into.", metavar="DIR")],
    name: Annotated[str, typer.Option("--name", help="What commands are to call it.")],
    evaluation: Annotated[
        Path | None, typer.Option("--evaluation", help="A JSON file to take into the card.")
    ] = None,
    credit: Annotated[
        list[str] | None, typer.Option("--credit", help="Whom the card is to name; repeatable.")
    ] = None,
) -> None:
    """Write the ONNX file and its card, and show its entry for the registry."""
    from rich.console import Console

    from cucumbervision_lab.training.export_trained import export_trained
    from cucumbervision_lab.training.publish import registry_entry

    card = export_trained(source, out, name, evaluation=evaluation, credits=credit or ())
    console = Console(highlight=False, markup=False)
    for suffix in (".onnx", ".md", ".json"):
        console.print(str(out / f"{name}{suffix}"), soft_wrap=True)
    console.print(f"\n{registry_entry(card)}", soft_wrap=True)


@app.command(hidden=True)
def ship(
    exported: Annotated[Path, typer.Argument(help="Folder that `train export` wrote.")],
    name: Annotated[str, typer.Option("--name", help="The network's name.")],
) -> None:
    """Put an exported network into the package (for maintainers)."""
    from rich.console import Console

    from cucumbervision_lab.training.publish import ship as put

    for path in put(exported, name):
        Console(highlight=False).print(str(path), soft_wrap=True)
