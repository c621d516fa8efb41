"""Frames a second by stage on an NVIDIA card."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from statistics import median

import numpy as np
from figures import Figure

from cucumbervision.capture.frames import Capture
from cucumbervision.fruit.masks import box_ious
from cucumbervision.networks.runtime import import_onnxruntime
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.stream.fruit_stream import FruitStream
from speeds.frames import MODELS, bundled, five_fruit, overlapped
from speeds.stages import StageClock

ON_CARD = {
    "card, float32": MeasureOptions(instances="models", runtime="cuda", full_precision=True),
    "card, TF32": MeasureOptions(instances="models", runtime="cuda", full_precision=False),
    "card, TensorRT in half precision": MeasureOptions(
        instances="models", runtime="tensorrt", full_precision=False
    ),
}


NEEDED = {"cuda": "CUDAExecutionProvider", "tensorrt": "TensorrtExecutionProvider"}


def card_figures(options: MeasureOptions, quick: bool) -> list[Figure]:
    """Time a stream's frames by stage on a card, and compare lengths with the processor's."""
    rounds = 3 if quick else 40
    captures = [five_fruit()]
    measurer, clock = Measurer(options), StageClock(time.perf_counter)
    figures = lengths_beside_the_processors(measurer, [*bundled(), *captures])
    streams = {"--fast": FruitStream.fast(options), "all networks": FruitStream(measurer)}
    aims = {"--fast": ">= 60", "all networks": ">= 30"}
    for name, stream in streams.items():
        stages_ms = by_turn_ms(clock, stream, captures, rounds)
        fruit = sum(len(stream.take(capture).fruit) for capture in captures) / len(captures)
        label = f"stream, {name}"
        frame_ms = sum(stages_ms.values())
        rate, lag_s = overlapped(stream, captures, rounds)
        figures += [
            Figure(f"{label}, {fruit:.1f} fruit a frame", 1e3 / frame_ms, "frames/s", aims[name]),
            Figure(f"{label}, searched ahead", rate, "frames/s"),
            Figure(f"{label}, from a frame to its line", 1e3 * lag_s, "ms"),
            *(
                Figure(f"{label}: {stage}, alone {1e3 / ms:.0f} frames/s", ms, "ms")
                for stage, ms in sorted(stages_ms.items(), key=lambda pair: -pair[1])
                if ms >= 0.05
            ),
        ]
    return figures


def by_turn_ms(
    clock: StageClock, stream: FruitStream, captures: Sequence[Capture], rounds: int
) -> dict[str, float]:
    """Return the median time of a frame by stage, by the clock on the wall."""
    turns = []
    for turn in range(rounds + 2):
        clock.start()
        begun = time.perf_counter()
        for capture in captures:
            stream.take(capture)
        taken_s = {**clock.taken_s, "rest": time.perf_counter() - begun}
        taken_s["rest"] -= sum(clock.taken_s.values())
        if turn > 1:
            turns.append({stage: 1e3 * s / len(captures) for stage, s in taken_s.items()})
    return {stage: median(turn[stage] for turn in turns) for stage in turns[0]}


def lengths_beside_the_processors(measurer: Measurer, captures: Sequence[Capture]) -> list[Figure]:
    """Compare the lengths of the same fruit with those that float32 on the processor gives."""
    reference = Measurer(replace(MODELS, runtime="onnxruntime", full_precision=True))
    errors_cm, unpaired = [], 0
    for capture in captures:
        on_card = list(measurer.measure(capture).fruit)
        for fruit in reference.measure(capture).fruit:
            boxes = np.array([candidate.instance.box for candidate in on_card]).reshape(-1, 4)
            ious = box_ious(fruit.instance.box[None], boxes)[0]
            if not ious.size or ious.max() <= 0.5:
                unpaired += 1
                continue
            lengths = fruit.length, on_card.pop(int(ious.argmax())).length
            values_m = [length.value_m for length in lengths if length is not None]
            unpaired += len(values_m) == 1
            errors_cm += [100 * abs(values_m[0] - values_m[1])] if len(values_m) == 2 else []
        unpaired += len(on_card)
    return [
        Figure("fruit measured on both", len(errors_cm), "fruit"),
        Figure("fruit measured on one alone", unpaired, "fruit", "<= 0"),
        Figure("lengths off the processor's, most", max(errors_cm, default=0.0), "cm", "<= 0.02"),
    ]


def card_parts() -> dict[str, Callable[[bool], list[Figure]]]:
    """Return what can be timed on the card of this machine; ends where there is none."""
    providers = import_onnxruntime().get_available_providers()
    if NEEDED["cuda"] not in providers:
        raise SystemExit(
            f"card: ONNX Runtime has no {NEEDED['cuda']} here; on a machine with an NVIDIA card "
            "install onnxruntime-gpu in place of onnxruntime"
        )
    return {
        name: partial(card_figures, options)
        for name, options in ON_CARD.items()
        if NEEDED[options.runtime] in providers
    }
