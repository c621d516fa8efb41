"""Where stops and fruit are along a row: the next stop of a walk, camera poses, pose files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cucumbervision.arrays import Array
from cucumbervision.capture.frames import Stop
from cucumbervision.errors import RoundError, wrap_reader_errors
from cucumbervision.files import parse_model, read_json, read_text
from cucumbervision.methods.matching import SURFACE_DEPTH_SD_M, SURFACE_SD_M
from cucumbervision_greenhouse.store.records import FruitRow, Round, StopRecord, key_of
from cucumbervision_greenhouse.store.repository import Store

_STEP_M = 0.4
_WIDEST_M = 5.0
_SAME_M = 0.005  # positions are typed to the centimetre


_T = TypeVar("_T", bound=Stop)


@dataclass(frozen=True)
class NextPlace:
    """Where the next stop of a walk will be.

    Parameters
    ----------
    row, side : str
        Row of the house, and side of the row.
    position_m : float
        Along the row.
    step_m : float
        From one stop to the next, positive.
    back : bool
        Whether positions fall along the walk.
    """

    row: str = "1"
    side: str = "left"
    position_m: float = 0.0
    step_m: float = _STEP_M
    back: bool = False

    def onward(self) -> NextPlace:
        """Return the place one step farther; no position is below 0.

        Examples
        --------
        >>> NextPlace(position_m=0.8).onward().position_m
        1.2
        >>> NextPlace(position_m=0.8, back=True).onward().position_m
        0.4
        """
        way = -self.step_m if self.back else self.step_m
        at_m = max(round(self.position_m + way, 2), 0.0)
        return replace(self, position_m=at_m)


def next_place(stops: Sequence[Stop]) -> NextPlace:
    """Return the next place of a walk: one step from its last stop, the distance of the last two.

    Parameters
    ----------
    stops : sequence of Stop
        What was taken so far, in order.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> next_place([])
    NextPlace(row='1', side='left', position_m=0.0, step_m=0.4, back=False)
    >>> next_place([Stop("3", "right", 2.0, 5), Stop("3", "right", 1.5, 6)])
    NextPlace(row='3', side='right', position_m=1.0, step_m=0.5, back=True)
    """
    placed = [stop for stop in stops if stop.position_m is not None]
    if not placed:
        return NextPlace()
    last = placed[-1]
    row, side, at_m = last.row or "", last.side or "left", last.position_m or 0.0
    positions_m = [
        stop.position_m or 0.0 for stop in placed if (stop.row, stop.side) == (last.row, last.side)
    ]
    apart = positions_m[-1] - positions_m[-2] if len(positions_m) > 1 else _STEP_M
    plausible = 0.0 < abs(apart) <= _WIDEST_M
    step_m = round(abs(apart), 2) if plausible else _STEP_M
    return NextPlace(row, side, round(at_m, 2), step_m, plausible and apart < 0).onward()


def unless_taken(stop: Stop, taken: Sequence[Stop]) -> Stop:
    """Return a stop at a free place: if its place is taken, one step after the last of its row.

    Two people who walk one round thus never give one place to two stops.

    Parameters
    ----------
    stop : Stop
        The position given by the operator.
    taken : sequence of Stop
        Where the others are, in order.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> earlier_stops = [Stop("3", "left", 0.0), Stop("3", "left", 0.5), Stop("3", "right", 1.0)]
    >>> unless_taken(Stop("3", "left", 0.5), earlier_stops).position_m
    1.0
    >>> unless_taken(Stop("3", "left", 0.25), earlier_stops).position_m
    0.25
    """
    if not stops_at(stop, taken):
        return stop
    same_side = [placed for placed in taken if (placed.row, placed.side) == (stop.row, stop.side)]
    on = next_place(same_side)
    if on.back and on.position_m == 0.0:  # the row ends there: continue from its other end
        on = replace(
            on, position_m=max(placed.position_m or 0.0 for placed in same_side), back=False
        ).onward()
    while stops_at(moved := replace(stop, position_m=on.position_m), same_side):
        on = replace(on, back=False).onward()
    return moved


def stops_at(stop: Stop, stops: Iterable[_T]) -> list[_T]:
    """Return the stops at the place of a stop; none if its place is unknown."""
    at_m = stop.position_m
    if at_m is None:
        return []
    return [
        candidate
        for candidate in stops
        if (candidate.row, candidate.side) == (stop.row, stop.side)
        and candidate.position_m is not None
        and abs(candidate.position_m - at_m) < _SAME_M
    ]


def refuse_taken(store: Store, stop: StopRecord) -> None:
    """Refuse a stop at a place that has one of the same camera: most likely a slip in typing.

    Two cameras on one mast share every place. They are two where their intrinsics differ, or their
    heights.

    Parameters
    ----------
    store : Store
        Where its round is.
    stop : StopRecord
        The stop, at its new place; itself in the round does not count.

    Raises
    ------
    RoundError
        If one is there.
    """
    for there in stops_at(stop, store.stops(stop.round_key)):
        if there.key != stop.key and there.has_camera_of(stop):
            fault = "stop {number} is at {position:.2f} m of that row and side"
            if there.step is None:
                fault = "a stop is at {position:.2f} m of that row and side"
            remedy = "choose another position, or move or delete that stop first"
            raise RoundError(fault, remedy=remedy, number=there.step, position=there.position_m)


def last_step(*walks: Sequence[Stop]) -> int:
    """Return the highest number that a stop has; 0 without any.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> last_step([Stop(step=2), Stop(step=7)], [Stop()])
    7
    """
    return max((stop.step or 0 for stops in walks for stop in stops), default=0)


def sides_of(stops: Iterable[Stop]) -> list[str]:
    """Return the names of a house's row sides from its stops; otherwise left and right.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> sides_of([Stop(side="right")]), sides_of([Stop(side="B"), Stop(side="A")])
    (['left', 'right'], ['A', 'B'])
    """
    usual = ["left", "right"]
    sides = sorted({stop.side for stop in stops if stop.side})
    return usual if set(sides) <= set(usual) else sides


DEMONSTRATION = key_of("demonstration")
"""Key of the demonstration's round."""

