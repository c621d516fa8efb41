from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cucumbervision_lab.data.labels import DataSet
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate
from cucumbervision_lab.train.network import TrainOptions

SIDE_PX = 96


def write_set(folder: Path, task: str, pictures: int = 8, names: str = "[cucumber]") -> Path:
    """Draw green bars on noise, two pictures for validation, and label them; give data.yaml."""
    import cv2

    for k in range(pictures):
        rng = np.random.default_rng(k)
        split = "val" if k < 2 else "train"
        scene = rng.integers(0, 255, (5, 5, 3)).astype(np.uint8)
        color = cv2.resize(scene, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_CUBIC)
        turn = np.deg2rad(rng.uniform(0, 180))
        along = np.array([np.cos(turn), np.sin(turn)])
        across = np.array([-along[1], along[0]])
        centre = rng.uniform(40, 56, 2)
        # Six corners: a rectangle would be read as an oriented box.
        ends = ((30, 8), (34, 0), (30, -8), (-30, -8), (-34, 0), (-30, 8))
        bar = centre + np.array([u * along + v * across for u, v in ends])
        cv2.fillPoly(color, [bar.round().astype(np.int32)], (40, 160, 60))
        if task == "segment":
            row = "0 " + " ".join(f"{v:.6f}" for v in (bar / SIDE_PX).ravel())
        else:
            low, high = bar.min(axis=0) / SIDE_PX, bar.max(axis=0) / SIDE_PX
            points = (centre + np.linspace(-28, 28, 5)[:, None] * along) / SIDE_PX
            box = " ".join(f"{v:.6f}" for v in [*(low + high) / 2, *(high - low)])
            row = f"0 {box} " + " ".join(f"{x:.6f} {y:.6f} 2" for x, y in points)
        for kind in ("images", "labels"):
            (folder / kind / split).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "images" / split / f"{k}.png"), color)
        (folder / "labels" / split / f"{k}.txt").write_text(row + "\n")
    shape = "kpt_shape: [5, 3]\n" if task == "pose" else ""
    path = folder / "data.yaml"
    path.write_text(f"path: .\ntrain: images/train\nval: images/val\nnames: {names}\n{shape}")
    return path


@pytest.fixture(scope="session")
def seg_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("seg"), "segment")


@pytest.fixture(scope="session")
def pose_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("pose"), "pose")


QUICK = TrainOptions(epochs=2, size_px=64, batch=4, device="cpu")


@pytest.fixture(scope="session")
def seg_run(seg_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from cucumbervision_lab.train.network import open_sets, train

    run = tmp_path_factory.mktemp("run") / "seg"
    train("seg", open_sets([seg_set.parent]), run, "yolo26n-seg.yaml", QUICK)
    return run


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    """Four hard frames of hanging fruit with depth."""
    frame = FrameOptions(640, 360, (1.0, 0.0, 0.0), hard=True)
    options = SynthOptions(4, seed=3, frame=frame, split="train")
    return generate(options, tmp_path_factory.mktemp("drawn"))
