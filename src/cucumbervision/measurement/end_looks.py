"""Add the evaluation of both ends by a network to measured fruit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from cucumbervision.instances.crops import EndCrop, EndLook, end_crop
from cucumbervision.instances.instance import MaskSource
from cucumbervision.measurement.flags import DOUBTFUL_END, Flag
from cucumbervision.measurement.result import LengthDefinition, MethodName
from cucumbervision.measurement.selector import with_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.intervals import IntervalModels
    from cucumbervision.measurement.result import Fruit, Measurement

LookAtEnds: TypeAlias = Callable[[Sequence[EndCrop]], list[EndLook]]
"""Looks at many crops in one batch, as `EndLooker.look`."""

DOUBTFUL = 0.3
"""Probability from which an end that may go on out of sight is named."""

_DRAWN = (MaskSource.DETECTOR, MaskSource.SAM, MaskSource.SEGMENTER)


def with_end_looks(
    capture: Capture,
    fruit: Sequence[Fruit],
    look: LookAtEnds,
    definition: LengthDefinition = LengthDefinition.CENTRELINE,
    *,
    scale_known: bool = False,
    models: IntervalModels | None = None,
) -> list[Fruit]:
    """Return the fruit of a capture with the evaluation of their ends, computed in one batch.

    Intervals are computed again. A fruit whose end may continue out of sight is flagged with the
    position of that end in the picture, unless it has another flag for a lower bound.

    Parameters
    ----------
    capture : Capture
        The frame.
    fruit : sequence of Fruit
        Fruit without M6, or with masks that no network drew, are returned unchanged.
    look : callable
        Evaluates crops of ends.
    definition : LengthDefinition
        Definition of length, as for `measure_fruit`.
    scale_known : bool
        Whether the camera's depth scale is known, as for `measure_fruit`.
    models : IntervalModels, optional
        Interval models; by default those of the package.
    """
    tubes = {k: tube for k, measured in enumerate(fruit) if (tube := _tube(measured)) is not None}
    if not tubes:
        return list(fruit)
    crops = [crop for k, tube in tubes.items() for crop in _crops(capture, fruit[k], tube)]
    looks = look(crops)
    pairs = dict(zip(tubes, zip(looks[::2], looks[1::2], strict=True), strict=True))
    measure_again = partial(
        with_length, definition=definition, scale_known=scale_known, models=models
    )
    return [
        measure_again(_looked_at(capture, measured, tubes[k], pairs[k])) if k in tubes else measured
        for k, measured in enumerate(fruit)
    ]


def _tube(fruit: Fruit) -> Measurement | None:
    tube, drawn = fruit.measurements.get(MethodName.M6), fruit.mask_source in _DRAWN
    return tube if tube is not None and tube.fit is not None and drawn else None


def _crops(capture: Capture, fruit: Fruit, tube: Measurement) -> list[EndCrop]:
    if tube.fit is None or fruit.mask is None:
        return []
    traits = tube.fit.traits
    lines = traits.axis_m, traits.axis_m[::-1]
    return [
        end_crop(
            capture.color,
            capture.depth_m,
            fruit.mask,
            capture.intrinsics,
            line,
            traits.diameter_max_m,
        )
        for line in lines
    ]


def _looked_at(
    capture: Capture, fruit: Fruit, tube: Measurement, looks: tuple[EndLook, EndLook]
) -> Fruit:
    if tube.fit is None:
        return fruit
    looked_at = replace(tube, fit=replace(tube.fit, looks=looks))
    selected = looked_at if fruit.selected is tube else fruit.selected
    measurements = {**fruit.measurements, MethodName.M6: looked_at}
    fruit = replace(fruit, measurements=measurements, selected=selected)
    fruit = fruit.unflagged(Flag.INTERVAL_TOO_WIDE)
    if fruit.at_least or selected is not looked_at:
        return fruit
    ends_px = capture.intrinsics.project(tube.fit.traits.axis_m[[0, -1]])
    doubtful = [
        end_flag(ends_px[k] - ends_px[1 - k])
        for k, look in enumerate(looks)
        if look.covered >= DOUBTFUL
    ]
    return fruit.flagged(*doubtful)


def end_flag(outward_px: NDArray[np.float64]) -> Flag:
    """Return the flag of a doubtful end by its outward direction in the picture.

    Examples
    --------
    >>> [str(end_flag(np.array(out))) for out in ([5.0, 40.0], [-30.0, 2.0])]
    ['lower-end-doubtful', 'left-end-doubtful']
    """
    across, down = outward_px.tolist()
    if abs(down) >= abs(across):
        return DOUBTFUL_END["lower" if down > 0 else "upper"]
    return DOUBTFUL_END["right" if across > 0 else "left"]