_NAME = "Demonstration (computer-made example)"


def is_demonstration(round_key: str) -> bool:
    """Return whether a round is the demonstration, which has simulated captures only."""
    return round_key == DEMONSTRATION


def round_for_capture(store: Store, round_key: str, *, simulated: bool, profile: str = "") -> str:
    """Return the round for a capture: the demonstration for simulated ones, else the open round.

    Parameters
    ----------
    store : Store
        Where the rounds are; the demonstration is begun where it is missing, and comes back where
        it was deleted.
    round_key : str
        The round that is open.
    simulated : bool
        Whether the capture is simulated.
    profile : str
        Crop profile of a demonstration that is begun.

    Raises
    ------
    StoreError
        If the demonstration cannot be begun.
    """
    if not simulated:
        return round_key
    if any(round_summary.key == DEMONSTRATION for round_summary in store.rounds(deleted=True)):
        store.restore_round(DEMONSTRATION)
    elif all(round_summary.key != DEMONSTRATION for round_summary in store.rounds()):
        store.save_round(Round(DEMONSTRATION, _NAME, profile=profile))
    return DEMONSTRATION


MIDDLE_SD_M = 0.03  # how well an operator knows where along the row a stop is

_SIDES_SEEN_BACKWARDS = frozenset({"right", "r", "b", "2"})

_LARGEST_BYTES = 64 * 1024 * 1024


