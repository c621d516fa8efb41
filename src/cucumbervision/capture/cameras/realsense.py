"""A RealSense D4xx, live: bursts of colour with depth aligned to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from cucumbervision.capture.cameras.realsense_sdk import AlignedFrame, AlignedStream, play_file
from cucumbervision.capture.depth import require_readings
from cucumbervision.capture.frames import Capture, Stop, fuse_burst
from cucumbervision.errors import CameraError

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from cucumbervision.capture.intrinsics import Intrinsics

__all__ = ["CameraConfig", "RealSenseCamera"]


@dataclass(frozen=True)
class CameraConfig:
    """What to stream.

    Parameters
    ----------
    serial : str, optional
        The camera's serial number; without it the first one found.
    width, height : int
        Size of both streams, pixels.
    fps : int
        Frames a second.
    burst : int
        Frames fused to one capture.
    warm_up : int
        Frames thrown away at the start, while exposure settles.
    timeout_s : float
        How long to wait for a frame.
    playback : Path, optional
        A recording to play through the same driver in place of a camera; size, rate and serial
        are then the recording's.
    """

    serial: str | None = None
    width: int = 1280
    height: int = 720
    fps: int = 30
    burst: int = 5
    warm_up: int = 30
    timeout_s: float = 5.0
    playback: Path | None = None

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.fps, self.burst) < 1 or self.warm_up < 0:
            raise ValueError("size, fps and burst must be positive, warm_up not negative")
        if not self.timeout_s > 0:
            raise ValueError("timeout_s must be positive")


class RealSenseCamera:
    """A camera as a context manager: `with RealSenseCamera() as camera: camera.capture_burst()`.

    Parameters
    ----------
    config : CameraConfig, optional
        What to stream.

    Raises
    ------
    CameraError
        On entering, if there is no such camera, or it is in use.
    MissingExtraError
        On entering, if pyrealsense2 is not installed.
    """

    def __init__(self, config: CameraConfig | None = None) -> None:
        self.config = config or CameraConfig()
        source = self.config.playback or (
            f"camera {self.config.serial}" if self.config.serial else "camera"
        )
        self._source = source
        self._stream = AlignedStream(
            self._configure if self.config.playback is None else play_file(self.config.playback),
            source=source,
            playback=self.config.playback is not None,
            timeout_s=self.config.timeout_s,
        )
        self._open = False

    def __enter__(self) -> Self:
        self._stream.__enter__()
        self._open = True
        try:
            for _ in range(self.config.warm_up):
                self._next_frame()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let the camera go; harmless when it is not open."""
        self._open = False
        self._stream.close()

    @property
    def intrinsics(self) -> Intrinsics:
        """The colour stream's, at the size that is streamed; once the camera is open."""
        self._require_open()
        return self._stream.intrinsics

    def capture_burst(self, name: str | None = None, *, stop: Stop | None = None) -> Capture:
        """Take a burst and fuse it to one capture.

        Parameters
        ----------
        name : str, optional
            What to call it; by default 'capture_' and its first frame's number.
        stop : Stop, optional
            Where it is taken.

        Returns
        -------
        Capture
            `frame` is the camera's own number of the burst's first frame.

        Raises
        ------
        CameraError
            If the camera is not open, sends nothing in time, or the played recording is over.
        DepthError
            If no pixel of the burst has a reading between 0.1 and 5 m.
        """
        frames = [self._next_frame() for _ in range(self.config.burst)]
        color, depth_m, kept = fuse_burst([f.color for f in frames], [f.depth_m for f in frames])
        require_readings(depth_m, source=self._source)
        return Capture(
            color,
            depth_m,
            self._stream.intrinsics,
            name or f"capture_{frames[0].number:06d}",
            frame=frames[0].number,
            burst_frame=kept,
            burst_size=len(frames),
            stop=stop or Stop(),
            timestamp_s=frames[kept].timestamp_s,
            source=str(self._source),
            provenance={"reader": "camera", **self._stream.device},
        )

    def _configure(self, rs: Any, config: Any) -> None:
        c = self.config
        if c.serial:
            config.enable_device(c.serial)
        config.enable_stream(rs.stream.depth, c.width, c.height, rs.format.z16, c.fps)
        config.enable_stream(rs.stream.color, c.width, c.height, rs.format.rgb8, c.fps)

    def _next_frame(self) -> AlignedFrame:
        self._require_open()
        frame = self._stream.read()
        if frame is None:
            raise CameraError(
                "the recording is over", source=self._source, remedy="play a longer one"
            )
        return frame

    def _require_open(self) -> None:
        if not self._open:
            raise CameraError(
                "the camera is not open",
                source=self._source,
                remedy="use it in a 'with' block",
            )
