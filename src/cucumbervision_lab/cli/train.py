"""`cucumbervision train`: train and export networks."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import InputSize

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision_lab.training.classifier import Trained
    from cucumbervision_lab.training.end_crops import EndCrops
    from cucumbervision_lab.training.measured_ends import MeasuredFruit

app = typer.Typer(
    name="train",
    help="Train networks on labelled pictures and export them (requires the extra 'train').",
    no_args_is_help=True,
)

Data = Annotated[Path | None, typer.Argument(help="Folder or data.yaml of a data set.")]
Out = Annotated[Path, typer.Option("--out", help="Folder of the run.", metavar="RUN")]
Init = Annotated[
    str | None,
    typer.Option("--init", help="Initial weights (.pt), or an Ultralytics .yaml."),
]
Plan = Annotated[
    str | None, typer.Option("--plan", help="Size x pictures, as in 448x80000,640x20000.")
]
PerEpoch = Annotated[
    int, typer.Option("--per-epoch", min=1, help="Pictures between two checkpoints.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Resume RUN; a longer --plan extends it.")]
Batch = Annotated[
    int, typer.Option("--batch", min=0, help="Batch size; 0: 8 on the CPU, 64 on a GPU.")
]
Device = Annotated[str, typer.Option("--device", help="auto, cpu or a CUDA device number.")]
Seed = Annotated[int, typer.Option("--seed", help="Random seed.")]
Rate = Annotated[float, typer.Option("--learning-rate", min=0, help="Initial learning rate.")]
Folder = Annotated[Path, typer.Option("--out", help="Folder to write into.", metavar="DIR")]
Credit = Annotated[
    list[str] | None, typer.Option("--credit", help="Credit for the card; repeatable.")
]


def _threads() -> int:
    """Return OMP_NUM_THREADS, or the number of cores; Ultralytics would set it to 1."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) else os.cpu_count() or 1


@app.command()
def network(
    task: Annotated[
        str, typer.Argument(help="seg: boxes and masks; pose: boxes and the five keypoints.")
    ],
    out: Out,
    data: Data = None,
    init: Init = None,
    plan: Plan = None,
    per_epoch: PerEpoch = 500,
    resume: Resume = False,
    batch: Batch = 0,
    device: Device = "auto",
    seed: Seed = 0,
    learning_rate: Rate = 0.001,
) -> None:
    """Train a detector: boxes with masks, or with keypoints."""
    from cucumbervision_lab.cli.screen import TrainConsole
    from cucumbervision_lab.training.settings import TrainOptions
    from cucumbervision_lab.training.train import train

    options = TrainOptions(
        batch=batch,
        device=device,
        seed=seed,
        threads=_threads(),
        learning_rate=learning_rate,
    )
    if task not in ("seg", "pose"):
        raise typer.BadParameter("give seg or pose", param_hint="TASK")
    with TrainConsole() as console:
        trained = train(
            task,
            data,
            out,
            init=init,
            plan=plan,
            per_epoch=per_epoch,
            resume=resume,
            options=options,
            callbacks=console,
        )
    console.close(trained)


@app.command()
def recipe(
    data: Annotated[Path, typer.Option("--data", help="Folder of the pictures.", metavar="DIR")],
    out: Out,
    recipe_file: Annotated[
        Path | None, typer.Option("--recipe", help="TOML file; default: the packaged recipe.")
    ] = None,
    weights: Annotated[
        Path, typer.Option("--weights", help="Folder of the initial weights.")
    ] = Path("checkpoints"),
    test: Annotated[
        Path | None, typer.Option("--test", help="Synthetic set to evaluate for the curve.")
    ] = None,
    only: Annotated[str, typer.Option("--only", help="seg or pose; default: both.")] = "",
    batch: Batch = 0,
    device: Device = "auto",
) -> None:
    """Train the networks from a recipe of picture sources and schedules.

    Rerun the command to resume.
    """
    from cucumbervision_lab.cli.screen import TrainConsole
    from cucumbervision_lab.training.recipe import read_recipe
    from cucumbervision_lab.training.run_recipe import PACKAGED, RecipeFolders, run_recipe
    from cucumbervision_lab.training.settings import TrainOptions

    read = read_recipe(recipe_file or PACKAGED)
    options = TrainOptions(
        batch=batch,
        device=device,
        threads=_threads(),
    )
    with TrainConsole() as console:
        networks = run_recipe(
            read,
            RecipeFolders(data, weights, out, test),
            tasks=(only,) if only else tuple(read.schedules),
            options=options,
            callbacks=console,
            workers=os.cpu_count() or 1,
            log=console.log,
        )
    for network in networks.values():
        console.close(network)


