"""Options that several commands share, and exit codes. Avoids slow imports."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_type_hints

import typer

from cucumbervision.capture import DepthAlong, Stream
from cucumbervision.networks import DEFAULT_CONFIDENCE

if TYPE_CHECKING:
    from cucumbervision.run.batch import LoopOptions
    from cucumbervision.run.options import MeasureOptions

Command: TypeAlias = Callable[..., None]


def exit_codes(success: str, failed: str = "something failed (see failures.csv)") -> str:
    """Return what the exit codes of a command mean, for its --help."""
    return (
        f"Exit codes: 0 {success}; 1 {failed}, the rest was done; 2 nothing could be done; 70 a "
        "defect of the software was met, the rest was done; 130 interrupted."
    )


EXIT_CODES = exit_codes("everything was read and written, even if a fruit could not be measured")
"""Exit codes of commands that measure many captures."""

RuntimeChoice: TypeAlias = Literal["auto", "onnxruntime", "openvino", "cuda", "tensorrt"]
_FAST = {"fast": "auto", "cuda-fast": "cuda", "tensorrt-fast": "tensorrt"}

InputSize = Annotated[
    str,
    typer.Option(
        help="Long sides of the networks' input, multiples of 32. Default: each network's own.",
        metavar="PX[,PX]",
    ),
]
Runtime = Annotated[RuntimeChoice, typer.Option(help="Runtime of the networks.")]
Burst = Annotated[int, typer.Option(min=1, max=99, help="Number of frames fused to one capture.")]

OF_CAMERA_FILE = frozenset({"depth_unit", "depth_along", "aligned_to"})
"""Options of `measure_options` that the intrinsics file can hold instead."""


def measure_options(
    instances: Annotated[
        str,
        typer.Option(
            help="Where fruit come from: models (the package's own), dataset (its own masks), or a "
            "FILE: COCO JSON, YOLO txt, YOLO .onnx. auto: the data set's masks, else models."
        ),
    ] = "auto",
    classes: Annotated[
        str,
        typer.Option(
            help="Classes to measure, as the file or network names them.", metavar="NAME[,NAME]"
        ),
    ] = "",
    pose: Annotated[
        Path | None,
        typer.Option(help="YOLO pose .onnx of your own for the keypoints.", metavar="FILE"),
    ] = None,
    methods: Annotated[
        str, typer.Option(help="all, or some of m1,m2,m3,m4,m5,m6; shown if given.")
    ] = "",
    selector: Annotated[
        Literal["best", "paper"], typer.Option(help="Rule that selects one method.")
    ] = "best",
    length: Annotated[
        Literal["thread", "centreline", "chord"],
        typer.Option(help="Definition of length, if a tube could be fitted."),
    ] = "centreline",
    segmenter: Annotated[
        str | None,
        typer.Option(
            help="Network for all masks, or none. Default: mobile-sam, where others fit badly.",
            show_default=False,
        ),
    ] = None,
    confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Minimum confidence of a detection.")
    ] = DEFAULT_CONFIDENCE,
    intrinsics: Annotated[
        Path | None, typer.Option(help="Intrinsics file (JSON) of the colour stream.")
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(help="Depth image, if INPUT is a colour image.")
    ] = None,
    depth_unit: Annotated[
        float | None, typer.Option(min=1e-6, help="Metres per depth step, such as 0.001.")
    ] = None,
    depth_along: Annotated[
        DepthAlong | None,
        typer.Option(help="Direction of depth: optical axis (default), or each pixel's ray."),
    ] = None,
    aligned_to: Annotated[
        Stream | None,
        typer.Option(
            help="Camera whose pixels both images have: depth, if colour was aligned to it; color, "
            "also if depth has the same field of view in fewer pixels."
        ),
    ] = None,
    burst: Burst = 5,
    calibration: Annotated[
        Path | None, typer.Option(help="Site calibration from `cucumbervision calibrate`.")
    ] = None,
    profile: Annotated[
        str, typer.Option(help="Crop profile, or a crop's folder with networks of its own.")
    ] = "long-cucumber",
    input_size: InputSize = "",
    runtime: Annotated[
        Literal[RuntimeChoice, "fast", "cuda-fast", "tensorrt-fast"],
        typer.Option(
            help="Runtime of the networks. fast: half precision, if the processor or GPU supports "
            "it; lengths may then differ slightly between machines."
        ),
    ] = "auto",
    camera_up: Annotated[
        Literal["top", "left", "right", "bottom"] | None,
        typer.Option(help="The image's edge that is up, if the camera is level and fruit hang."),
    ] = None,
) -> MeasureOptions:
    """Return the measuring options of a command."""
    arguments: dict[str, Any] = locals()
    from cucumbervision.capture.source import ReadOptions
    from cucumbervision.crop.profiles import PACK_PROFILE, load_profile, profile_path
    from cucumbervision.networks.yolo import parse_input_sizes
    from cucumbervision.run.options import MeasureOptions, read_pack

    named = {name: arguments[name] for name in {*vars(MeasureOptions)} & arguments.keys()}
    named |= {
        "methods": methods or "all",
        "input_sizes": parse_input_sizes(input_size),
        "runtime": _FAST.get(runtime, runtime),
        "full_precision": runtime not in _FAST,
        "reading": ReadOptions(intrinsics, depth, depth_unit, burst, depth_along, aligned_to),
    }
    options, path = MeasureOptions(**named), profile_path(profile)
    if path.name == PACK_PROFILE:
        return read_pack(path.parent).options(options)
    return options.for_crop(load_profile(path))


def loop_options(
    workers: Annotated[
        int, typer.Option(min=0, help="Number of processes; default: 1, with Ray one per CPU.")
    ] = 0,
    ray: Annotated[
        str,
        typer.Option(
            help="Address of a Ray cluster, or local to start one on this machine.",
            metavar="ADDRESS",
        ),
    ] = "",
) -> LoopOptions:
    """Return the loop options of a command."""
    from cucumbervision.run.batch import LoopOptions, Processes

    if ray:
        from cucumbervision.run.batch import RayEngine

        return LoopOptions(engine=RayEngine(ray, workers))
    return LoopOptions(engine=Processes(workers)) if workers > 1 else LoopOptions()


def takes(
    keyword: str, make: Callable[..., object], without: Collection[str] = ()
) -> Callable[[Command], Command]:
    """Return a decorator that gives a command the options of a function such as `measure_options`.

    Parameters
    ----------
    keyword : str
        The command's parameter that receives the function's result.
    make : callable
        The function. A parameter of the command with the name of one of its options receives the
        option's value, too.
    without : collection of str
        Options that the command does not offer; they keep their defaults.
    """

    def decorate(command: Command) -> Command:
        shared = [parameter for parameter in _parameters(make) if parameter.name not in without]
        others = [parameter for parameter in _parameters(command) if parameter.name != keyword]
        names = {parameter.name for parameter in shared}

        @functools.wraps(command)
        def run(**values: Any) -> None:
            made = make(**{name: values[name] for name in names})
            command(**{other.name: values[other.name] for other in others}, **{keyword: made})

        parameters = [parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in shared]
        parameters += [other for other in others if other.name not in names]
        parameters.sort(key=lambda parameter: parameter.kind)  # what has no name comes first
        vars(run)["__signature__"] = inspect.Signature(parameters)
        run.__annotations__ = {each.name: each.annotation for each in parameters}
        return run

    return decorate


def _parameters(function: Callable[..., object]) -> list[inspect.Parameter]:
    """Return a function's parameters with their annotations evaluated."""
    later = {"MeasureOptions": object, "LoopOptions": object}
    hints = get_type_hints(function, localns=later, include_extras=True)
    parameters = inspect.signature(function).parameters.values()
    return [
        parameter.replace(annotation=hints.get(parameter.name, parameter.annotation))
        for parameter in parameters
    ]


ListenOn = Annotated[
    str, typer.Option("--address", help="Address to listen on; default: this machine only.")
]
Port = Annotated[int, typer.Option(min=1, max=65535, help="Port.")]

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
StoreName = Annotated[
    str,
    typer.Option(
        "--store",
        envvar="CUCUMBERVISION_STORE",
        help="SQLite file, or postgresql://…?images=FOLDER.",
    ),
]
RoundName = Annotated[
    str, typer.Option("--round", "-r", help="Name, key or start of a key; default: the newest.")
]
Profile = Annotated[
    str | None, typer.Option(help="Crop profile for classes; default: the round's own.")
]
