"""`cucumbervision train` and `models pull`: train networks, export them, and fetch one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import InputSize

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
Plan = Annotated[
    str | None, typer.Option("--plan", help="Sizes and pictures, as in 448x80000,640x20000.")
]
PerEpoch = Annotated[
    int, typer.Option("--per-epoch", min=1, help="Pictures between two checkpoints.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with RUN; a longer --plan prolongs.")]
Batch = Annotated[
    int, typer.Option("--batch", min=0, help="Pictures at a time; 0: 8, on a card 64.")
]
Device = Annotated[str, typer.Option("--device", help="auto, cpu, or a CUDA card's number.")]
Precision = Annotated[str, typer.Option("--precision", help="auto, f32 or bf16 (on the CPU).")]
Seed = Annotated[int, typer.Option("--seed", help="Of the random numbers.")]
Threads = Annotated[int, typer.Option("--threads", min=0, help="0: as many as cores.")]
Workers = Annotated[int, typer.Option("--workers", min=0, help="Processes that load.")]
Minutes = Annotated[
    float | None, typer.Option("--minutes", min=0, help="End after the epoch that passes this.")
]
Rate = Annotated[float, typer.Option("--learning-rate", min=0, help="At the beginning.")]


@app.command("pose", help="Train boxes and the five keypoints.")
@app.command("seg", help="Train boxes and masks.")
def network(
    context: typer.Context,
    out: Out,
    data: Data = None,
    init: Init = None,
    plan: Plan = None,
    per_epoch: PerEpoch = 500,
    resume: Resume = False,
    batch: Batch = 0,
    device: Device = "auto",
    precision: Precision = "auto",
    seed: Seed = 0,
    threads: Threads = 0,
    workers: Workers = 0,
    minutes: Minutes = None,
    learning_rate: Rate = 0.001,
) -> None:
    """Train a network for the task that the command is called by."""
    from cucumbervision_lab.cli.screen import TrainConsole
    from cucumbervision_lab.training.settings import TrainOptions
    from cucumbervision_lab.training.train import train

    options = TrainOptions(
        batch=batch,
        device=device,
        precision=precision,
        seed=seed,
        threads=threads,
        workers=workers,
        minutes=minutes,
        learning_rate=learning_rate,
    )
    task = str(context.info_name)
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
    data: Annotated[Path, typer.Option("--data", help="The folder of pictures.", metavar="DIR")],
    out: Out,
    recipe_file: Annotated[
        Path | None, typer.Option("--recipe", help="A TOML file; else the package's own.")
    ] = None,
    weights: Annotated[
        Path, typer.Option("--weights", help="Folder of the weights to go on from.")
    ] = Path("checkpoints"),
    test: Annotated[
        Path | None, typer.Option("--test", help="A drawn set to judge the curve by, too.")
    ] = None,
    only: Annotated[str, typer.Option("--only", help="seg or pose; else both.")] = "",
    batch: Batch = 0,
    device: Device = "auto",
    precision: Precision = "auto",
    threads: Threads = 0,
    workers: Workers = 0,
    minutes: Minutes = None,
) -> None:
    """Train both networks by one recipe: the pictures, the mixture, the plans and the curve.

    The same command goes on after any interruption.
    """
    from cucumbervision_lab.cli.screen import TrainConsole
    from cucumbervision_lab.training.recipe import read_recipe
    from cucumbervision_lab.training.run_recipe import PACKAGED, RecipeFolders, run_recipe
    from cucumbervision_lab.training.settings import TrainOptions

    read = read_recipe(recipe_file or PACKAGED)
    options = TrainOptions(
        batch=batch,
        device=device,
        precision=precision,
        threads=threads,
        workers=workers,
        minutes=minutes,
    )
    with TrainConsole() as console:
        found = run_recipe(
            read,
            RecipeFolders(data, weights, out, test),
            tasks=(only,) if only else tuple(read.schedules),
            options=options,
            callbacks=console,
            workers=os.cpu_count() or 1,
            log=console.say,
        )
    for network in found.values():
        console.close(network)


@app.command()
def house(
    data: Annotated[Path, typer.Argument(help="A set of `data from-store`.", metavar="SET")],
    out: Out,
    photos: Annotated[
        Path | None,
        typer.Option(
            "--data",
            help="The folder of photos of the shipped mixture; else only drawn frames of it.",
            metavar="PHOTOS",
        ),
    ] = None,
    init: Annotated[
        Path, typer.Option("--init", help="The weights to begin with: the shipped ones.")
    ] = Path("checkpoints/cucumber-seg.pt"),
    plan: Annotated[str, typer.Option("--plan", help="Sizes and pictures.")] = "640x6000",
    learning_rate: Rate = 0.0003,
    per_epoch: PerEpoch = 200,
    share: Annotated[
        float, typer.Option("--share", min=0.05, max=0.95, help="Of pictures: the house's.")
    ] = 0.5,
    batch: Batch = 0,
    device: Device = "auto",
    precision: Precision = "auto",
    threads: Threads = 0,
    workers: Workers = 0,
    minutes: Minutes = None,
) -> None:
    """Train the detector on with a house's own pictures, and judge it against the one in use.

    The same command goes on after any interruption. `models use RUN` then switches.
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
                precision=precision,
                threads=threads,
                workers=workers,
                minutes=minutes,
            ),
            callbacks=console,
            workers=os.cpu_count() or 1,
            log=console.say,
        )
    if judged is None:
        show(f"The plan is not through yet: give the same command again, and {out} goes on")
        return
    show(judged.with_suffix(".md").read_text(encoding="utf-8"))
    show(f"To use it: cucumbervision models use {out}")


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
    from rich.console import Console
    from rich.table import Table

    from cucumbervision_lab.cli.screen import ticking
    from cucumbervision_lab.datasets.checks import open_dataset
    from cucumbervision_lab.training.ends import collect_strips, train_ends, write_ends_card

    opened = [open_dataset(folder) for folder in sets]
    with ticking("cutting", sum(len(one.pictures) for one in opened)) as tick:
        strips = collect_strips(opened, seed, tick)
    with ticking("learning", epochs) as tick:
        result = train_ends(
            strips,
            out / f"{name}.onnx",
            epochs=epochs,
            seed=seed,
            threads=threads,
            progress=lambda *_: tick(1),
        )
    write_ends_card(result, name, epochs=epochs, seed=seed, credits=credit or ())
    table = Table("fruit of scenes not learnt from", "ends identified", title=str(result.network))
    for kind, share in result.accuracy.items():
        table.add_row(kind, f"{100 * share:.1f} %")
    sure = f"those at least 90 % sure ({100 * result.confident_share:.0f} % of all)"
    table.add_row(sure, f"{100 * result.confident_accuracy:.1f} %")
    Console(highlight=False).print(table)


