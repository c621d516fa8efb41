"""`cucumbervision train`: train and export networks."""

from __future__ import annotations

import os
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import InputSize
from cucumbervision_lab.cli import part_bars, show

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision_lab.arrays import Progress
    from cucumbervision_lab.data.labels import DataSet
    from cucumbervision_lab.train.classifier import ClassifierOptions, Trained

    Tick = Progress

app = typer.Typer(
    name="train",
    help="Train networks on labelled pictures and export them (requires the extra 'train').",
    no_args_is_help=True,
)

Out = Annotated[
    Path, typer.Option("--out", help="Folder of the run; rerun to resume.", metavar="RUN")
]
Folder = Annotated[Path, typer.Option("--out", help="Folder to write into.", metavar="DIR")]
Epochs = Annotated[int, typer.Option(min=1, help="Number of epochs.")]
Size = Annotated[int, typer.Option(min=32, help="Size of the training pictures, pixels.")]
Batch = Annotated[int, typer.Option(min=0, help="Batch size; 0: 8 on the CPU, 64 on a GPU.")]
Device = Annotated[str, typer.Option(help="auto, cpu or a CUDA device number.")]
Seed = Annotated[int, typer.Option(help="Random seed.")]
Rate = Annotated[float, typer.Option(min=0, help="Initial learning rate.")]
Credit = Annotated[
    list[str] | None, typer.Option("--credit", help="Credit for the card; repeatable.")
]


class Task(StrEnum):
    """The tasks that `train network` trains for."""

    SEG = "seg"
    POSE = "pose"


@app.command()
def network(
    task: Annotated[
        Task, typer.Argument(help="seg: boxes and masks; pose: boxes and the five keypoints.")
    ],
    sets: Annotated[
        list[Path],
        typer.Argument(help="Labelled sets; one given twice counts twice.", metavar="SET..."),
    ],
    out: Out,
    init: Annotated[
        str, typer.Option(help="Initial weights (.pt), or an Ultralytics .yaml.")
    ] = "checkpoints/cucumber-seg.pt",
    epochs: Epochs = 50,
    size: Size = 640,
    batch: Batch = 0,
    device: Device = "auto",
    seed: Seed = 0,
    learning_rate: Rate = 0.001,
    freeze: Annotated[int, typer.Option(min=0, help="Number of layers to freeze.")] = 0,
) -> None:
    """Train a detector by Ultralytics: boxes with masks, or with keypoints."""
    from cucumbervision_lab.train.network import NETWORK, TrainOptions, open_sets, train

    # A training that goes on has its data in RUN.
    read = [] if (out / NETWORK).is_file() else open_sets(sets)
    options = TrainOptions(epochs, size, batch, device, seed, learning_rate, freeze)
    show(f"weights: {train(task, read, out, init, options, show)}")


@app.command()
def house(
    data: Annotated[Path, typer.Argument(help="Data set from `data from-store`.", metavar="SET")],
    out: Out,
    photos: Annotated[
        Path | None,
        typer.Option(
            "--data",
            help="Folder of the audited photos, to train on and to compare by.",
            metavar="PHOTOS",
        ),
    ] = None,
    init: Annotated[Path, typer.Option(help="Initial weights.")] = Path(
        "checkpoints/cucumber-seg.pt"
    ),
    epochs: Epochs = 15,
    size: Size = 640,
    learning_rate: Rate = 0.0003,
    share: Annotated[
        float, typer.Option(min=0.05, max=0.95, help="Share of greenhouse pictures.")
    ] = 0.5,
    frames: Annotated[int, typer.Option(min=1, help="Number of simulated frames mixed in.")] = 200,
    batch: Batch = 0,
    device: Device = "auto",
) -> None:
    """Fine-tune the detector on pictures of your greenhouse, and compare it with the one in use.

    Rerun the command to resume. `models use RUN` then switches to the new detector.
    """
    from cucumbervision_lab.train.house import train_house
    from cucumbervision_lab.train.network import TrainOptions

    judged = train_house(
        data,
        out,
        photos=photos,
        init=init,
        share=share,
        frames=frames,
        options=TrainOptions(epochs, size, batch, device, learning_rate=learning_rate),
        workers=os.cpu_count() or 1,
        log=show,
    )
    show(judged.with_suffix(".md").read_text(encoding="utf-8"))
    show(f"To use it: cucumbervision models use {out}")


class SmallNetwork(StrEnum):
    """The small networks that `train classifier` trains."""

    FRUIT = "fruit"
    LOOK = "look"