@app.command()
def house(
    data: Annotated[Path, typer.Argument(help="Data set from `data from-store`.", metavar="SET")],
    out: Out,
    photos: Annotated[
        Path | None,
        typer.Option(
            "--data",
            help="Folder of the recipe's photos; without it, only synthetic frames are mixed in.",
            metavar="PHOTOS",
        ),
    ] = None,
    init: Annotated[Path, typer.Option("--init", help="Initial weights.")] = Path(
        "checkpoints/cucumber-seg.pt"
    ),
    plan: Annotated[str, typer.Option("--plan", help="Size x pictures.")] = "640x6000",
    learning_rate: Rate = 0.0003,
    per_epoch: PerEpoch = 200,
    share: Annotated[
        float, typer.Option("--share", min=0.05, max=0.95, help="Share of greenhouse pictures.")
    ] = 0.5,
    batch: Batch = 0,
    device: Device = "auto",
) -> None:
    """Fine-tune the detector on pictures of your greenhouse, and compare it with the one in use.

    Rerun the command to resume. `models use RUN` then switches to the new detector.
    """
    from cucumbervision_lab.cli.screen import TrainConsole, show
    from cucumbervision_lab.training.house import HousePlan, train_house
    from cucumbervision_lab.training.settings import TrainOptions

    with TrainConsole() as console:
        judged = train_house(
            data,
            out,
            photos=photos,
            init=init,
            plan=HousePlan(plan, share, per_epoch=per_epoch, learning_rate=learning_rate),
            options=TrainOptions(
                batch=batch,
                device=device,
                threads=_threads(),
            ),
            callbacks=console,
            workers=os.cpu_count() or 1,
            log=console.log,
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
        str,
        typer.Option(
            "--init",
            help="Weights of YOLO26n-seg (.pt), or of an earlier training (.pt).",
        ),
    ],
    name: Annotated[
        str | None,
        typer.Option("--name", help="The network's name.", show_default="cucumber-KIND"),
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
            "--leaves",
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
    From the held-out fruit it learns the intervals by what the network says of their ends.
    """
    name = name or f"cucumber-{kind}"
    out.mkdir(parents=True, exist_ok=True)
    if epochs is None:
        epochs = 8 if kind is SmallNetwork.LOOK else 20
    if leaves is not None and kind is not SmallNetwork.LOOK:
        raise typer.BadParameter("is for look only", param_hint="--leaves")
    further: dict[str, int] = {}
    trained: Trained
    if kind is SmallNetwork.LOOK:
        trained, further = _train_look(sets, out, name, init, epochs, seed, leaves)
    else:
        trained = _train_fruit(sets, out / f"{name}.onnx", init, epochs, seed)
    _finish(trained, name, init, epochs=epochs, seed=seed, credits=credit or (), **further)


def _train_fruit(sets: Sequence[Path], file: Path, init: str, epochs: int, seed: int) -> Trained:
    from cucumbervision_lab.cli.screen import ticking
    from cucumbervision_lab.datasets.checks import open_dataset
    from cucumbervision_lab.training.classifier import ClassifierOptions
    from cucumbervision_lab.training.fruit_crops import collect_sets
    from cucumbervision_lab.training.fruit_look import train_fruit

    opened = [open_dataset(folder) for folder in sets]
    with ticking("cutting out", sum(len(dataset.pictures) for dataset in opened)) as tick:
        crops = collect_sets(opened, file.with_name(f"{file.stem}-crops"), tick)
    with ticking("training", epochs) as tick:
        options = ClassifierOptions(
            epochs,
            seed,
            _threads(),
            batch=48,
            keep=file.with_name(f"{file.stem}-training.pt"),
            progress=lambda *_: tick(1),
        )
        return train_fruit(crops, init, file, options)


def _collect_ends(
    sets: Sequence[Path], out: Path, seed: int, leaves: Path | None
) -> list[tuple[list[MeasuredFruit], EndCrops]]:
    """Measure the fruit of drawn sets and cut out their ends; what was done stays in the folder."""
    from cucumbervision_lab.cli.screen import ticking
    from cucumbervision_lab.datasets.checks import open_dataset
    from cucumbervision_lab.synthesis.covers import read_pieces
    from cucumbervision_lab.training.end_crops import collect_set

    pieces = () if leaves is None else read_pieces(leaves)
    parts = []
    for number, folder in enumerate(sets):
        opened = open_dataset(folder)
        with ticking("measuring ends", len(opened.pictures)) as tick:
            keep = out / f"ends-{number}.jsonl"
            parts.append(collect_set(opened, keep, seed, tick, pieces))
    return parts


def _finish(
    trained: Trained,
    name: str,
    init: str,
    *,
    epochs: int,
    seed: int,
    credits: Sequence[str],
    **further: int,
) -> None:
    """Write a network's card and print its metrics."""
    from rich.console import Console
    from rich.table import Table

    from cucumbervision_lab.training.classifier import write_classifier_card

    write_classifier_card(trained, name, init, epochs=epochs, seed=seed, credits=credits)
    table = Table("held-out scenes", "", title=str(trained.network))
    for words, value in {**trained.metrics, **further}.items():
        table.add_row(words, f"{value:.4g}")
    Console(highlight=False).print(table)


def _train_look(
    sets: Sequence[Path],
    out: Path,
    name: str,
    init: str,
    epochs: int,
    seed: int,
    leaves: Path | None,
) -> tuple[Trained, dict[str, int]]:
    """Train the look at ends and fit its intervals; also return how many fruit are behind them."""
    from cucumbervision.measurement.intervals import shipped_interval_models
    from cucumbervision.perception.end_look import EndLooker
    from cucumbervision_lab.benchmark.interval_fit import write_interval_models
    from cucumbervision_lab.cli.screen import ticking
    from cucumbervision_lab.training.classifier import ClassifierOptions
    from cucumbervision_lab.training.end_crops import EndCrops
    from cucumbervision_lab.training.end_look import train_look
    from cucumbervision_lab.training.look_intervals import (
        LEAST_FRUIT,
        fit_look_intervals,
        looked_fruit,
        with_look_intervals,
    )

    parts = _collect_ends(sets, out, seed, leaves)
    with ticking("training", epochs) as tick:
        options = ClassifierOptions(
            epochs,
            seed,
            _threads(),
            batch=96,
            keep=out / f"{name}-training.pt",
            progress=lambda *_: tick(1),
        )
        crops = EndCrops.joined([part for _, part in parts])
        result = train_look(crops, init, out / f"{name}.onnx", options)
    measured = [measurement for fruit, _ in parts for measurement in fruit]
    chosen, looks = looked_fruit(measured, crops, EndLooker(result.network).look)
    if len(chosen) >= LEAST_FRUIT:
        models = fit_look_intervals(chosen, looks)
        book = with_look_intervals(shipped_interval_models(), models)
        write_interval_models(out / "interval_models.json", book)
    return result, {"fruit behind the intervals": len(chosen)}


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
    share: Annotated[float, typer.Option("--share", help="Weight of SECOND, 0 to 1.")] = 0.5,
) -> None:
    """Average two checkpoints, which reduces forgetting after fine-tuning."""
    from cucumbervision_lab.cli.screen import show
    from cucumbervision_lab.training.checkpoint import average_networks

    show(average_networks(first, second, out, share))