@app.command()
def average(
    first: Annotated[Path, typer.Argument(help="A checkpoint (.pt).", metavar="FIRST")],
    second: Annotated[
        Path, typer.Argument(help="One trained on from it, or from the same.", metavar="SECOND")
    ],
    out: Annotated[Path, typer.Option("--out", help="The checkpoint to write.", metavar="FILE")],
    share: Annotated[float, typer.Option("--share", help="Of the second, 0 to 1.")] = 0.5,
) -> None:
    """Write the mean of two checkpoints: what the first knew fades less."""
    from cucumbervision_lab.cli.screen import show
    from cucumbervision_lab.training.checkpoint import average_networks

    show(average_networks(first, second, out, share))


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
    input_size: InputSize = "",
) -> None:
    """Write the ONNX file and its card, and show its entry for the registry."""
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
    exported: Annotated[Path, typer.Argument(help="Folder that `train export` wrote.")],
    name: Annotated[str, typer.Option("--name", help="The network's name.")],
) -> None:
    """Put an exported network into the package (for maintainers)."""
    from cucumbervision_lab.cli.screen import show
    from cucumbervision_lab.training import publish as publishing

    show(*publishing.publish(exported, name))


@app.command("depth-vote", hidden=True)
def depth_vote(
    data: Annotated[Path, typer.Argument(help="A set of `synth` with depth.", metavar="SET")],
    out: Annotated[Path, typer.Option("--out", help="JSON file to write.", metavar="FILE")],
) -> None:
    """Learn how much depth counts when a detection is judged (for maintainers)."""
    from cucumbervision_lab.cli.screen import show, ticking
    from cucumbervision_lab.datasets.checks import open_dataset
    from cucumbervision_lab.detection.learn_depth_vote import learn_depth_vote

    with ticking("detecting", len(open_dataset(data).pictures)) as tick:
        fit = learn_depth_vote(data, out, tick)
    show(
        f"{fit.fruit} fruit and {fit.others} other detections; log loss in scenes left out "
        f"{fit.log_loss:.3f}, by the detector's confidence alone {fit.log_loss_without:.3f}"
    )


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
