"""Where in a house captures were taken: by the command, their own files or a pose file."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Stop
from cucumbervision.errors import RoundError
from cucumbervision.run.measurer import Measurer
from cucumbervision_greenhouse.rounds.poses import (
    MIDDLE_SD_M,
    PoseLine,
    placed_stop,
    pose_matrix,
    sign_of_side,
)
from cucumbervision_greenhouse.rounds.stop_records import stop_record
from cucumbervision_greenhouse.store.records import CaptureRecord, StopRecord

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.run.measurer import CaptureResult
    from cucumbervision_greenhouse.store.images import ImageStore


_POSE_COLUMNS = ("height_m", "yaw_deg", "pitch_deg", "roll_deg")


@dataclass(frozen=True)
class Place:
    """Where captures were taken, unless their own files or a pose file give it.

    Parameters
    ----------
    row, side : str, optional
        Row of the house, and side of the row.
    position_m, spacing_m : float, optional
        Of the first capture along the row, and how far each next one is from the last.
    position_sd_m : float
        How sure positions are.
    sign : int, optional
        1 where positions get higher to the right in the picture, else -1; by default as
        `poses.sign_of_side` returns for the side.
    poses : mapping of str to PoseLine
        Poses by the capture's name; they take precedence.
    """

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    spacing_m: float | None = None
    position_sd_m: float = MIDDLE_SD_M
    sign: int | None = None
    poses: Mapping[str, PoseLine] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Placed:
    """A capture with its place in a house.

    Parameters
    ----------
    capture : Capture
        Its `stop` gives the place.
    position_sd_m : float, optional
        How sure the position is; None without one.
    pose : ndarray of float64, shape (4, 4)
        The camera's.
    """

    capture: Capture
    position_sd_m: float | None
    pose: NDArray[np.float64]

    @classmethod
    def of(cls, capture: Capture, number: int = 0, place: Place | None = None) -> Placed:
        """Place a capture.

        Parameters
        ----------
        capture : Capture
            The frame.
        number : int
            Number of earlier captures, for its position and step if nothing else gives them.
        place : Place, optional
            Where it was taken.

        Raises
        ------
        RoundError
            If a pose file has no line for it.
        """
        place, stop = place or Place(), capture.stop
        line = place.poses.get(capture.name)
        if place.poses and line is None:
            raise RoundError(
                "the pose file has no line for this capture",
                source=capture.name,
                remedy="add one, or leave the pose file out",
            )
        position = stop.position_m
        if place.position_m is not None:
            position = place.position_m + number * (place.spacing_m or 0.0)
        row, side = place.row or stop.row, place.side or stop.side
        step = number + 1 if stop.step is None else stop.step
        sd, turned = place.position_sd_m, {}
        if line is not None:
            row, side, position = line.row or row, line.side or side, line.position_m
            sd = line.position_sd_m
            turned = {name: getattr(line, name) or 0.0 for name in _POSE_COLUMNS}
        sign = sign_of_side(side) if place.sign is None else place.sign
        pose = pose_matrix(position or 0.0, sign, **turned)
        spot = Stop(row, side, position, step)
        return cls(replace(capture, stop=spot), None if position is None else sd, pose)

    def unmeasured(self, round_key: str) -> StopRecord:
        """Return the stop of this capture as far as it is known before it is measured."""
        camera = CameraModel.of(self.capture.intrinsics).model_dump(mode="json")
        captures = (CaptureRecord(self.capture.name, camera=camera),)
        pose = tuple(self.pose.ravel().tolist())
        return StopRecord("", round_key, **asdict(self.capture.stop), pose=pose, captures=captures)

    def stop(
        self, result: CaptureResult, measurer: Measurer, images: ImageStore | None
    ) -> StopRecord:
        """Return the stop of what was measured in it, with the fruit's offsets along the row.

        It has no key and no round yet. Where nothing was measured, it has the failure.

        Raises
        ------
        StoreError
            If a picture cannot be written.
        """
        sd_m = self.position_sd_m
        stop = stop_record("", [result], measurer, key="", position_sd_m=sd_m, images=images)
        pose = tuple(self.pose.round(9).ravel().tolist())
        return replace(placed_stop(stop, self.pose), pose=pose)
