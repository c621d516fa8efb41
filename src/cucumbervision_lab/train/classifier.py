"""Train a small convolutional network on crops of pictures, and export it to ONNX."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision_lab.arrays import Pixels
from cucumbervision_lab.train.export import ModelCard, described, halve_storage
from cucumbervision_lab.train.network import allowed_threads, import_ultralytics, load_yolo

CHANNELS = 128
"""Channels of `first_layers`."""

LEARNT_FROM = "crops learnt from"
"""A metric of every card, which one that was only judged has not."""

_LAYERS = 7
_RATE, _WEIGHT_DECAY = 2e-3, 0.02  # of AdamW, with one cycle of the learning rate


@dataclass(frozen=True)
class ClassifierOptions:
    """Options of training.

    Parameters
    ----------
    epochs : int
        Number of passes over the training pictures.
    seed : int
        Random seed.
    batch : int
        Pictures of a step.
    keep : Path, optional
        Checkpoint (.pt) of each epoch, from which an interrupted training goes on.
    progress : callable, optional
        Called after each epoch with the epoch number (from 1) and the mean loss.
    """

    epochs: int = 20
    seed: int = 0
    batch: int = 128
    keep: Path | None = None
    progress: Callable[[int, float], None] | None = None


def first_layers(init: Path | str) -> list[Any]:
    """Load the first layers of YOLO26n, which give `CHANNELS` channels of a sixteenth of the size.

    With weights for other objects a network learns more from few pictures than with random ones.

    Parameters
    ----------
    init : Path
        Checkpoint (.pt) of YOLO26n, or an Ultralytics .yaml for random weights.

    Returns
    -------
    list of torch.nn.Module

    Raises
    ------
    ModelError, MissingExtraError
        As `load_yolo`.
    """
    return list(load_yolo(init).model.model)[:_LAYERS]


def begun_network(init: Path | str, make: Callable[[Path | str], Any]) -> Any:
    """Return a network with an earlier one's weights, or with the first layers of YOLO26n.

    Parameters
    ----------
    init : Path
        Checkpoint (.pt) of YOLO26n, or the weights of an earlier training of this network.
    make : callable
        Builds the network from what `first_layers` takes.
    """
    import torch

    try:
        state = torch.load(init, weights_only=True)
    except (pickle.UnpicklingError, OSError):  # YOLO's hold classes; load_yolo names what is wrong
        return make(init)
    network = make("yolo26n-seg.yaml")
    network.load_state_dict(state)
    return network


def fit(
    make: Callable[[], Any],
    count: int,
    loss_of: Callable[[Any, NDArray[np.intp]], Any],
    options: ClassifierOptions,
) -> Any:
    """Train a network.

    Parameters
    ----------
    make : callable
        Builds the network.
    count : int
        Number of samples to learn from.
    loss_of : callable
        Returns the network's loss on a batch, given as the indices of its samples.
    options : ClassifierOptions
        Options.

    Returns
    -------
    torch.nn.Module
        The network, ready to predict.

    Raises
    ------
    MissingExtraError
        If the extra `train` is not installed.
    """
    import_ultralytics()  # raises a clear error if the extra, and with it torch, is missing
    import torch

    torch.set_num_threads(allowed_threads())
    torch.manual_seed(options.seed)
    network = make()
    if options.epochs == 0:
        return network.eval()
    batches = count // options.batch + 1
    optimiser = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=_WEIGHT_DECAY)
    steps = options.epochs * batches
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, steps)
    parts = {"network": network, "optimiser": optimiser, "schedule": schedule}
    # What was kept belongs to this training alone: in a folder used again it may be another's.
    training = [count, options.epochs, options.seed, options.batch]
    for epoch in range(_resumed(parts, training, options.keep), options.epochs):
        network.train()
        order = np.random.default_rng([options.seed, epoch]).permutation(count)
        losses = []
        for chosen in np.array_split(order, batches):
            loss = loss_of(network, np.sort(chosen))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        if options.keep is not None:
            state = {name: part.state_dict() for name, part in parts.items()}
            torch.save({"epoch": epoch + 1, "training": training, **state}, options.keep)
        if options.progress is not None:
            options.progress(epoch + 1, float(np.mean(losses)))
    return network.eval()


def _resumed(parts: dict[str, Any], training: list[int], keep: Path | None) -> int:
    """Load what an interruption of the same training left; return the epoch to go on with."""
    import torch

    if keep is None or not keep.exists():
        return 0
    state = torch.load(keep, weights_only=True)
    if state.get("training") != training:
        return 0
    for name, part in parts.items():
        part.load_state_dict(state[name])
    return int(state["epoch"])


def scaled_planes(pictures: Pixels) -> Any:
    """Return pictures of shape (N, H, W, C) as a float32 tensor, (N, C, H, W) in 0 to 1."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).float() / 255


