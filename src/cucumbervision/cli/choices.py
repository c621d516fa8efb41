"""Options that several commands share, and exit codes. Avoids slow imports."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_type_hints

import typer

from cucumbervision.capture.conventions import DepthAlong, Stream
from cucumbervision.measurement.result import LengthDefinition, Selector
from cucumbervision.perception.confidence import DEFAULT_CONFIDENCE

if TYPE_CHECKING:
    from cucumbervision.pipeline.batch import LoopOptions
    from cucumbervision.pipeline.options import MeasureOptions

Command: TypeAlias = Callable[..., None]

EXIT_CODES = (
    "Exit codes: 0 everything was read and written, even if a fruit could not be measured; 1 "
    "something failed (see failures.csv), the rest was done; 2 nothing could be done; 70 a defect "
    "of the software was met, the rest was done; 130 interrupted."
)
"""Exit codes of commands that process many captures; shown by --help."""

CameraUp: TypeAlias = Literal["top", "left", "right", "bottom"]
RuntimeChoice: TypeAlias = Literal["auto", "onnxruntime", "openvino", "cuda", "tensorrt"]
_FAST = {"fast": "auto", "cuda-fast": "cuda", "tensorrt-fast": "tensorrt"}

Confidence = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Minimum confidence of a detection.")
]
InputSize = Annotated[
    str,
    typer.Option(
        help="Long side of the networks' input, pixels: a multiple of 32, or several separated by "
        "commas, whose detections are merged. Default: each network's own.",
        metavar="PX[,PX]",
    ),
]
Runtime = Annotated[RuntimeChoice, typer.Option(help="Runtime of the networks.")]
RuntimeOrFast = Annotated[
    Literal[
        "auto", "fast", "onnxruntime", "openvino", "cuda", "cuda-fast", "tensorrt", "tensorrt-fast"
    ],
    typer.Option(
        help="Runtime of the networks. fast: auto in half precision, if the processor supports it, "
        "so too on a card; outlines and lengths may then differ slightly between machines."
    ),
]
Instances = Annotated[
    str,
    typer.Option(
        help="Where fruit come from: models (the package's own), dataset (its own masks), or a "
        "FILE: COCO JSON, YOLO txt, YOLO .onnx. auto: the data set's masks, else models."
    ),
]
SegmenterName = Annotated[
    str | None,
    typer.Option(
        help="Network that draws the masks (`models list` names them), or none; also redraws a "
        "data set's own masks. Default: mobile-sam, where the detector's mask fits badly.",
        show_default=False,
    ),
]
Burst = Annotated[
    int,
    typer.Option(
        min=1, max=99, help="Number of frames of a recording or camera fused to one capture."
    ),
]


PoseNetwork = Annotated[
    Path | None, typer.Option(help="YOLO pose .onnx of your own for the keypoints.", metavar="FILE")
]
Methods = Annotated[str, typer.Option(help="all, or some of m1,m2,m3,m4,m5,m6; shown if given.")]
SelectorRule = Annotated[Selector, typer.Option(help="Rule that selects one method.")]
LengthKind = Annotated[
    LengthDefinition, typer.Option(help="Definition of length, if a tube could be fitted.")
]
IntrinsicsFile = Annotated[
    Path | None, typer.Option(help="Intrinsics file (JSON) of the colour stream.")
]
DepthPicture = Annotated[
    Path | None, typer.Option(help="Depth picture, if INPUT is a colour picture.")
]
DepthUnit = Annotated[
    float | None, typer.Option(min=1e-6, help="Metres per depth step, such as 0.001.")
]
AxisOrRay = Annotated[
    DepthAlong | None,
    typer.Option(
        help="Whether depth is along the optical axis, as cameras write it, or the distance along "
        "each pixel's ray, as simulators do. Default: as the camera file says, else axis."
    ),
]
AlignedTo = Annotated[
    Stream | None,
    typer.Option(
        help="Camera whose pixels both pictures have: depth, if colour was aligned to depth; "
        "color, also if depth has the same field of view in fewer pixels."
    ),
]
Calibration = Annotated[
    Path | None, typer.Option(help="Site calibration from `cucumbervision calibrate`.")
]
CropProfileName = Annotated[
    str,
    typer.Option(
        help="Crop profile, or a crop's folder with networks of its own; lengths outside its "
        "range are rejected."
    ),
]
UpperEdge = Annotated[
    CameraUp | None,
    typer.Option(
        help="The picture's edge that is up, for a camera mounted about level before hanging "
        "fruit: the upper end is then the stem's."
    ),
]


Classes = Annotated[
    str,
    typer.Option(
        help="Classes to measure, separated by commas, as the file or network names them. "
        "Default: all.",
        metavar="NAME[,NAME]",
    ),
]


OF_CAMERA_FILE = frozenset({"depth_unit", "depth_along", "aligned_to"})
"""Options of `measure_options` that the intrinsics file can hold instead."""


def measure_options(
    instances: Instances = "auto",
    classes: Classes = "",
    pose: PoseNetwork = None,
    methods: Methods = "",
    selector: SelectorRule = Selector.BEST,
    length: LengthKind = LengthDefinition.CENTRELINE,
    segmenter: SegmenterName = None,
    confidence: Confidence = DEFAULT_CONFIDENCE,
    intrinsics: IntrinsicsFile = None,
    depth: DepthPicture = None,
    depth_unit: DepthUnit = None,
    depth_along: AxisOrRay = None,
    aligned_to: AlignedTo = None,
    burst: Burst = 5,
    calibration: Calibration = None,
    profile: CropProfileName = "long-cucumber",
    input_size: InputSize = "",
    runtime: RuntimeOrFast = "auto",
    camera_up: UpperEdge = None,
) -> MeasureOptions:
    """Return the measuring options of a command."""
    from cucumbervision.agronomy.profiles import PACK_PROFILE, load_profile, profile_path
    from cucumbervision.capture.source import ReadOptions
    from cucumbervision.perception.input_sizes import parse_input_sizes
    from cucumbervision.pipeline.options import MeasureOptions

    options = MeasureOptions(
        instances=instances,
        classes=classes,  # type: ignore[arg-type]  # it reads names
        pose=pose,
        segmenter=segmenter,
        methods=methods or "all",  # type: ignore[arg-type]  # it reads names
        selector=selector,
        length=length,
        confidence=confidence,
        input_sizes=parse_input_sizes(input_size),
        runtime=_FAST.get(runtime, runtime),
        full_precision=runtime not in _FAST,
        reading=ReadOptions(
            intrinsics=intrinsics,
            depth=depth,
            depth_unit_m=depth_unit,
            burst=burst,
            depth_along=depth_along,
            aligned_to=aligned_to,
        ),
        calibration=calibration,
        camera_up=camera_up,
    )
    path = profile_path(profile)
    if path.name != PACK_PROFILE:
        return options.for_crop(load_profile(path))
    from cucumbervision.pipeline.crop_pack import read_pack

    return read_pack(path.parent).options(options)


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
    from cucumbervision.pipeline.batch import LoopOptions, choose_engine

    return LoopOptions(engine=choose_engine(workers, ray))


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
        command_parameters = [
            parameter for parameter in _parameters(command) if parameter.name != keyword
        ]
        repeated = {parameter.name for parameter in command_parameters} & {
            parameter.name for parameter in shared
        }

        @functools.wraps(command)
        def run(**values: Any) -> None:
            take = {parameter.name: values[parameter.name] for parameter in shared}
            command_values = {
                parameter.name: values[parameter.name] for parameter in command_parameters
            }
            command(**command_values, **{keyword: make(**take)})

        before = [parameter for parameter in command_parameters if parameter.name not in repeated]
        positional = [
            parameter for parameter in before if parameter.kind is not parameter.KEYWORD_ONLY
        ]
        keywords = [parameter for parameter in before if parameter.kind is parameter.KEYWORD_ONLY]
        signature = inspect.Signature(
            [
                *positional,
                *(parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in shared),
                *keywords,
            ]
        )
        vars(run)["__signature__"] = signature
        run.__annotations__ = {
            name: parameter.annotation for name, parameter in signature.parameters.items()
        }
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


Serial = Annotated[
    str | None, typer.Option(help="Serial number of the camera; default: the first one found.")
]
Fps = Annotated[int, typer.Option(min=1, max=90, help="Frame rate of the camera.")]
Retries = Annotated[
    int, typer.Option(min=0, help="Number of attempts to reconnect to a disconnected camera.")
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
