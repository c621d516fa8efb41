"""Model cards: what an exported network is, how it was trained, and how good it is."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

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
        What was trained, as in '50 epochs at 640 px'; empty if only the checkpoint is known.
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
        lines.append(f"- trained: {card.plan}")
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