class PoseLine(BaseModel):
    """One line of a pose file.

    Parameters
    ----------
    capture : str
        The capture's name.
    position_m : float
        Along the row.
    position_sd_m : float
        Its standard deviation.
    row, side : str, optional
        Row and side; by default the operator's.
    height_m : float, optional
        Of the camera above the ground; in all lines of a file or in none.
    yaw_deg, pitch_deg, roll_deg : float
        Turned to the right, upwards, and clockwise, against looking straight into the row.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    capture: str = Field(min_length=1)
    position_m: float
    position_sd_m: float = Field(default=MIDDLE_SD_M, gt=0, le=5)
    row: str | None = None
    side: str | None = None
    height_m: float | None = None
    yaw_deg: float = Field(default=0.0, ge=-60, le=60)
    pitch_deg: float = Field(default=0.0, ge=-60, le=60)
    roll_deg: float = Field(default=0.0, ge=-180, le=180)


def read_poses(path: Path) -> dict[str, PoseLine]:
    r"""Read a pose file.

    Parameters
    ----------
    path : Path
        `.csv` or `.json`.

    Returns
    -------
    dict of str to PoseLine
        By the capture's name.

    Raises
    ------
    RoundError
        If it cannot be read, a line is not what it should be, or two name one capture.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "poses.csv"
    ...     _ = path.write_text("capture,position_m,yaw_deg\na,0.41,-2\n")
    ...     read_poses(path)["a"].position_m
    0.41
    """
    with wrap_reader_errors(path, RoundError, "give CSV or JSON"):
        if path.stat().st_size > _LARGEST_BYTES:
            raise RoundError("larger than 64 MiB", source=path, remedy="give one line a capture")
        if path.suffix.lower() == ".json":
            content = read_json(path, RoundError, "give CSV or JSON")
            lines = content if isinstance(content, list) else [content]
        else:
            lines = csv_lines(read_text(path, RoundError))
    poses: dict[str, PoseLine] = {}
    for number, line in enumerate(lines, 1):
        pose = parse_model(PoseLine, line, source=f"{path}, line {number}", error=RoundError)
        if pose.capture in poses:
            raise RoundError(
                f"two lines for capture '{pose.capture}'", source=path, remedy="keep one of them"
            )
        poses[pose.capture] = pose
    if len({pose.height_m is None for pose in poses.values()}) > 1:
        raise RoundError(
            "only some lines give height_m", source=path, remedy="give it in all lines or in none"
        )
    return poses


def csv_lines(text: str) -> list[dict[str, Any]]:
    """Return the lines of a table by its columns, which commas, semicolons or tabs split.

    An empty cell is a value that is not given.
    """
    head, _, _ = text.partition("\n")
    lines = csv.DictReader(io.StringIO(text), delimiter=max(",;\t", key=head.count))
    return [{key: cell for key, cell in line.items() if cell not in ("", None)} for line in lines]


def sign_of_side(side: str | None) -> int:
    """Return whether positions get higher (1) or lower (-1) to the right in the image.

    Who walks towards higher positions and looks at the row on the left has them higher on the
    right, and the reverse: -1 for 'right', 'B' and '2', in any case of letters, else 1.

    Examples
    --------
    >>> sign_of_side("left"), sign_of_side("Right"), sign_of_side(None)
    (1, -1, 1)
    """
    return -1 if (side or "").strip().lower() in _SIDES_SEEN_BACKWARDS else 1


def pose_matrix(
    position_m: float,
    sign: int = 1,
    *,
    height_m: float = 0.0,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
) -> Array:
    """Return the matrix from camera coordinates to the row's: along, up, into the row; metres.

    Parameters
    ----------
    position_m, height_m : float
        Of the camera.
    sign : int
        As `sign_of_side` gives it.
    yaw_deg, pitch_deg, roll_deg : float
        As in `PoseLine`.

    Returns
    -------
    ndarray of float64, shape (4, 4)

    Examples
    --------
    A point 0.7 m before a camera that is turned 10 degrees to the right lies to the right:

    >>> pose_matrix(2.0, yaw_deg=10.0)[:3] @ [0, 0, 0.7, 1]
    array([2.12155372, 0. , 0.68936543])
    """
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = np.diag([float(sign), -1.0, 1.0])
    if yaw_deg or pitch_deg or roll_deg:  # most are level, and a house has thousands
        turned = Rotation.from_euler("YXZ", [yaw_deg, pitch_deg, roll_deg], degrees=True)
        matrix[:3, :3] @= turned.as_matrix()
    matrix[:3, 3] = position_m, height_m, 0.0
    return matrix


def stored_pose(numbers: Sequence[float], side: str | None) -> Array:
    """Return a stop's pose from its 16 stored numbers; without them, one level at position 0."""
    if len(numbers) == 16:
        return np.reshape(np.array(numbers, np.float64), (4, 4))
    return pose_matrix(0.0, sign_of_side(side))


_AXIS_SD_M = 0.005  # of a fitted tube's middle

_PART_SHARE = 0.15  # of the length: how far the middle of a part is from the fruit's own

_TURN_SD = 0.02  # radians: how far a camera is turned off its pose


def offset_of(fruit: FruitRow, pose: Array) -> tuple[Array, Array] | None:
    """Return how far a fruit is from its camera along the row, upwards and into the row.

    Where part of it is hidden, its middle is unsure along the fruit, which hangs.

    Parameters
    ----------
    fruit : FruitRow
        With its middle in camera coordinates: right, down, away.
    pose : ndarray of float64, shape (4, 4)
        As `pose_matrix` gives it.

    Returns
    -------
    tuple of ndarray of float64, each of shape (3,), or None
        The offset and its standard deviations, metres; None where the middle is not known.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> from cucumbervision.methods.result import Length
    >>> middle = {"centre_x_m": 0.2, "centre_y_m": 0.1, "centre_z_m": 0.7}
    >>> middle |= {"diameter_max_m": 0.04, "hidden_share": 0.5}
    >>> cut = FruitRow(1, length=Length(0.3), **middle)
    >>> [part.round(3).tolist() for part in offset_of(cut, pose_matrix(3.0, -1))]
    [[-0.2, -0.1, 0.7], [0.005, 0.045, 0.006]]
    """
    middle = (fruit.centre_x_m, fruit.centre_y_m, fruit.centre_z_m)
    if None in middle:
        return None
    offset = np.asarray(pose[:3, :3] @ np.array(middle, np.float64))
    tube = fruit.diameter_max_m is not None
    across = _AXIS_SD_M if tube else SURFACE_SD_M
    up = np.hypot(across, _PART_SHARE * (fruit.length_m or 0.2)) if fruit.partial else across
    # Turning moves all fruit of a capture along alike, which their stop takes up; what is left
    # is the difference in depth between its left and its right.
    depth = np.hypot(across if tube else SURFACE_DEPTH_SD_M, _TURN_SD * abs(float(offset[0])))
    return offset, np.array([across, up, depth])
