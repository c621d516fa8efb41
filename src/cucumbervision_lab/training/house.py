"""Continue training the package's detector on a house's pictures, and compare it with the old one.

The shipped mixture is seen beside them, so that nothing is forgotten. Pictures of places that the
set keeps back are never trained on; old and new are judged on them and on our tests.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE
from cucumbervision.perception.in_use import JUDGEMENT
from cucumbervision.perception.registry import file_sha256
from cucumbervision_lab.datasets.coco import ANNOTATIONS, read_coco
from cucumbervision_lab.detection.outcomes import GroupScore, found_rows, fruit_rows, overall
from cucumbervision_lab.detection.photos import audited_photos, evaluate_photos
from cucumbervision_lab.detection.picture_result import detect_picture, open_networks
from cucumbervision_lab.detection.pictures import frame_of, spread
from cucumbervision_lab.detection.run import chosen_networks
from cucumbervision_lab.synthesis.generate import generate, parse_options
from cucumbervision_lab.training.export import export_trained
from cucumbervision_lab.training.plan import RunState
from cucumbervision_lab.training.publish import write_card
from cucumbervision_lab.training.recipe import Recipe, Source, read_recipe
from cucumbervision_lab.training.run_recipe import PACKAGED, write_mixture
from cucumbervision_lab.training.settings import TrainOptions
from cucumbervision_lab.training.sources import build_sources
from cucumbervision_lab.training.train import TrainWatcher, train

if TYPE_CHECKING:
    from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture

_GAIN, _LOSS = 0.01, 0.02
"""By how much F1 must rise on the house, and may fall on our tests."""

_TASK = "seg"
_TEST_SEED = 77  # of no source of the recipe


@dataclass(frozen=True)
class HousePlan:
    """How a house's pictures are learnt.

    Parameters
    ----------
    plan : str
        As `parse_plan` reads it.
    share : float
        Of the pictures seen that are the house's: half of them whole, half windows.
    drawn : int
        Frames drawn for each drawn source of the shipped mixture, at most.
    windows : tuple of int
        Sides of the windows cut out of the house's pictures, pixels.
    tested : int
        Drawn frames, and audited photos, that old and new are judged on, at most.
    per_epoch : int
        Pictures between two checkpoints.
    learning_rate, one_to_many : float
        As `TrainOptions`: that head's share is small, since the network finds fruit already.
    """

    plan: str = "640x6000"
    share: float = 0.5
    drawn: int = 200
    windows: tuple[int, ...] = (240, 400)
    tested: int = 256
    per_epoch: int = 200
    learning_rate: float = 0.0003
    one_to_many: float = 0.1


@dataclass(frozen=True)
class Judged:
    """What one network found of one test.

    Parameters
    ----------
    test : str
        'house, kept back', 'drawn', 'photos' or 'photos at half size'.
    recall, precision : float
        At the confidence that is asked by default; 0 where there was nothing to find.
    fruit, finds : int
        How many each is of.
    """

    test: str
    recall: float
    precision: float
    fruit: int
    finds: int

    @classmethod
    def of(cls, test: str, score: GroupScore) -> Judged:
        """Make it of a score of the evaluation."""
        # A share of nothing is no number, and would be better than nothing and worse than none.
        (recall, fruit), (precision, finds) = (
            (one.value, one.count) if one is not None and one.count else (0.0, 0)
            for one in (score.recall, score.precision)
        )
        return cls(test, recall, precision, fruit, finds)

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision.

        Examples
        --------
        >>> Judged("drawn", 0.5, 1.0, 10, 5).f1
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
    plan: HousePlan | None = None,
    options: TrainOptions | None = None,
    watcher: TrainWatcher | None = None,
    workers: int = 1,
    say: Callable[[str], None] = print,
) -> Path | None:
    """Train the detector on from shipped weights, and judge it against the one in use.

    Parameters
    ----------
    house : Path
        A set of `data from-store`.
    out : Path
        The run's folder: `data/`, `seg/` and, at the end, `house-seg.onnx` with its card,
        `judgement.json` and `judgement.md`. The same call goes on after any interruption.
    photos : Path, optional
        The folder of pictures of the shipped mixture; without it only its drawn frames are seen.
    init : Path
        The weights to begin with.
    plan : HousePlan, optional
        How to learn.
    options : TrainOptions, optional
        Of the machine: device, batch, threads, minutes.
    watcher : TrainWatcher, optional
        Is shown every batch and epoch.
    workers : int
        Processes that draw.
    say : callable
        Called with a line for each step.

    Returns
    -------
    Path or None
        `judgement.json`; None where the time was over before the plan was.

    Raises
    ------
    TrainingError
        If the set keeps nothing back or has nothing to train on, or the weights are missing.
    DataSetError, CaptureError, MissingExtraError
        As `train`.
    """
    plan, options = plan or HousePlan(), options or TrainOptions()
    _, held_back = kept_back(house)
    run = out / _TASK
    begun = RunState.exists(run)
    if not begun and not init.is_file():
        raise TrainingError(
            "there are no such weights, and none are fetched",
            source=init,
            remedy="name the checkpoint of the package's detector with --init",
        )
    recipe = house_recipe(read_recipe(PACKAGED), house, plan, photos=photos is not None)
    if photos is None:
        say("no folder of photos is given: of the shipped mixture only drawn frames are seen")
    data = photos or out / "no-photos"
    built = build_sources(recipe, data, out / "data", workers, say)
    mixture = write_mixture(recipe, built, _TASK, run)
    train(
        _TASK,
        mixture,
        run,
        init=None if begun else str(init),
        plan=plan.plan,
        per_epoch=plan.per_epoch,
        resume=begun,
        options=replace(
            options,
            learning_rate=plan.learning_rate,
            one_to_many=plan.one_to_many,
            freeze=options.freeze or -1,
            check=False,  # a house's stops resemble each other
        ),
        watcher=watcher,
    )
    if not RunState.load(run).is_done:
        return None
    say(f"judging old and new on {len(held_back)} pictures kept back, and on our tests")
    return _judge(house, out, run, photos, plan, workers)


def kept_back(house: Path) -> tuple[DataSet, tuple[LabelledPicture, ...]]:
    """Return a house's set, and the pictures of it that nothing is trained on.

    Raises
    ------
    TrainingError
        If none is kept back, or none is to be trained on.
    """
    dataset = read_coco(house)
    held_back = (*dataset.in_split("val"), *dataset.in_split("test"))
    for own, what in ((dataset.in_split("train"), "to train on"), (held_back, "kept back")):
        if not any(picture.shows_fruit for picture in own):
            raise TrainingError(
                f"no picture with fruit is {what}",
                source=house,
                remedy="review more stops, and write the set again",
            )
    return dataset, held_back


def house_recipe(base: Recipe, house: Path, plan: HousePlan, *, photos: bool) -> Recipe:
    """Return a recipe of a house's pictures and the sources of another one beside them.

    Parameters
    ----------
    base : Recipe
        The shipped mixture.
    house : Path
        The house's set.
    plan : HousePlan
        What share the house has.
    photos : bool
        Whether the shipped mixture's photos are at hand; else only what is drawn stays of it.

    Returns
    -------
    Recipe
        The house's pictures of split `val` are validated with.
    """
    beside = base.sources if photos else _drawn_only(base.sources)
    total = sum(source.weight for source in beside)
    shrunk = tuple(
        replace(
            source,
            weight=source.weight * (1 - plan.share) / total,
            count=min(source.count, plan.drawn) if source.kind == "drawn" else source.count,
            validate=min(source.validate, plan.drawn // 10),
        )
        for source in beside
    )
    # A source is built anew where what is written of it differs: so it follows the labels.
    content = zlib.crc32((house / ANNOTATIONS).read_bytes())
    folder, part = str(house.resolve()), plan.share / 2
    own = (
        Source("house", "set", part, folder=folder, seed=content, most=1000, validate=1),
        Source("house-windows", "windows", part, of=("house",), size=plan.windows, seed=content),
    )
    return Recipe((*own, *shrunk), {})


def _drawn_only(sources: Sequence[Source]) -> tuple[Source, ...]:
    """Return the sources that take no photo, nor are made of one."""
    kept: dict[str, Source] = {}
    for source in sources:
        if source.kind not in ("photos", "set") and {*source.of, *source.paste} <= kept.keys():
            kept[source.name] = source
    return tuple(kept.values())


def _judge(
    house: Path, out: Path, run: Path, photos: Path | None, plan: HousePlan, workers: int
) -> Path:
    """Export the new network, judge both, and write what came of it."""
    card = export_trained(run, out, "house-seg")
    new = out / card.file
    old, _ = chosen_networks(None, new)  # what a command without options uses
    if old is None:
        raise TrainingError("there is no detector in use to judge against", source=new)
    drawn = _drawn_test(out, plan.tested, workers)
    scores = {
        network: judge_on(network, house, drawn, photos, plan.tested) for network in (old, new)
    }
    better, why = verdict(scores[old], scores[new])
    table = judgement_table(scores[old], scores[new])
    (out / "judgement.md").write_text(f"{table}\n\n{why}\n", encoding="utf-8")
    values = {
        "file": new.name,
        "old": file_sha256(old),
        "new": card.sha256,
        "confidence": DEFAULT_CONFIDENCE,
        "better": better,
        "why": why,
        "scores": {
            name: [vars(one) for one in scores[network]]
            for name, network in (("old", old), ("new", new))
        },
    }
    path = out / JUDGEMENT
    path.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    write_card(replace(card, evaluation=values), out)
    return path


def _drawn_test(out: Path, frames: int, workers: int) -> Path:
    """Draw the frames of our test, from a seed that no source is drawn from."""
    options = parse_options(
        frames=min(frames, 60),
        seed=_TEST_SEED,
        size="960x540",
        shares="0.6,0.22,0.18",
        split="test",
        depth=False,
    )
    return generate(options, out / "test", workers).folder


def judge_on(
    network: Path, house: Path, drawn: Path, photos: Path | None = None, most: int = 256
) -> tuple[Judged, ...]:
    """Judge a detector by what is reported with it: by boxes, beside the pose network in use.

    Parameters
    ----------
    network : Path
        ONNX.
    house : Path
        A house's set; what it keeps back is judged.
    drawn : Path
        A drawn set, all of which is judged.
    photos : Path, optional
        Folder of the audited photos; those of test scenes are judged.
    most : int
        Photos at most, evenly spread.
    """
    networks = open_networks(*chosen_networks(network, None), None, ranked=False)
    asked = networks.confidence
    dataset, held_back = kept_back(house)
    test = read_coco(drawn)
    found = []
    for name, data, pictures in (
        ("house, kept back", dataset, held_back),
        ("drawn", test, test.pictures),
    ):
        frames = [
            detect_picture(frame_of(one, data, None), read_color(data.path(one)), networks).frame
            for one in pictures
        ]
        score = overall(fruit_rows(frames, asked), found_rows(frames, asked))
        found.append(Judged.of(name, score))
    if photos is not None:
        result = evaluate_photos(spread(tuple(audited_photos(photos)[0]), most), networks)
        found.append(Judged.of("photos", result.scores[0][1]))
        found.append(Judged.of("photos at half size", result.small[0][1]))
    return tuple(found)


def verdict(old: Sequence[Judged], new: Sequence[Judged]) -> tuple[bool, str]:
    """Return whether a network is better than another, and why, in a sentence.

    Better is what has an F1 higher by 0.01 on the house, and none lower by more than 0.02 on our
    tests.

    Examples
    --------
    >>> house, drawn = Judged("house, kept back", 0.4, 0.8, 50, 30), Judged("drawn", 0.9, 0.9, 9, 9)
    >>> verdict([house, drawn], [replace(house, recall=0.8), drawn])
    (True, 'on the house F1 rises from 0.533 to 0.800, and nothing is forgotten')
    >>> verdict([house, drawn], [replace(house, recall=0.8), replace(drawn, recall=0.5)])
    (False, 'on drawn F1 falls from 0.900 to 0.643')
    """
    (house_old, *tests_old), (house_new, *tests_new) = old, new
    for before, after in zip(tests_old, tests_new, strict=True):
        if after.f1 < before.f1 - _LOSS:
            return False, f"on {after.test} F1 falls from {before.f1:.3f} to {after.f1:.3f}"
    words = f"from {house_old.f1:.3f} to {house_new.f1:.3f}"
    if house_new.f1 < house_old.f1 + _GAIN:
        return False, f"on the house F1 goes {words}, which is no gain of {_GAIN:g}"
    return True, f"on the house F1 rises {words}, and nothing is forgotten"


def judgement_table(old: Sequence[Judged], new: Sequence[Judged]) -> str:
    """Return what old and new found, as a Markdown table.

    Examples
    --------
    >>> one = Judged("drawn", 0.9, 0.8, 50, 40)
    >>> print(judgement_table([one], [one]).splitlines()[-1])
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
