"""Model cards, and adding an exported network to the package."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from cucumbervision.errors import ModelHashError, TrainingError
from cucumbervision.files import parse_model, read_json
from cucumbervision.perception import registry
from cucumbervision.perception.registry import file_sha256, load_registry

_LICENCE = "AGPL-3.0-only"

_WHAT = {
    "segment": "YOLO26, task segment, one class (cucumber).",
    "pose": "YOLO26, task pose, one class (cucumber), five keypoints. They run from a fruit's "
    "lower left end to its upper right one where the file's metadata say `keypoint_order: place`, "
    "and `cucumber-fruit` tells which is the stem's; else from the blossom end to the stem end.",
    "fruit": "Draws the outline and five keypoints of one detected cucumber at the camera's "
    "resolution, from colour, depth and the detector's mask around it, turned along the mask; and "
    "tells whether it is a cucumber and which end is the stem's.",
    "look": "Looks at each end of a measured cucumber, from the picture, the depth and the mask "
    "around it, turned along the fruit: whether the fruit ends there, goes on behind something or "
    "stops before, how much of its length may be missing, and whether it is the stem end.",
}

MAKERS = ("Network and its first weights: Ultralytics YOLO26, AGPL-3.0",)
"""Credits of every card."""

_LIMITS = (
    "One class. Zucchini may count as cucumbers; other long fruit, leaves and stems should not, "
    "but sometimes will.",
    "Trained for fruit at 0.3 to 1.2 m; small, far or mostly hidden fruit are missed more often.",
    "Fruit that overlap may be given one mask, and one hidden in its middle two boxes.",
    "Stored in half precision and computed in full; not quantised to 8 bits, since what that "
    "costs was not measured.",
)


@dataclass(frozen=True)
class ModelCard:
    """Description of an exported network.

    Parameters
    ----------
    name : str
        Name of the model in commands.
    task : str
        'segment', 'pose', 'fruit' or 'look'.
    file : str
        Name of the ONNX file.
    sha256 : str
        SHA-256 of the ONNX file.
    size_bytes : int
        Size of the ONNX file.
    checkpoint_sha256 : str
        SHA-256 of the exported checkpoint.
    began_with : str
        Initial weights of the training.
    plan : str
        Training plan, as in '320x8,640x2'; empty if only the checkpoint is known.
    command : str
        Training command, without local paths.
    metrics : mapping of str to float
        Validation metrics of the exported epoch.
    evaluation : mapping
        Results of a separate evaluation, including its command.
    data : str
        Card of the data set, in Markdown.
    licence : str
        SPDX identifier.
    credits, limits : tuple of str
        Credits and known limitations, one sentence each.
    versions : mapping of str to str
        Versions of torch and Ultralytics.
    """

    name: str
    task: str
    file: str
    sha256: str
    size_bytes: int
    checkpoint_sha256: str
    began_with: str = ""
    plan: str = ""
    command: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)
    evaluation: Mapping[str, Any] = field(default_factory=dict)
    data: str = ""
    licence: str = _LICENCE
    credits: tuple[str, ...] = MAKERS
    limits: tuple[str, ...] = _LIMITS
    versions: Mapping[str, str] = field(default_factory=dict)


def write_card(card: ModelCard, out: Path) -> tuple[Path, Path]:
    """Write a card as Markdown (.md) and JSON (.json).

    Parameters
    ----------
    card : ModelCard
        The card; metrics that are not finite are omitted.
    out : Path
        Folder; the files are named after the network.

    Returns
    -------
    tuple of Path
        The Markdown file and the JSON file.
    """
    out.mkdir(parents=True, exist_ok=True)
    metrics = {name: value for name, value in card.metrics.items() if math.isfinite(value)}
    card = replace(card, metrics=metrics)
    page, record = out / f"{card.name}.md", out / f"{card.name}.json"
    page.write_text(card_markdown(card), encoding="utf-8")
    text = json.dumps(asdict(card), indent=2, ensure_ascii=False, allow_nan=False)
    record.write_text(text + "\n", encoding="utf-8")
    return page, record


def read_card(path: Path) -> ModelCard:
    """Read a card from its JSON file.

    Raises
    ------
    TrainingError
        If the file cannot be read or is invalid.
    """
    values = read_json(path, TrainingError, "export the network again")
    card = parse_model(
        ModelCard, values, source=path, error=TrainingError, remedy="export the network again"
    )
    fault = "" if card.task in _WHAT else f"unknown task {card.task!r}"
    if not 0 < card.size_bytes < _TOO_LARGE:
        fault = "size_bytes is out of range"
    if fault:
        raise TrainingError(fault, source=path, remedy="export the network again")
    return card


def card_markdown(card: ModelCard) -> str:
    """Return a card as Markdown.

    Examples
    --------
    >>> print(card_markdown(ModelCard("c-seg", "segment", "c-seg.onnx", "ab", 5, "cd"))[:9])
    # c-seg
    """
    lines = [
        f"# {card.name}",
        "",
        _WHAT[card.task],
        "",
        f"- file: `{card.file}`, {card.size_bytes / 1e6:.2f} MB, SHA-256 `{card.sha256}`",
        f"- exported from a checkpoint with SHA-256 `{card.checkpoint_sha256}`",
        f"- licence: {card.licence}",
    ]
    if card.began_with:
        lines.append(f"- began with: `{card.began_with}`")
    if card.plan:
        lines.append(f"- plan (pixels x pictures): {card.plan}")
    lines += [f"- {name} {version}" for name, version in card.versions.items()]
    if card.metrics:
        lines += ["", "## Figures", "", "On the validation pictures, by:", ""]
        lines += ["```", card.command, "```", "", *_table(card.metrics)]
    if card.evaluation:
        text = json.dumps(card.evaluation, indent=2, ensure_ascii=False)
        lines += ["", "## Evaluation", "", "```json", text, "```"]
    lines += ["", "## Limits", "", *(f"- {limit}" for limit in card.limits)]
    lines += ["", "## Credits", "", *(f"- {credit}" for credit in card.credits)]
    if card.data:
        # Headings of the data card become one level lower.
        data = [f"#{line}" if line.startswith("#") else line for line in card.data.splitlines()]
        lines += ["", *data]
    return "\n".join(lines).rstrip() + "\n"


def _table(metrics: Mapping[str, float]) -> list[str]:
    rows = [f"| {name} | {value:g} |" for name, value in metrics.items()]
    return ["| figure | value |", "|---|--:|", *rows]


_TOO_LARGE = 2**40
MOST_BYTES = 45_000_000
"""Maximum total size of the packaged networks."""

_TITLES = {
    "segment": "YOLO26 for cucumbers: boxes and masks",
    "pose": "YOLO26 for cucumbers: boxes and five keypoints",
    "fruit": "Outline and keypoints of one cucumber at the camera's resolution",
    "look": "Whether a cucumber ends where it was measured to",
}

_ENTRY = re.compile(r"^\[\[models\]\]$", re.MULTILINE)


def publish(exported: Path, name: str, package: Path | None = None) -> tuple[Path, ...]:
    """Copy an exported network and its card into the package, and update the registry.

    Parameters
    ----------
    exported : Path
        Folder written by `export_trained`.
    name : str
        Name of the network; a packaged network with this name is replaced.
    package : Path, optional
        Folder of `models.toml` and `weights/`; by default that of the installed package.

    Returns
    -------
    tuple of Path
        The written files.

    Raises
    ------
    ModelHashError
        If the network's hash differs from its card.
    TrainingError
        If the card cannot be read, the total size would exceed `MOST_BYTES`, or the folder is
        not writable.
    """
    card = read_card(exported / f"{name}.json")
    network = exported / card.file
    if not network.is_file() or file_sha256(network) != card.sha256:
        raise ModelHashError(
            "does not match the hash in its card", source=network, remedy="export it again"
        )
    package = package or Path(registry.__file__).parent
    weights, toml = package / "weights", package / "models.toml"
    other_networks = [p for p in weights.glob("*.onnx") if p.name != card.file]
    total = sum(p.stat().st_size for p in other_networks) + card.size_bytes
    if total > MOST_BYTES:
        raise TrainingError(
            f"the packaged weights would take {total / 1e6:.1f} MB in total",
            source=network,
            remedy=f"publish a smaller network; the limit is {MOST_BYTES / 1e6:.0f} MB",
        )
    try:
        files = [network, exported / f"{name}.md", exported / f"{name}.json"]
        written = [Path(shutil.copyfile(file, weights / file.name)) for file in files]
        text = with_entry(toml.read_text(encoding="utf-8"), card)
        toml.write_text(text, encoding="utf-8")
    except OSError as error:
        raise TrainingError(
            f"cannot be written ({error})", source=package, remedy="publish from a source checkout"
        ) from error
    load_registry(toml).resolve(name)
    return (*written, toml)


def with_entry(toml: str, card: ModelCard) -> str:
    """Return the text of `models.toml` with the network's entry added or replaced."""
    starts = [match.start() for match in _ENTRY.finditer(toml)] + [len(toml)]
    head, blocks = toml[: starts[0]], [toml[a:b] for a, b in pairwise(starts)]
    entry, line = registry_entry(card), f"name = {json.dumps(card.name)}"
    same = [k for k, block in enumerate(blocks) if line in block.splitlines()]
    if same:
        # Entries are separated by an empty line; the last one ends the file.
        blocks[same[0]] = entry if same[0] == len(blocks) - 1 else f"{entry}\n"
    else:
        blocks.append(f"\n{entry}")
    return head + "".join(blocks)


def registry_entry(card: ModelCard) -> str:
    """Return a network's entry for `models.toml`.

    Examples
    --------
    >>> entry = registry_entry(ModelCard("c-seg", "segment", "c-seg.onnx", "ab", 5, "cd"))
    >>> entry.splitlines()[:3]
    ['[[models]]', 'name = "c-seg"', 'task = "segment"']
    """
    what = _TITLES[card.task]
    values = {
        "name": card.name,
        "task": card.task,
        "licence": card.licence,
        "title": what,
        "origin": "CucumberVision, begun with Ultralytics' weights",
        "card": f"{card.name}.md",
    }
    lines = ["[[models]]", *(f"{key} = {json.dumps(value)}" for key, value in values.items())]
    lines += ["embedded = true", "", "[[models.files]]", 'role = "network"']
    lines += [f"file = {json.dumps(card.file)}", f'sha256 = "{card.sha256}"']
    return "\n".join([*lines, f"size_bytes = {card.size_bytes}"]) + "\n"
