"""Camera poses of captures, and the positions of fruit in the row's coordinates."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from cucumbervision.errors import RoundError, wrap_reader_errors
from cucumbervision.methods.matching import SURFACE_DEPTH_SD_M, SURFACE_SD_M
from cucumbervision_greenhouse.store.records import FruitRow

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
    from cucumbervision.files import parse_model, read_json, read_text

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
    """Return whether positions get higher (1) or lower (-1) to the right in the picture.

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
) -> NDArray[np.float64]:
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


def stored_pose(numbers: Sequence[float], side: str | None) -> NDArray[np.float64]:
    """Return a stop's pose from its 16 stored numbers; without them, one level at position 0."""
    if len(numbers) == 16:
        return np.reshape(np.array(numbers, np.float64), (4, 4))
    return pose_matrix(0.0, sign_of_side(side))


_AXIS_SD_M = 0.005  # of a fitted tube's middle

_PART_SHARE = 0.15  # of the length: how far the middle of a part is from the fruit's own

_TURN_SD = 0.02  # radians: how far a camera is turned off its pose


def offset_of(
    fruit: FruitRow, pose: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
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
