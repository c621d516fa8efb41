"""A recipe from reading to a trained network, on tiny pictures."""

from __future__ import annotations

import importlib.util
from collections import Counter
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.lab.training.conftest import StopAfterEpoch

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import TrainingError
from cucumbervision_lab.datasets.coco import read_coco, write_coco
from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.training.checkpoint import read_rows
from cucumbervision_lab.training.recipe import (
    Recipe,
    Schedule,
    Source,
    build_sources,
    read_recipe,
    with_axis_points,
)
from cucumbervision_lab.training.run_recipe import (
    PACKAGED,
    RecipeFolders,
    run_recipe,
    write_mixture,
)
from cucumbervision_lab.training.settings import TrainOptions
from cucumbervision_lab.training.train import NETWORK

SIDE = 360


def a_house(folder: Path) -> Path:
    """Write a set with masks: eight pictures with a green bar, four without, two to validate."""
    (folder / "raw").mkdir(parents=True)
    pictures = []
    for k in range(14):
        rng = np.random.default_rng(k)
        coarse = rng.integers(60, 200, (6, 6, 3)).astype(np.uint8)
        color = cv2.resize(coarse, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
        mask = np.zeros((SIDE, SIDE), bool)
        labels: tuple[Label, ...] = ()
        if k < 10:
            mask[60 + 20 * k : 90 + 20 * k, 100:220] = True
            color[mask] = (40, 160, 60)
            labels = (Label.of_mask(mask),)
        cv2.imwrite(str(folder / f"raw/{k}.png"), color)
        split = "val" if k in (8, 9) else "train"
        scene = "heap" if k < 4 else f"s{k}"
        pictures.append(
            LabelledPicture(f"{k}.png", SIDE, SIDE, labels, scene, split, "ours", "CC0-1.0")
        )
    write_coco(DataSet(folder / "raw", tuple(pictures)), folder / "house")
    return folder


RECIPE = Recipe(
    (
        Source("photos", "set", 0.4, "house", most=3, validate=1),
        Source("near", "windows", 0.2, of=("photos",), size=(160,), validate=2),
        Source("far", "sheets", 0.2, of=("photos",), size=(448,), count=4, validate=1),
        Source(
            "pasted", "montage", 0.2, of=("photos",), paste=("photos",), count=4, size=(256, 192)
        ),
        Source("drawn", "drawn", 0.0, size=(96, 64), count=1, hard=True, paste=("photos",)),
        Source("as-d435", "d435-colors", 0.0, of=("photos",), seed=7),
    ),
    {"seg": Schedule("seg.pt", "64x24", per_epoch=12, validate_every=2, judge_every=9)},
)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    pytest.importorskip("onnxruntime")
    data = a_house(tmp_path_factory.mktemp("data"))
    return build_sources(RECIPE, data, tmp_path_factory.mktemp("out"), log=lambda _: None)


def test_sources_are_built_from_one_another(built: dict[str, Path]) -> None:
    made = {name: read_coco(folder) for name, folder in built.items()}
    splits = {name: dict(Counter(p.split for p in one.pictures)) for name, one in made.items()}
    # Of the four pictures of one scene three are kept.
    assert splits["photos"] == {"train": 11, "val": 2}
    assert splits["near"] == {"train": 11, "val": 2}
    assert splits["far"] == {"train": 4, "val": 1}
    assert splits["pasted"] == {"train": 4}
    assert splits["drawn"] == {"train": 1}
    assert splits["as-d435"] == {"train": 11}
    seen, before = (made[name] for name in ("as-d435", "photos"))
    train = before.in_split("train")
    for one, other in zip(seen.pictures, train, strict=True):
        assert [x.mask_code for x in one.labels] == [x.mask_code for x in other.labels]
    pairs = zip(seen.pictures, train, strict=True)
    assert all((read_color(seen.path(a)) != read_color(before.path(b))).any() for a, b in pairs)
    points = [x.keypoints for p in made["photos"].pictures for x in p.labels]
    assert len(points) == 9
    for found in points:
        assert found is not None
        # The bar runs from 100 to 219.
        np.testing.assert_allclose(sorted(found[[0, 4], 0]), [100, 219], atol=1.5)


def test_what_is_built_stays(built: dict[str, Path]) -> None:
    before = {name: (f / "annotations.json").stat().st_mtime_ns for name, f in built.items()}
    said: list[str] = []
    build_sources(RECIPE, Path("nowhere"), built["photos"].parent, log=said.append)
    assert said == []
    after = {name: (f / "annotations.json").stat().st_mtime_ns for name, f in built.items()}
    assert before == after


def test_mixture_names_folders_and_weights(built: dict[str, Path], tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    values = yaml.safe_load(write_mixture(RECIPE, built, "seg", tmp_path).read_text())
    names = [Path(folder).parents[1].name for folder in values["train"]]
    assert dict(zip(names, values["weights"], strict=True)) == {
        "photos": 0.4,
        "near": 0.2,
        "far": 0.2,
        "pasted": 0.2,
    }
    assert [Path(folder).parents[1].name for folder in values["val"]] == ["photos", "near", "far"]
    assert len(list(Path(values["train"][0]).iterdir())) == 11
    card = (tmp_path / "data.md").read_text()
    assert "| photos | 40% |" in card
    assert "## photos" in card
    assert "## near" not in card  # its pictures are those of photos
    assert "CC0-1.0" in card


def test_mixture_in_a_relative_folder_names_folders_that_are_there(
    built: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    yaml = pytest.importorskip("yaml")
    monkeypatch.chdir(tmp_path)
    written = write_mixture(RECIPE, built, "seg", Path("run/seg")).resolve()
    values = yaml.safe_load(written.read_text())
    base = written.parent / values["path"]
    assert all((base / folder).is_dir() for folder in [*values["train"], *values["val"]])


@pytest.mark.train
@pytest.mark.skipif(
    importlib.util.find_spec("ultralytics") is None, reason="needs the extra 'train'"
)
def test_one_command_trains_and_goes_on(
    built: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cucumbervision_lab.training.checkpoint import import_ultralytics

    judged: list[int] = []
    home = "cucumbervision_lab.training.run_recipe"
    monkeypatch.setattr(f"{home}.Curve.judge", lambda _, network, seen: judged.append(seen))
    monkeypatch.setattr(f"{home}.build_sources", lambda *_: built)
    ultralytics = import_ultralytics()
    ultralytics.YOLO("yolo26n-seg.yaml").save(tmp_path / "seg.pt")
    folders = RecipeFolders(tmp_path, tmp_path, tmp_path / "out")
    short = TrainOptions(batch=4, device="cpu", precision="f32", threads=1)
    begin = partial(run_recipe, RECIPE, folders, tasks=("seg",), options=short, log=lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        begin(callbacks=StopAfterEpoch())
    assert begin() == {"seg": tmp_path / "out/seg" / NETWORK}
    rows = read_rows(tmp_path / "out/seg/metrics.csv")
    assert [int(row["pictures"]) for row in rows] == [12, 24]
    # Only the second epoch is validated, and the end of the plan is judged.
    assert [bool(row["fitness"]) for row in rows] == [False, True]
    assert judged == [24]


def test_masks_give_points_only_to_whole_slim_fruit() -> None:
    mask = np.zeros((100, 200), bool)
    mask[40:60, 20:180] = True
    round_one = np.zeros((100, 200), bool)
    round_one[40:60, 20:42] = True
    labels = (
        Label.of_mask(mask),
        Label.of_mask(mask, extras={"stem": "left"}),
        Label.of_mask(mask, hidden_share=0.3),
        Label.of_mask(mask, cut_off=True),
        Label.of_mask(round_one),
    )
    data = DataSet(Path(), (LabelledPicture("a.png", 200, 100, labels),))
    points = [label.keypoints for label in with_axis_points(data).pictures[0].labels]
    assert [found is not None for found in points] == [True, True, False, False, False]
    assert points[1] is not None
    assert points[1][4, 0] < points[1][0, 0]  # the stem's end is the last


def test_packaged_recipe_is_half_real() -> None:
    recipe = read_recipe(PACKAGED)
    shares = {source.name: source.weight for source in recipe.sources}
    assert sum(shares.values()) == pytest.approx(1)
    real = ("photo", "greenhouse", "on-plant", "d435")
    assert sum(w for name, w in shares.items() if name.startswith(real)) == pytest.approx(0.5)
    assert set(recipe.schedules) == {"seg", "pose"}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "no source has a weight"),
        ("[[source]]\nname='a'\nkind='films'", "unknown kind 'films'"),
        ("[[source]]\nname='a'\nkind='sheets'\nof='b'", "no earlier source is called 'b'"),
        ("[[source]]\nname='a'\nkind='windows'", "'of' is missing"),
        ("[[source]]\nname='a'\nkind='set'\nweight=1", "validation pictures"),
        ("[[source]]\nname='a'\nkind='set'\nwait=1", "wait"),
        ("[detect]\ninit='a.pt'\nplan='64x8'", "unknown task 'detect'"),
        ("[seg]\ninit='a.pt'\nplan='65x8'", "invalid part of a plan"),
        ("[seg", "cannot be read"),
    ],
)
def test_faults_of_a_recipe_are_named(text: str, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(TrainingError, match=fault) as caught:
        read_recipe(path)
    assert "mine.toml" in str(caught.value)
