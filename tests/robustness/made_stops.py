"""Stops as a round leaves them, made from a seed: for benchmarks of the store."""

from __future__ import annotations

from typing import Any

import numpy as np

from cucumbervision.instances.mask_codes import encode_rle
from cucumbervision.measurement.result import Length, LengthDefinition
from cucumbervision_greenhouse.store.images import DEPTH_UNIT_M, ImageStore
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    DetectionRecord,
    MethodRecord,
    Point,
    Round,
    StopRecord,
    key_of,
)

METHODS = ("M1", "M2", "M3", "M4", "M5", "M6")
FRUIT = 6
SPACING_M = 0.4
_START_S = 1.8e9
_CAMERA = {"fx": 600.0, "fy": 600.0, "stream": "color", "distortion": "none"}


def made_round(name: str, day: int = 0) -> Round:
    """Return a round of a day."""
    return Round(key_of("made", name, day), name, "house 1", _START_S + 86400.0 * day)


def made_stop(
    walk: Round,
    number: int,
    images: ImageStore | None = None,
    size_px: tuple[int, int] = (160, 120),
) -> StopRecord:
    """Return one stop of a round, the same for the same number.

    Parameters
    ----------
    walk : Round
        The round.
    number : int
        Which stop; every hundredth begins a row.
    images : ImageStore, optional
        Its pictures are put here: noise, the worst that can be compressed.
    size_px : tuple of int
        Their width and height.
    """
    rng = np.random.default_rng([int(walk.key[:8], 16), number])
    return StopRecord(
        key=key_of(walk.key, number),
        round_key=walk.key,
        row=str(1 + number // 100),
        side="left",
        position_m=SPACING_M * (number % 100),
        position_sd_m=0.03,
        step=number,
        taken_s=walk.started_s + 10.0 * number,
        captures=(_capture(rng, number, images, size_px),),
        artifacts=(
            ArtifactRecord("model", "detector", "ab" * 32, {"runtime": "onnxruntime"}),
            ArtifactRecord("config", "measure", "cd" * 32, {"length": "thread"}),
        ),
    )


def _capture(
    rng: np.random.Generator, number: int, images: ImageStore | None, size_px: tuple[int, int]
) -> CaptureRecord:
    width, height = size_px
    pictures: dict[str, Any] = {}
    if images is not None:
        color = rng.integers(0, 256, (height, width, 3), np.uint8)
        depth = rng.uniform(0.4, 0.6, (height, width)).astype(np.float32)
        pictures = {
            "color": images.put_color(color),
            "depth": images.put_depth(depth),
            "thumbnail": images.put_thumbnail(color),
        }
    return CaptureRecord(
        name=f"stop-{number:04d}",
        frame=number,
        width_px=width,
        height_px=height,
        fill=0.91,
        simulated=True,
        source="made",
        camera={**_CAMERA, "width": width, "height": height, "cx": width / 2, "cy": height / 2},
        depth_unit_m=DEPTH_UNIT_M,
        fruit=tuple(_fruit(rng, k, width, height) for k in range(1, FRUIT + 1)),
        **pictures,
    )


def _fruit(rng: np.random.Generator, number: int, width: int, height: int) -> DetectionRecord:
    x, y = rng.integers(5, width - 40), rng.integers(5, height - 60)
    mask = np.zeros((height, width), bool)
    for line in range(50):  # a leaning, ragged strip: run lengths as a drawn mask's
        left = x + line // 5 + rng.integers(0, 3)
        mask[y + line, left : left + 12 + rng.integers(0, 3)] = True
    length = round(float(rng.uniform(0.12, 0.38)), 5)
    path = np.round(np.cumsum(rng.normal(0.005, 0.001, (48, 3)), axis=0), 6)
    points = tuple(tuple(point) for point in path.tolist())
    *others, tube = _methods(length, points)
    return DetectionRecord(
        number=number,
        score=round(float(rng.uniform(0.5, 1.0)), 4),
        box_x1_px=float(x),
        box_y1_px=float(y),
        box_x2_px=float(x + 25),
        box_y2_px=float(y + 50),
        method="M6",
        reason="tube",
        length=Length(tube.thread_m or 0.0, LengthDefinition.THREAD),
        centreline_m=length,
        thread_m=tube.thread_m,
        chord_m=tube.chord_m,
        diameter_max_m=0.045,
        diameter_mean_m=0.042,
        mask_source="sam",
        mask_px=int(mask.sum()),
        fill=0.9,
        distance_m=0.5,
        offset_m=round(float(rng.uniform(-0.25, 0.25)), 5),
        offset_sd_m=0.004,
        view_score=round(float(rng.uniform(0.3, 0.9)), 6),
        mask=encode_rle(mask),
        methods=(*others, tube),
    )


def _methods(length: float, points: tuple[Point, ...]) -> tuple[MethodRecord, ...]:
    methods = tuple(
        MethodRecord(m, round(length * (1 + 0.01 * k), 6), "surface-arc", path_m=points[:: 47 - k])
        for k, m in enumerate(METHODS[:-1])
    )
    tube = MethodRecord(
        "M6",
        length,
        "centreline",
        centreline_m=length,
        thread_m=round(1.08 * length, 6),
        chord_m=round(0.97 * length, 6),
        thread_sd_m=0.003,
        path_m=points,
        diameter_m=tuple(np.full(48, 0.042).tolist()),
    )
    return (*methods, tube)
