from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.constant_network import constant_network, registry_of

from cucumbervision.arrays import Mask, Numbers
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.networks.registry import Registry, load_registry
from cucumbervision.networks.yolo import fit

ROW_A = "simulated-row-a"
Array = Numbers


def network(path: Path, outputs: list[Array], props: Mapping[str, object]) -> Path:
    """Write a network of free size whose outputs are the given arrays, whatever it sees."""
    path.write_bytes(constant_network(*outputs, props=props, shape=(1, 3, "height", "width")))
    return path


def middles(mask: Mask, count: int = 5) -> Array:
    """Points down a hanging fruit: the middle of the mask in rows evenly spread."""
    rows = np.flatnonzero(mask.any(axis=1))
    chosen = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
    return np.array([[np.flatnonzero(mask[v]).mean(), v] for v in chosen])


@pytest.fixture(scope="session")
def row_a() -> Capture:
    """A bundled capture with three hanging fruit."""
    return next(iter(open_source(example_captures() / ROW_A))).load()


@pytest.fixture(scope="session")
def own_networks(row_a: Capture, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A segmenting and a pose network that know one picture by heart.

    The detector finds each fruit, and the first one's upper half once more.
    """
    folder = tmp_path_factory.mktemp("networks")
    box = fit(row_a.height, row_a.width, (640, 640), minimal=True)
    gain = np.array([box.inner_width / box.width, box.inner_height / box.height])
    corner = np.array([box.left_px, box.top_px])
    rows, poses = np.zeros((1, 300, 38)), np.zeros((1, 300, 21))
    prototypes = np.full((1, 32, box.input_height // 4, box.input_width // 4), -1.0)
    half = row_a.masks[0].copy()
    half[int(box_of_mask(half)[[1, 3]].mean()) :] = False
    for k, mask in enumerate([*row_a.masks, half]):
        edges = ((box_of_mask(mask).reshape(2, 2) + 0.5) * gain + corner).ravel()
        placed = box.apply(np.repeat(mask[..., None].astype(np.uint8) * 255, 3, axis=2))[..., 0]
        placed[: box.top_px] = placed[box.top_px + box.inner_height :] = 0
        size = prototypes.shape[3], prototypes.shape[2]
        prototypes[0, k] = cv2.resize(placed, size, interpolation=cv2.INTER_AREA) / 127.5 - 1
        score = 0.9 - 0.05 * k
        rows[0, k] = [*edges, score, 0, *np.eye(32)[k]]
        points = (middles(mask)[::-1] + 0.5) * gain + corner
        poses[0, k] = [*edges, score, 0, *np.column_stack([points, np.ones(5)]).ravel()]
    poses[0, len(row_a.masks)] = 0
    names = {"names": {0: "cucumber"}, "stride": 32, "imgsz": [640, 640], "end2end": True}
    return {
        "segment": network(folder / "seg.onnx", [rows, prototypes], names | {"task": "segment"}),
        "pose": network(
            folder / "pose.onnx", [poses], names | {"task": "pose", "kpt_shape": [5, 3]}
        ),
    }


@pytest.fixture(scope="session")
def own_registry(
    own_networks: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> Registry:
    """The package's SAM, and two embedded networks of the tests' own."""
    folder, sam = tmp_path_factory.mktemp("registry"), load_registry().get("mobile-sam")
    return registry_of(folder, sam, **own_networks)


@pytest.fixture(scope="session")
def bare_registry(tmp_path_factory: pytest.TempPathFactory) -> Registry:
    """A registry without any network."""
    return registry_of(tmp_path_factory.mktemp("bare"))
