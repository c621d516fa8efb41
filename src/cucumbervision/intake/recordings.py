"""Play recordings from untrusted senders in a separate process with limits."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.readers import RECORDING_SUFFIXES, open_source
from cucumbervision.capture.readers.native import MANIFEST, write_native
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, fail, safe_name
from cucumbervision.errors import (
    CameraError,
    CaptureError,
    CucumberVisionError,
    DepthError,
    IntrinsicsError,
    MissingExtraError,
)
from cucumbervision.intake.archives import RecordingLimits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.capture.frames import Capture

_REPORT = "report.jsonl"

_POLL_S = 0.05

_TOLD = {
    error.__name__: error for error in (CameraError, CaptureError, DepthError, IntrinsicsError)
}

_OWN_NAMES = re.compile(r"(\d{6})(/(capture\.json|(color|depth)_\d{6}\.png))?|report\.jsonl")

# Environment variables of the process; no others are passed on.
_KEPT = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "SYSTEMROOT", "LANG")


def play_in_process(
    path: Path,
    folder: Path,
    limits: RecordingLimits | None = None,
    *,
    burst: int = 5,
    command: tuple[str, ...] = ("-m", "cucumbervision.intake.recordings"),
) -> list[CucumberVisionError]:
    """Play a recording in a limited process, and write its captures as native folders.

    Parameters
    ----------
    path : Path
        A `.bag` or `.db3` file.
    folder : Path
        Output folder; created, with a subfolder for each capture.
    limits : RecordingLimits, optional
        Limits of the process. CPU time, memory and file size are limited only if the system has
        `setrlimit`.
    burst : int
        Number of frames per capture.
    command : tuple of str
        Arguments of Python.

    Returns
    -------
    list of CucumberVisionError
        Errors; the existing captures are complete nevertheless.

    Raises
    ------
    OSError
        If the folder cannot be created or the process cannot be started.
    """
    limits = limits or RecordingLimits()
    home = folder / "home"  # for files that libraries write to the home folder
    home.mkdir(parents=True)
    order = json.dumps(
        {"path": str(path.resolve()), "folder": str(folder.resolve()), "burst": burst}
        | {"limits": asdict(limits)}
    )
    process = subprocess.Popen(
        # -P: do not import from the working directory, which contains the recording.
        [sys.executable, "-P", *command, order],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=home,
        env={name: os.environ[name] for name in _KEPT if name in os.environ}
        | {"HOME": str(home.resolve())},
        start_new_session=True,
    )
    try:
        fault = _watch(process, folder, limits)
    finally:
        _kill(process)
        shutil.rmtree(home)
    return _collect(folder, fault, path)


def _watch(process: subprocess.Popen[bytes], folder: Path, limits: RecordingLimits) -> str:
    """Wait for the process; return its fault or an empty string."""
    looked = moved = time.monotonic()
    until, written = looked + limits.wall_s, 0
    while True:
        with suppress(subprocess.TimeoutExpired):
            code = process.wait(_POLL_S)
            return "" if code == 0 else _ending(code)
        now_s = time.monotonic()
        if now_s > until:
            return f"took longer than {limits.wall_s:g} s"
        if now_s > looked + 0.5:
            looked, before, written = now_s, written, _size(folder)
            if written > limits.output_bytes:
                return f"unpacks to more than {limits.output_bytes / 1e6:g} MB"
            if written != before:
                moved = now_s
            elif now_s > moved + limits.still_s:
                return f"has given nothing for {limits.still_s:g} s"


def _ending(code: int) -> str:
    if -code in (getattr(signal, "SIGXCPU", None), getattr(signal, "SIGALRM", None)):
        return "took too long"
    if -code == getattr(signal, "SIGXFSZ", None):
        return "unpacks to more than is accepted"
    return f"broke the player ({f'signal {-code}' if code < 0 else f'exit code {code}'})"


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill the process and its children."""
    if os.name == "posix":
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()


def _size(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):
            total += path.lstat().st_size
    return total


def _collect(folder: Path, fault: str, source: Path) -> list[CucumberVisionError]:
    errors: list[CucumberVisionError] = []
    if strange := [p for p in sorted(folder.rglob("*")) if not _is_own(p, folder)]:
        shutil.rmtree(folder)
        folder.mkdir()
        fault = f"broke the player, which wrote {strange[0].name[:40]!r}"
    for line in _report_lines(folder):
        if line.get("missing") == "pyrealsense2":
            errors.append(MissingExtraError("pyrealsense2", "camera"))
        else:
            kind = _TOLD.get(str(line.get("code")), CaptureError)
            message, remedy = (str(line.get(key, ""))[:300] for key in ("message", "remedy"))
            errors.append(kind(message, source=source, remedy=remedy))
    if fault:
        captures = len([*folder.glob(f"*/{MANIFEST}")])
        remark = f"; {captures} captures before that are kept" if captures else ""
        errors.append(
            CaptureError(f"{fault}{remark}", source=source, remedy="copy or record it again")
        )
    return errors


