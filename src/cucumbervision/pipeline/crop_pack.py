"""Read a crop pack: the folder with profile and networks that `--profile FOLDER` names."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from cucumbervision.agronomy.profiles import PACK_PROFILE, CropProfile, load_profile
from cucumbervision.errors import ModelError, ModelHashError, wrap_os_errors
from cucumbervision.files import read_json
from cucumbervision.perception.registry import file_sha256

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.pipeline.options import MeasureOptions

TRUTH = "truth.csv"
"""Lengths measured by hand, as `evaluate lengths` reads them."""


@dataclass(frozen=True)
class CropPack:
    """A crop's folder.

    Parameters
    ----------
    profile : CropProfile
        The profile, from `profile.toml`.
    segment, pose : Path, optional
        Its networks, `NAME-seg.onnx` and `NAME-pose.onnx` as `train export` writes them; without
        them, those of the package are used.
    truth : Path, optional
        Its `truth.csv`, if there is one.
    """

    profile: CropProfile
    segment: Path | None = None
    pose: Path | None = None
    truth: Path | None = None

    def options(self, options: MeasureOptions) -> MeasureOptions:
        """Return options with the size limits, the cut and the networks of this crop.

        Instances and keypoints chosen by the user are kept.
        """
        has_segmenter = options.instances in ("auto", "models") and self.segment is not None
        return replace(
            options.for_crop(self.profile),
            instances=str(self.segment) if has_segmenter else options.instances,
            pose=options.pose or self.pose,
        )


def read_pack(folder: Path) -> CropPack:
    """Read a crop's folder.

    Raises
    ------
    ProfileError
        If `profile.toml` is missing or invalid.
    ModelError
        If there are two networks for one task.
    ModelHashError
        If a network does not match the card in the same folder.
    """
    profile = load_profile(folder / PACK_PROFILE)
    truth = folder / TRUTH
    segment, pose = (_network(folder, task) for task in ("seg", "pose"))
    return CropPack(profile, segment, pose, truth if truth.is_file() else None)


def _network(folder: Path, task: str) -> Path | None:
    paths = sorted(folder.glob(f"*-{task}.onnx"))
    if len(paths) > 1:
        raise ModelError(
            f"holds {len(paths)} networks *-{task}.onnx", source=folder, remedy="keep one"
        )
    for path in paths:
        card = path.with_suffix(".json")
        content = read_json(card, ModelError) if card.is_file() else {}
        with wrap_os_errors("cannot be read", path, "put the network's file there", ModelError):
            sha256 = file_sha256(path)
        if isinstance(content, dict) and content.get("sha256") not in (None, sha256):
            raise ModelHashError(
                f"is not the network that {card.name} describes",
                source=path,
                remedy="export both again with `cucumbervision train export`",
            )
    return paths[0] if paths else None
