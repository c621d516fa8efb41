"""Fine-tune the packaged detector on pictures of one greenhouse, and compare it with the old one.

Training mixes in simulated frames, and photos if there are any, to prevent forgetting. Held-out
positions of the greenhouse are never used for training; both detectors are evaluated on them and
on the other tests.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cucumbervision.accuracy.statistics import estimate
from cucumbervision.errors import TrainingError
from cucumbervision.networks import DEFAULT_CONFIDENCE
from cucumbervision.networks.registry import JUDGEMENT, file_sha256, load_registry
from cucumbervision_lab.data.coco import ANNOTATIONS, read_coco
from cucumbervision_lab.data.labels import DataSet
from cucumbervision_lab.evaluate.outcomes import Evaluation, Score
from cucumbervision_lab.evaluate.pictures import detect_set, open_networks, spread
from cucumbervision_lab.evaluate.scenes import audited_photos, evaluate_photos
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate
from cucumbervision_lab.train.export import export_trained, write_card
from cucumbervision_lab.train.network import TrainOptions, photo_set, train

_LEAST_F1_GAIN, _MOST_F1_LOSS = 0.01, 0.02
"""Least gain of F1 on the greenhouse, and greatest loss on the other tests."""

_TRAIN_SEED, _TEST_SEED = 76, 77


@dataclass(frozen=True)
class DetectorScore:
    """Recall and precision of a detector on one test.

    Parameters
    ----------
    test : str
        'house, held out', 'drawn', 'photos' or 'photos at half size'.
    recall, precision : float
        At the default confidence threshold; 0 if undefined.
    fruit, finds : int
        Number of labelled fruit, and of detections.
    """

    test: str
    recall: float
    precision: float
    fruit: int
    finds: int

    @classmethod
    def of(cls, test: str, score: Score) -> DetectorScore:
        """Create the score from a score of the evaluation."""
        # Without fruit or detections a value is NaN, for which every comparison is False.
        recall, precision = score.recall, score.precision or estimate([])
        shares = [float(np.nan_to_num(part.value)) for part in (recall, precision)]
        return cls(test, shares[0], shares[1], recall.count, precision.count)

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision.

        Examples
        --------
        >>> DetectorScore("drawn", 0.5, 1.0, 10, 5).f1
        0.6666666666666666
        """
        total = self.recall + self.precision
        return 2 * self.recall * self.precision / total if total else 0.0


def train_house(
    house: Path,
    out: Path,
    *,
    photos: Path | None = None,
    init: Path = Path("checkpoints/cucumber-seg.pt"),
    share: float = 0.5,
    frames: int = 200,
    options: TrainOptions | None = None,
    workers: int = 1,
    log: Callable[[str], None] = print,
) -> Path:
    """Fine-tune the detector on a greenhouse, and compare it with the one in use.

    Parameters
    ----------
    house : Path
        Data set of the greenhouse, written by `data from-store`.
    out : Path
        The run's folder: `drawn/`, `seg/` and, at the end, `house-seg.onnx` with its card,
        `judgement.json` and `judgement.md`. Call the function again to resume an interrupted run.
    photos : Path, optional
        Folder of the audited photos, to train on and to compare by.
    init : Path
        Initial weights.
    share : float
        Share of greenhouse pictures in training.
    frames : int
        Number of simulated frames to train on; at most 60 different ones are compared by.
    options : TrainOptions, optional
        Training options; by default 15 epochs with a learning rate of 0.0003.
    workers : int
        Number of processes that draw synthetic frames.
    log : callable
        Called with a line of text for each step.

    Returns
    -------
    Path
        `judgement.json`.

    Raises
    ------
    TrainingError
        If the set has no held-out or no training pictures, or the weights are missing.
    DataSetError, CaptureError, MissingExtraError
        See `train`.
    """
    held_out = held_out_set(house)
    log("drawing frames to mix in")
    companions = [_drawn(out / "drawn", frames, _TRAIN_SEED, "train", workers)]
    if photos is not None:
        folder = out / "photos"
        companions.append(
            read_coco(folder) if (folder / ANNOTATIONS).is_file() else photo_set(photos, folder)
        )
    mixture = mixed(read_coco(house), companions, share)
    options = options or TrainOptions(15, learning_rate=3e-4)
    train("seg", mixture, out / "seg", str(init), options, log)
    count = len(held_out.pictures)
    log(f"comparing both detectors on {count} held-out pictures and on the other tests")
    return _compare(house, out, photos, min(frames, 60), workers)


def mixed(house: DataSet, companions: Sequence[DataSet], share: float) -> list[DataSet]:
    """Return data sets of which the first is repeated so often that it has about its share."""
    among = sum(len(dataset.in_split("train")) for dataset in companions)
    times = round(share / (1 - share) * among / len(house.in_split("train")))
    return [*[house] * max(times, 1), *companions]


def held_out_set(house: Path) -> DataSet:
    """Return the held-out pictures of a greenhouse's data set.

    Raises
    ------
    TrainingError
        If no picture with fruit is held out, or none is for training.
    """
    dataset = read_coco(house)
    held_out = (*dataset.in_split("val"), *dataset.in_split("test"))
    for part, what in ((dataset.in_split("train"), "for training"), (held_out, "held out")):
        if not any(picture.shows_fruit for picture in part):
            raise TrainingError(
                f"no picture with fruit is {what}",
                source=house,
                remedy="review more stops and export the set again",
            )
    return replace(dataset, pictures=held_out)