def _is_own(path: Path, folder: Path) -> bool:
    name = path.relative_to(folder).as_posix()
    return bool(_OWN_NAMES.fullmatch(name)) and not path.is_symlink()


def _report_lines(folder: Path) -> list[dict[str, Any]]:
    path = folder / _REPORT
    if not path.is_file():
        return []
    lines = []
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines()[:1000]:
        with suppress(ValueError):
            line = json.loads(text)
            if isinstance(line, dict):
                lines.append(line)
    return lines


def open_guarded(
    path: Path | str, options: ReadOptions | None = None, limits: RecordingLimits | None = None
) -> CaptureSource:
    """Open a source of captures; recordings are played in a limited process.

    Parameters
    ----------
    path : Path or str
        See `open_source`.
    options : ReadOptions, optional
        See `open_source`.
    limits : RecordingLimits, optional
        Limits of the process.

    Returns
    -------
    CaptureSource
        The same captures as from `open_source`. A recording is played completely when the iteration
        starts; its temporary files are deleted when the iteration ends.

    Raises
    ------
    CucumberVisionError
        As `open_source`.
    """
    path, options = Path(path), options or ReadOptions()
    if not path.is_file() or path.suffix.lower() not in RECORDING_SUFFIXES:
        return open_source(path, options)
    return CaptureSource(path, "recording", lambda: _refs(path, options, limits))


def _refs(path: Path, options: ReadOptions, limits: RecordingLimits | None) -> Iterator[CaptureRef]:
    name = safe_name(path.stem)
    with tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
        out = Path(folder) / "captures"
        errors = play_in_process(path, out, limits, burst=options.burst)
        if any(out.glob(f"*/{MANIFEST}")):
            for ref in open_source(out, replace(options, depth_unit_m=None)):
                # The files are deleted when the iteration ends, so the content cannot be hashed.
                capture_name = f"{name}_{ref.frame:06d}"
                load = partial(_load, ref, capture_name, str(path))
                yield CaptureRef(capture_name, ref.frame, load, f"{path} frame {ref.frame}")
        for error in errors:
            # Captures before a fault are complete; the fault is reported as a failing capture.
            yield CaptureRef(f"{name}_end", -1, partial(fail, error))


def _load(ref: CaptureRef, name: str, source: str) -> Capture:
    return replace(ref.load(), name=name, source=source)


def limit_this_process(limits: dict[str, Any]) -> None:
    """Set the resource limits of this process, as far as the system supports them."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return
    cpu = max(1, int(limits["cpu_s"]))
    soft_limits = {
        resource.RLIMIT_CPU: cpu,
        resource.RLIMIT_AS: int(limits["memory_bytes"]),
        resource.RLIMIT_FSIZE: int(limits["output_bytes"]),
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: 256,
    }
    for kind, soft_limit in soft_limits.items():
        _, hard = resource.getrlimit(kind)
        soft_limit = soft_limit if hard == resource.RLIM_INFINITY else min(soft_limit, hard)
        resource.setrlimit(kind, (soft_limit, soft_limit))
    # Exit soon after the deadline, even if the watching process has been killed.
    signal.alarm(int(limits["wall_s"]) + 5)


def drop_network() -> bool:
    """Disconnect this process from all networks if possible; return whether it succeeded.

    Linux with user namespaces (`unshare(2)`): the process keeps its files but sees no interface.
    """
    if sys.platform != "linux":
        return False
    import ctypes

    new_user, new_net = 0x10000000, 0x40000000
    return bool(ctypes.CDLL(None).unshare(new_user | new_net) == 0)


def _play(path: Path, folder: Path, burst: int, most_captures: int) -> None:
    """Write the captures of a recording as native folders 000000, 000001, … and report errors."""
    with (folder / _REPORT).open("a", encoding="utf-8") as report:

        def tell(error: CucumberVisionError) -> None:
            missing = "pyrealsense2" if isinstance(error, MissingExtraError) else ""
            line = {"code": error.code, "message": error.message, "remedy": error.remedy}
            report.write(json.dumps(line | {"missing": missing}) + "\n")
            report.flush()

        try:
            for number, ref in enumerate(open_source(path, ReadOptions(burst=burst))):
                if number == most_captures:
                    raise CucumberVisionError(
                        f"has more than {most_captures} captures, the rest is left out",
                        remedy="send it in parts",
                    )
                try:
                    capture = ref.load()
                except CucumberVisionError as error:
                    tell(error)
                    continue
                write_native(capture, folder / f"{number:06d}")
        except CucumberVisionError as error:
            tell(error)


def _main() -> None:
    """Run with the arguments of the command line."""
    order = json.loads(sys.argv[1])
    drop_network()
    limit_this_process(order["limits"])
    most_captures = order["limits"]["captures"]
    _play(Path(order["path"]), Path(order["folder"]), order["burst"], most_captures)


if __name__ == "__main__":
    _main()
