"""Put an exported network into the package: its file, its card, its entry in the registry.

For maintainers, who then commit what changed.
"""

from __future__ import annotations

import json
import re
import shutil
from itertools import pairwise
from pathlib import Path

from cucumbervision.errors import ModelHashError, TrainingError
from cucumbervision.perception import registry
from cucumbervision.perception.registry import file_sha256, load_registry
from cucumbervision_lab.training.cards import ModelCard, read_card

__all__ = ["MOST_BYTES", "registry_entry", "ship", "with_entry"]

MOST_BYTES = 45_000_000
"""What all networks in the package may weigh together."""

_WHAT = {
    "segment": "YOLO26 for cucumbers: boxes and masks",
    "pose": "YOLO26 for cucumbers: boxes and five keypoints",
    "ends": "Which end of a cucumber is the stem's",
}
_FROM = {"ends": "CucumberVision"}
_ENTRY = re.compile(r"^\[\[models\]\]$", re.MULTILINE)


def ship(exported: Path, name: str, package: Path | None = None) -> tuple[Path, ...]:
    """Copy a network and its card into the package, and write its registry entry.

    Parameters
    ----------
    exported : Path
        Folder that `export_trained` wrote.
    name : str
        The network's name. One of that name in the package is replaced.
    package : Path, optional
        Folder of `models.toml` and `weights/`; the installed package's without it.

    Returns
    -------
    tuple of Path
        What was written.

    Raises
    ------
    ModelHashError
        If the file is not the one that its card tells of.
    TrainingError
        If the card cannot be read, the weights together would exceed `MOST_BYTES`, or the
        folder cannot be written.
    """
    card = read_card(exported / f"{name}.json")
    network = exported / card.file
    if not network.is_file() or file_sha256(network) != card.sha256:
        raise ModelHashError(
            "is not the file that its card tells of", source=network, remedy="export it again"
        )
    package = package or Path(registry.__file__).parent
    weights, toml = package / "weights", package / "models.toml"
    others = [p for p in weights.glob("*.onnx") if p.name != card.file]
    total = sum(p.stat().st_size for p in others) + card.size_bytes
    if total > MOST_BYTES:
        raise TrainingError(
            f"the package's weights would be {total / 1e6:.1f} MB together",
            source=network,
            remedy=f"stay under {MOST_BYTES / 1e6:.0f} MB: replace a network or ship a smaller one",
        )
    try:
        files = [network, exported / f"{name}.md", exported / f"{name}.json"]
        written = [Path(shutil.copyfile(file, weights / file.name)) for file in files]
        text = with_entry(toml.read_text(encoding="utf-8"), card)
        toml.write_text(text, encoding="utf-8")
    except OSError as error:
        raise TrainingError(
            f"cannot be written ({error})", source=package, remedy="ship from a source checkout"
        ) from error
    load_registry(toml).resolve(name)
    return (*written, toml)


def with_entry(toml: str, card: ModelCard) -> str:
    """Replace a network's entry in a registry's text, or add it; all else stays as it is."""
    starts = [match.start() for match in _ENTRY.finditer(toml)] + [len(toml)]
    head, blocks = toml[: starts[0]], [toml[a:b] for a, b in pairwise(starts)]
    own, line = registry_entry(card), f"name = {json.dumps(card.name)}"
    same = [k for k, block in enumerate(blocks) if line in block.splitlines()]
    if same:
        # The last entry ends the file, the others are parted by an empty line.
        blocks[same[0]] = own if same[0] == len(blocks) - 1 else f"{own}\n"
    else:
        blocks.append(f"\n{own}")
    return head + "".join(blocks)


def registry_entry(card: ModelCard) -> str:
    """Return a network's entry as `models.toml` has it.

    Examples
    --------
    >>> entry = registry_entry(ModelCard("c-seg", "segment", "c-seg.onnx", "ab", 5, "cd"))
    >>> entry.splitlines()[:3]
    ['[[models]]', 'name = "c-seg"', 'task = "segment"']
    """
    what = _WHAT[card.task]
    values = {
        "name": card.name,
        "task": card.task,
        "licence": card.licence,
        "title": what,
        "origin": _FROM.get(card.task, "CucumberVision, begun with Ultralytics' weights"),
        "card": f"{card.name}.md",
    }
    lines = ["[[models]]", *(f"{key} = {json.dumps(value)}" for key, value in values.items())]
    lines += ["embedded = true", "", "[[models.files]]", 'role = "network"']
    lines += [f"file = {json.dumps(card.file)}", f'sha256 = "{card.sha256}"']
    return "\n".join([*lines, f"size_bytes = {card.size_bytes}"]) + "\n"
