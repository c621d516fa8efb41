"""The camera in a process of its own, which writes its frames into a ring on disk.

It continues while the server is killed and started again:

    python -m cucumbervision_greenhouse.backend.camera_process FOLDER

The server controls it through files in that folder: what to stream (`config.json`), and whether
there is a viewer (`watched`, touched repeatedly; without it the process ends). The process writes
its state to `state.json`, and holds `lock` while it runs.
"""

from __future__ import annotations

import fcntl
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.raw_frames import FrameRing
from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
from cucumbervision.capture.realsense_device import CameraSettings
from cucumbervision.errors import CameraError, CucumberVisionError, DepthError

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture

_CLOCK_S = 1.5  # the camera's time stamps differ by less from this machine's if both use one clock
_LOCKED_S = 2.0  # how long to wait for the lock, which a check holds for a moment
_LOCK_EVERY_S = 0.05


class CameraFolder:
    """The files through which a server and the camera's process communicate.

    Parameters
    ----------
    path : Path
        The folder.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     talk = CameraFolder(Path(folder))
    ...     talk.tell("absent", "no camera")
    ...     talk.ask(CameraConfig(fps=6), unwatched_s=15.0, paced=False)
    ...     config, *_ = talk.asked()
    ...     talk.state(), config.fps, talk.is_held()
    (('absent', 'no camera'), 6, False)
    """

    def __init__(self, path: Path) -> None:
        self.path, self.ring = path, FrameRing(path)
        self._config, self._state = path / "config.json", path / "state.json"
        self._watched, self._lock = path / "watched", path / "lock"

    def ask(self, config: CameraConfig, *, unwatched_s: float, paced: bool) -> None:
        """Write what to stream, and for how long without a viewer."""
        playback = None if config.playback is None else str(config.playback.resolve())
        asked = {"config": {**asdict(config), "playback": playback}}
        text = json.dumps({**asked, "unwatched_s": unwatched_s, "paced": paced})
        with suppress(OSError):
            if self._config.read_text(encoding="utf-8") == text:
                return
        self._replace(self._config, text)

    def asked(self) -> tuple[CameraConfig, float, bool]:
        """Return what to stream, for how long without a viewer, and whether paced."""
        asked = json.loads(self._config.read_text(encoding="utf-8"))
        values: dict[str, Any] = asked["config"]
        settings = CameraSettings(**values.pop("settings"))
        playback = values.pop("playback")
        config = CameraConfig(
            **values, settings=settings, playback=None if playback is None else Path(playback)
        )
        return config, asked["unwatched_s"], asked["paced"]

    def config_version(self) -> int:
        """Return a number that changes with the configuration."""
        return self._config.stat().st_mtime_ns

    def watch(self) -> None:
        """Report a viewer."""
        self.path.mkdir(parents=True, exist_ok=True)
        self._watched.touch()

    def watched_at(self) -> int | None:
        """Return a number that changes with every report of a viewer; None to end the process."""
        with suppress(FileNotFoundError):
            return self._watched.stat().st_mtime_ns
        return None

    def end(self) -> None:
        """Ask the process to release the camera and end."""
        self._watched.unlink(missing_ok=True)

    def tell(self, state: str, message: str = "") -> None:
        """Write the state, 'opening', 'live', 'playing' or 'absent', and its reason."""
        self._replace(self._state, json.dumps([state, message]))

    def state(self) -> tuple[str, str]:
        """Return the state and its reason."""
        with suppress(OSError, ValueError):
            state, message = json.loads(self._state.read_text(encoding="utf-8"))
            return str(state), str(message)
        return "opening", ""

    @contextmanager
    def held(self, patience_s: float = 0.0) -> Iterator[bool]:
        """Hold the lock that allows one process; yield whether it is held."""
        self.path.mkdir(parents=True, exist_ok=True)
        until_s = time.monotonic() + patience_s
        with self._lock.open("ab") as lock:
            while True:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    if time.monotonic() < until_s:
                        time.sleep(_LOCK_EVERY_S)
                        continue
                    yield False
                    return
                yield True
                return

    def is_held(self) -> bool:
        """Return whether a process has the camera."""
        with self.held() as free:
            return not free

    def _replace(self, path: Path, text: str) -> None:
        self.path.mkdir(parents=True, exist_ok=True)
        half = path.with_name(f".{path.name}.{os.getpid()}")
        half.write_text(text, encoding="utf-8")
        half.replace(path)


class _Watch:
    """Tells whether there is a viewer, by the monotonic clock."""

    def __init__(self, folder: CameraFolder) -> None:
        self._folder, self._seen, self._at_s = folder, folder.watched_at(), time.monotonic()

    def is_unwatched(self, unwatched_s: float) -> bool:
        """Return whether there has been no viewer for too long."""
        newest = self._folder.watched_at()
        if newest != self._seen:
            self._seen, self._at_s = newest, time.monotonic()
        return newest is None or time.monotonic() - self._at_s > unwatched_s


def stream(folder: CameraFolder) -> None:
    """Write a camera's frames into the ring while there is a viewer; faults become the state."""
    with folder.held(_LOCKED_S) as is_own:
        if not is_own:
            return
        watch = _Watch(folder)
        folder.tell("opening")
        try:
            while not _stream_once(folder, watch):
                pass  # the recording has ended, or the settings have changed: start again
            folder.tell("opening")
        except CucumberVisionError as error:
            folder.tell("absent", str(error))
        except Exception as error:
            folder.tell("absent", f"{type(error).__name__}: {error}")
            raise


def _stream_once(folder: CameraFolder, watch: _Watch) -> bool:
    """Write frames; return True without a viewer, False if it must start again."""
    version, frame_count = folder.config_version(), 0
    config, unwatched_s, paced = folder.asked()
    state = "live" if config.playback is None else "playing"
    with RealSenseCamera(config) as camera:
        begun_s = time.monotonic()
        while not watch.is_unwatched(unwatched_s):
            if folder.config_version() != version:
                return False
            try:
                capture = camera.capture_burst()
            except DepthError:  # something is too close to the camera: the next frame may be usable
                continue
            except CameraError:
                if config.playback is None or not frame_count:
                    raise
                return False
            folder.ring.write(capture, _taken_s(capture, time.time()))
            if not frame_count:
                folder.tell(state)
            frame_count += 1
            if paced:
                time.sleep(max(0.0, begun_s + frame_count / config.fps - time.monotonic()))
    return True


def _taken_s(capture: Capture, now_s: float) -> float:
    """Return the camera's time stamp if its clock is this machine's, else the time of arrival."""
    camera_s = capture.timestamp_s
    return camera_s if camera_s is not None and 0 <= now_s - camera_s < _CLOCK_S else now_s


if __name__ == "__main__":
    stream(CameraFolder(Path(sys.argv[1])))
