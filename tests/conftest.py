from __future__ import annotations

import doctest
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.synthesis.bodies import Tube
from cucumbervision_lab.synthesis.scene import Kind, Scene, View, render


@pytest.fixture
def camera() -> Intrinsics:
    """A D435's colour camera at 1280x720, rounded."""
    return Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)


@pytest.fixture
def shared_data() -> Path:
    """The folder of real captures, which never comes with the project."""
    folder = os.environ.get("CUCUMBERVISION_DATA")
    if not folder:
        pytest.skip("CUCUMBERVISION_DATA names no folder of real captures")
    return Path(folder)


@pytest.fixture
def run_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Path], doctest.TestResults]:
    """Run a page's examples in an empty folder."""

    def run(page: Path) -> doctest.TestResults:
        monkeypatch.chdir(tmp_path)
        return doctest.testfile(
            str(page),
            module_relative=False,
            optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS,
            encoding="utf-8",
        )

    return run


def capture_of(scene: View, camera: Intrinsics, fruit: int = 1, name: str = "drawn") -> Capture:
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    color[scene.kind == Kind.FRUIT] = (60, 140, 50)
    masks = tuple(scene.mask(k) for k in range(fruit))
    return Capture(color, scene.depth_m.astype(np.float32), camera, name, masks=masks)


def draw(tube: Tube, camera: Intrinsics, backdrop_m: float = 0.0) -> tuple[Capture, View]:
    scene = render(Scene.of(tube, backdrop_m=backdrop_m), camera)
    return capture_of(scene, camera), scene


def depth32(scene: View) -> NDArray[np.float32]:
    return scene.depth_m.astype(np.float32)