@app.command()
def export(
    source: Annotated[Path, typer.Argument(help="Folder of a run, or a checkpoint (.pt).")],
    out: Folder,
    name: Annotated[str, typer.Option("--name", help="Name of the model.")],
    evaluation: Annotated[
        Path | None, typer.Option("--evaluation", help="JSON file to include in the card.")
    ] = None,
    credit: Credit = None,
    input_size: InputSize = "",
) -> None:
    """Export a network to ONNX with its card, and print its registry entry."""
    from cucumbervision.perception.input_sizes import parse_input_sizes
    from cucumbervision_lab.cli.screen import show
    from cucumbervision_lab.training.export import export_trained
    from cucumbervision_lab.training.publish import registry_entry

    card = export_trained(
        source,
        out,
        name,
        evaluation=evaluation,
        credits=credit or (),
        input_sizes=parse_input_sizes(input_size),
    )
    show(*(out / f"{name}{suffix}" for suffix in (".onnx", ".md", ".json")))
    show(f"\n{registry_entry(card)}")


@app.command(hidden=True)
def publish(
    exported: Annotated[Path, typer.Argument(help="Folder written by `train export`.")],
    name: Annotated[str, typer.Option("--name", help="The network's name.")],
) -> None:
    """Add an exported network to the package (for maintainers)."""
    from cucumbervision_lab.cli.screen import show
    from cucumbervision_lab.training import publish as publishing

    show(*publishing.publish(exported, name))