def changed_planes(
    crops: Any, strength: float, *, no_depth: float, side_px: int, shade: Any = 1.0
) -> Any:
    """Change the light of crops and their given mask, and take depth or parts of it away.

    Parameters
    ----------
    crops : torch.Tensor, shape (N, 6, H, W)
        Colour, depth relative to the fruit, whether depth was read, and mask, 0 to 1.
    strength : float
        Standard deviation of the changes of light, relative.
    no_depth : float
        Share of the crops without depth; of the others, 30 % have holes.
    side_px : int
        By how many pixels outlines grow or shrink, plus 1; an odd number.
    shade : torch.Tensor, optional
        Further factors of the brightness.
    """
    import torch
    from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

    count = len(crops)

    def chance(share: float) -> Any:
        return (torch.rand(count) < share)[:, None, None, None]

    def normal(spread: float, channels: int = 1) -> Any:
        return spread * torch.randn(count, channels, 1, 1)

    color, depth, read, mask = crops[:, :3], crops[:, 3:4], crops[:, 4:5], crops[:, 5:]
    gain = 1 + normal(strength) + normal(strength / 3, 3)
    shift = normal(strength / 5) + normal(strength / 13, 3)
    noise = strength / 6 * torch.rand(count, 1, 1, 1) * torch.randn_like(color)
    grey = color.mean(1, keepdim=True)
    color = torch.where(chance(0.25), avg_pool2d(color, 3, 1, 1), color)
    color = (grey + (1 + normal(0.3)) * (color - grey)).clamp(1e-3, 1) ** normal(strength).exp()
    color = (color * gain * shade + shift + noise).clamp(0, 1)
    wider = max_pool2d(mask, side_px, 1, side_px // 2)
    narrower = 1 - max_pool2d(1 - mask, side_px, 1, side_px // 2)
    mask = torch.where(chance(0.25), wider, torch.where(chance(0.25), narrower, mask))
    coarse = torch.rand(count, 1, 8, 8 * crops.shape[3] // crops.shape[2])
    holes = interpolate(coarse, size=crops.shape[2:], mode="bilinear") > 0.62
    lost = (chance(0.3) & holes) | chance(no_depth)
    read = torch.where(lost, torch.zeros_like(read), read)
    depth = torch.where(read < 0.5, torch.full_like(depth, 128 / 255), depth)
    return torch.cat([color, depth, read, mask], 1)


def export_network(
    network: Any, out: Path, inputs: Mapping[str, Any], outputs: Sequence[str], task: str
) -> None:
    """Export a network to ONNX, for any number of each input, and keep its weights beside it.

    The ONNX file holds them in half precision; from the others (.pt) a further training can begin.

    Parameters
    ----------
    network : torch.nn.Module
        The network.
    out : Path
        The file to write.
    inputs : mapping of str to torch.Tensor
        Name and an example of each input, in the network's order.
    outputs : sequence of str
        Names of the outputs.
    task : str
        Task to note in the file.
    """
    import onnx
    import torch

    out.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(inputs.values()),
            str(out),
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes={name: {0: "count"} for name in (*inputs, *outputs)},
            opset_version=17,
            dynamo=False,
        )
    written = onnx.load(out)
    halve_storage(written)
    onnx.helper.set_model_props(written, {"task": task})
    onnx.save(written, out)
    torch.save(network.state_dict(), out.with_suffix(".pt"))


@dataclass(frozen=True)
class Trained:
    """A network that was trained on crops of pictures, and how well it does.

    Parameters
    ----------
    network : Path
        The ONNX file.
    task : str
        'fruit' or 'look', as the command that trains it.
    limits : tuple of str
        Known limitations, one sentence each.
    metrics : mapping of str to float
        Metrics of the held-out scenes, as the card names them.
    """

    network: Path
    task: str
    limits: tuple[str, ...]
    metrics: Mapping[str, float]


def write_classifier_card(
    trained: Trained,
    name: str,
    init: Path | str,
    options: ClassifierOptions,
    credits: Sequence[str] = (),
) -> ModelCard:
    """Write the model card next to a network.

    Without epochs the checkpoint that it began with was judged, and nothing was learnt.
    """
    network, began = trained.network, Path(init)
    weights = network.with_suffix(".pt")
    checkpoint = weights if weights.exists() else network
    metrics = dict(trained.metrics)
    if not options.epochs:
        checkpoint = began
        metrics.pop(LEARNT_FROM, None)
    words = f"--init {began.name} --out DIR --epochs {options.epochs} --seed {options.seed}"
    return described(
        network,
        checkpoint,
        name=name,
        task=trained.task,
        began_with=began.name,
        command=f"cucumbervision train classifier {trained.task} SETS {words}",
        metrics=metrics,
        credits=credits,
        limits=trained.limits,
        versions={"torch": version("torch")},
    )
