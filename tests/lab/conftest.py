from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import write_png
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture

WIDTH, HEIGHT = 160, 120
CAMERA = Intrinsics(WIDTH, HEIGHT, 114.0, 114.0, 79.5, 59.5)


def fruit(x: int = 30, y: int = 40, *, ignore: bool = False) -> Label:
    """A fruit of 60 x 16 px whose right quarter something hides."""
    amodal = np.zeros((HEIGHT, WIDTH), bool)
    amodal[y : y + 16, x : x + 60] = True
    mask = amodal.copy()
    mask[:, x + 45 :] = False
    keypoints = np.array(
        [(x, y + 8, 2), (x + 15, y + 8, 2), (x + 30, y + 8, 2), (x + 45, y + 8, 1), (-9.5, 3, 0)],
        np.float64,
    )
    return Label.of_mask(
        mask,
        amodal=amodal,
        keypoints=keypoints,
        hidden_share=0.25,
        cut_off=True,
        ignore=ignore,
        extras={"centreline_m": 0.31, "axis_m": [[0.0, 0.1, 0.5], [0.3, 0.1, 0.5]]},
    )


@pytest.fixture
def make_set(tmp_path: Path) -> Callable[..., DataSet]:
    """A set of drawn pictures with depth: noise, so that none is another's duplicate."""

    def make(splits: str = "train train val test", name: str = "made") -> DataSet:
        folder = tmp_path / name
        (folder / "images").mkdir(parents=True)
        (folder / "depth").mkdir()
        pictures = []
        for k, split in enumerate(splits.split()):
            rng = np.random.default_rng(k)
            # Every picture in a colour of its own: none shows another's scene.
            base = np.array([40 + 170 * (k >> bit & 1) for bit in range(3)])
            noise = rng.integers(-40, 41, (HEIGHT // 8, WIDTH // 8, 3))
            coarse = (base + noise).astype(np.uint8)
            smooth = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
            write_png(folder / f"images/{k:06d}.png", smooth)
            depth = rng.integers(400, 900, (HEIGHT, WIDTH)).astype(np.uint16)
            write_png(folder / f"depth/{k:06d}.png", depth)
            pictures.append(
                LabelledPicture(
                    f"images/{k:06d}.png",
                    WIDTH,
                    HEIGHT,
                    (fruit(20 + 4 * k), fruit(30, 80)) if k % 2 == 0 else (fruit(40, 20 + 4 * k),),
                    scene=f"scene-{k}",
                    split="" if split == "-" else split,
                    source="drawn",
                    licence="CC0-1.0",
                    depth_file=f"depth/{k:06d}.png",
                    camera=CAMERA,
                    extras={"seed": k},
                )
            )
        return DataSet(folder, tuple(pictures))

    return make