@app.command()
def classifier(
    kind: Annotated[
        SmallNetwork,
        typer.Argument(
            help="fruit: looks at each detection, draws its outline and keypoints. look: looks at "
            "each end of a fruit, and fits its intervals."
        ),
    ],
    sets: Annotated[
        list[Path],
        typer.Argument(
            help="Data sets: completely labelled for fruit, drawn with depth (`synth`) for look.",
            metavar="SET...",
        ),
    ],
    out: Folder,
    init: Annotated[
        str, typer.Option(help="Weights of YOLO26n-seg (.pt), or of an earlier training (.pt).")
    ],
    name: Annotated[
        str | None, typer.Option(help="The network's name.", show_default="cucumber-KIND")
    ] = None,
    epochs: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Number of epochs; 0: judge the network of --init, and learn the intervals by it.",
            show_default="20, and 8 for look",
        ),
    ] = None,
    seed: Seed = 0,
    leaves: Annotated[
        Path | None,
        typer.Option(
            help="For look: leaves cut out of photos (PNG with transparency), laid over, beside "
            "and behind ends to train on.",
            metavar="DIR",
        ),
    ] = None,
    credit: Credit = None,
) -> None:
    """Train a small network, and write it with its card.

    The same command goes on with an interrupted training. For look, each set's fruit are measured
    first, those of held-out scenes on the networks' masks; what was measured stays in the folder.
    It fits the intervals to the network's answers about the ends of held-out fruit.
    """
    from rich.console import Console
    from rich.table import Table

    from cucumbervision_lab.data.checks import open_dataset
    from cucumbervision_lab.train.classifier import ClassifierOptions, write_classifier_card

    look = kind is SmallNetwork.LOOK
    if leaves is not None and not look:
        raise typer.BadParameter("is for look only", param_hint="--leaves")
    name = name or f"cucumber-{kind}"
    if epochs is None:
        epochs = 8 if look else 20
    out.mkdir(parents=True, exist_ok=True)
    opened = [open_dataset(folder) for folder in sets]
    pictures, file = sum(len(dataset.pictures) for dataset in opened), out / f"{name}.onnx"
    with part_bars() as report:

        def cut(count: int) -> None:
            report("cutting out", count, pictures)

        options = ClassifierOptions(
            epochs,
            seed,
            batch=96 if look else 48,
            keep=out / f"{name}-training.pt",
            progress=lambda *_: report("training", 1, epochs),
        )
        if look:
            trained = _train_look(opened, file, init, options, leaves, cut)
        else:
            trained = _train_fruit(opened, file, init, options, cut)
    write_classifier_card(trained, name, init, options, credit or ())
    table = Table("held-out scenes", "", title=str(trained.network))
    for words, value in trained.metrics.items():
        table.add_row(words, f"{value:.4g}")
    Console(highlight=False).print(table)


def _train_fruit(
    sets: Sequence[DataSet], file: Path, init: str, options: ClassifierOptions, cut: Tick
) -> Trained:
    from cucumbervision_lab.train.fruit_crops import collect_sets
    from cucumbervision_lab.train.fruit_look import train_fruit

    crops = collect_sets(sets, file.with_name(f"{file.stem}-crops"), cut)
    return train_fruit(crops, init, file, options)


def _train_look(
    sets: Sequence[DataSet],
    file: Path,
    init: str,
    options: ClassifierOptions,
    leaves: Path | None,
    cut: Tick,
) -> Trained:
    """Train the look at ends and learn its intervals; what was measured stays in the folder."""
    from cucumbervision_lab.scenes.covers import read_pieces
    from cucumbervision_lab.train.end_crops import collect_set, joined_ends
    from cucumbervision_lab.train.end_look import learn_look_intervals, train_look

    pieces = () if leaves is None else read_pieces(leaves)
    parts = [
        collect_set(dataset, file.with_name(f"ends-{number}.jsonl"), options.seed, cut, pieces)
        for number, dataset in enumerate(sets)
    ]
    fruit = [measured for of_set, _ in parts for measured in of_set]
    crops = joined_ends([of_set for _, of_set in parts])
    trained = train_look(crops, init, file, options)
    book = file.with_name("interval_models.json")
    behind = learn_look_intervals(fruit, crops, trained.network, book)
    return replace(trained, metrics={**trained.metrics, "fruit behind the intervals": behind})


@app.command()
def average(
    first: Annotated[Path, typer.Argument(help="Checkpoint (.pt).", metavar="FIRST")],
    second: Annotated[
        Path,
        typer.Argument(
            help="Checkpoint fine-tuned from FIRST or the same weights.", metavar="SECOND"
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="The checkpoint to write.", metavar="FILE")],
    share: Annotated[float, typer.Option(help="Weight of SECOND, 0 to 1.")] = 0.5,
) -> None:
    """Average two checkpoints, which reduces forgetting after fine-tuning."""
    from cucumbervision_lab.train.network import average_networks

    show(average_networks(first, second, out, share))


@app.command()
def export(
    source: Annotated[Path, typer.Argument(help="Folder of a run, or a checkpoint (.pt).")],
    out: Folder,
    name: Annotated[str, typer.Option(help="Name of the model.")],
    evaluation: Annotated[
        Path | None, typer.Option(help="JSON file to include in the card.")
    ] = None,
    credit: Credit = None,
    input_size: InputSize = "",
) -> None:
    """Export a network to ONNX with its card."""
    from cucumbervision.networks.yolo import parse_input_sizes
    from cucumbervision_lab.train.export import export_trained

    export_trained(
        source,
        out,
        name,
        evaluation=evaluation,
        credits=credit or (),
        input_sizes=parse_input_sizes(input_size),
    )
    show(*(out / f"{name}{suffix}" for suffix in (".onnx", ".md", ".json")))