def _compare(house: Path, out: Path, photos: Path | None, frames: int, workers: int) -> Path:
    """Export the new network, evaluate both networks and write the comparison."""
    card = export_trained(out / "seg", out, "house-seg")
    new = out / card.file
    registry = load_registry()
    in_use = registry.default("segment")
    if in_use is None:
        raise TrainingError("no detector is in use to compare with", source=new)
    old = registry.resolve(in_use.name)["network"]
    drawn = _drawn(out / "test", frames, _TEST_SEED, "test", workers).folder
    scores = {network: evaluate_detector(network, house, drawn, photos) for network in (old, new)}
    better, why = verdict(scores[old], scores[new])
    table = comparison_table(scores[old], scores[new])
    (out / "judgement.md").write_text(f"{table}\n\n{why}\n", encoding="utf-8")
    values = {
        "file": new.name,
        "old": file_sha256(old),
        "new": card.sha256,
        "confidence": DEFAULT_CONFIDENCE,
        "better": better,
        "why": why,
        "scores": {
            name: [vars(score) for score in scores[network]]
            for name, network in (("old", old), ("new", new))
        },
    }
    path = out / JUDGEMENT
    path.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    write_card(replace(card, evaluation=values), out)
    return path


def _drawn(folder: Path, frames: int, seed: int, split: str, workers: int) -> DataSet:
    frame = FrameOptions(960, 540, depth=False)
    options = SynthOptions(frames, seed, frame, split=split)
    return generate(options, folder, workers)


def evaluate_detector(
    network: Path, house: Path, drawn: Path, photos: Path | None = None, limit: int = 256
) -> tuple[DetectorScore, ...]:
    """Evaluate the boxes that a detector would report as the one in use, beside the same networks.

    Parameters
    ----------
    network : Path
        The ONNX file.
    house : Path
        Data set of the greenhouse; its held-out pictures are evaluated.
    drawn : Path
        Synthetic set, evaluated completely.
    photos : Path, optional
        Folder of the audited photos; those of test scenes are evaluated.
    limit : int
        Maximum number of photos, evenly spaced.
    """
    networks = open_networks(network, None, None, ranked=False, as_in_use=True)
    scores = []
    for name, data in (("house, held out", held_out_set(house)), ("drawn", read_coco(drawn))):
        result = Evaluation(data, networks, detect_set(data, networks))
        scores.append(DetectorScore.of(name, result.score()))
    if photos is not None:
        tested, _ = audited_photos(photos)
        sample = replace(tested, pictures=spread(tested.pictures, limit))
        result = evaluate_photos(sample, networks)
        scores.append(DetectorScore.of("photos", result.score()))
        scores.append(DetectorScore.of("photos at half size", result.score(small=True)))
    return tuple(scores)


def verdict(old: Sequence[DetectorScore], new: Sequence[DetectorScore]) -> tuple[bool, str]:
    """Return whether a network is better than another, and the reason as text.

    A network is better if its F1 rises by at least 0.01 on the greenhouse and falls by at most 0.02
    on every other test.

    Examples
    --------
    >>> house = DetectorScore("house, held out", 0.4, 0.8, 50, 30)
    >>> drawn = DetectorScore("drawn", 0.9, 0.9, 9, 9)
    >>> verdict([house, drawn], [replace(house, recall=0.8), drawn])
    (True, 'F1 on the house rises from 0.533 to 0.800, and no other test gets worse')
    >>> verdict([house, drawn], [replace(house, recall=0.8), replace(drawn, recall=0.5)])
    (False, 'F1 on drawn falls from 0.900 to 0.643')
    """
    (house_old, *tests_old), (house_new, *tests_new) = old, new
    for before, after in zip(tests_old, tests_new, strict=True):
        if after.f1 < before.f1 - _MOST_F1_LOSS:
            return False, f"F1 on {after.test} falls from {before.f1:.3f} to {after.f1:.3f}"
    words = f"from {house_old.f1:.3f} to {house_new.f1:.3f}"
    if house_new.f1 < house_old.f1 + _LEAST_F1_GAIN:
        return (
            False,
            f"F1 on the house changes {words}, less than the gain of {_LEAST_F1_GAIN:g} required",
        )
    return True, f"F1 on the house rises {words}, and no other test gets worse"


def comparison_table(old: Sequence[DetectorScore], new: Sequence[DetectorScore]) -> str:
    """Return the scores of both detectors as a Markdown table.

    Examples
    --------
    >>> score = DetectorScore("drawn", 0.9, 0.8, 50, 40)
    >>> print(comparison_table([score], [score]).splitlines()[-1])
    | drawn | 50 | 0.90 | 0.90 | 0.80 | 0.80 |
    """
    lines = [
        "| test | fruit | recall old | new | precision old | new |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for a, b in zip(old, new, strict=True):
        figures = " | ".join(f"{x:.2f}" for x in (a.recall, b.recall, a.precision, b.precision))
        lines.append(f"| {a.test} | {a.fruit} | {figures} |")
    return "\n".join(lines)
