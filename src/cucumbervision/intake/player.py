"""The process that plays a recording: it limits itself, then reads and writes captures."""

from __future__ import annotations

import json
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from cucumbervision.errors import CucumberVisionError, MissingExtraError
from cucumbervision.intake.recordings import REPORT

__all__ = ["leave_network", "limit_itself", "main", "play"]


def limit_itself(limits: dict[str, Any]) -> None:
    """Set this process's limits; what the system has not is left to who watches it."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return
    cpu = max(1, int(limits["cpu_s"]))
    wanted = {
        resource.RLIMIT_CPU: cpu,
        resource.RLIMIT_AS: int(limits["memory_bytes"]),
        resource.RLIMIT_FSIZE: int(limits["output_bytes"]),
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: 256,
    }
    for kind, most in wanted.items():
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))
    # Whoever watches may have been killed: it ends by itself a little later.
    signal.alarm(int(limits["wall_s"]) + 5)


def leave_network() -> bool:
    """Cut this process off from every network, where the system lets it; say whether it did.

    Linux with user namespaces (`unshare(2)`): the process keeps its files but sees no interface.
    """
    if sys.platform != "linux":
        return False
    import ctypes

    new_user, new_net = 0x10000000, 0x40000000
    return bool(ctypes.CDLL(None).unshare(new_user | new_net) == 0)


def play(path: Path, folder: Path, burst: int, name: str, most: int) -> None:
    """Write a recording's captures as native folders 000000, 000001, …, and its errors as lines."""
    from cucumbervision.capture.readers import ReadOptions, open_source
    from cucumbervision.capture.writer import write_native

    with (folder / REPORT).open("a", encoding="utf-8") as report:

        def tell(error: CucumberVisionError) -> None:
            missing = "pyrealsense2" if isinstance(error, MissingExtraError) else ""
            line = {"code": error.code, "message": error.message, "remedy": error.remedy}
            report.write(json.dumps(line | {"missing": missing}) + "\n")
            report.flush()

        try:
            for number, ref in enumerate(open_source(path, ReadOptions(burst=burst))):
                if number == most:
                    raise CucumberVisionError(
                        f"has more than {most} captures, the rest is left out",
                        remedy="send it in parts",
                    )
                try:
                    capture = replace(ref.load(), name=f"{name}_{ref.frame:06d}", source=name)
                except CucumberVisionError as error:
                    tell(error)
                    continue
                write_native(capture, folder / f"{number:06d}")
        except CucumberVisionError as error:
            tell(error)


def main() -> None:
    """Take the order from the command line."""
    order = json.loads(sys.argv[1])
    leave_network()
    limit_itself(order["limits"])
    most = order["limits"]["captures"]
    play(Path(order["path"]), Path(order["folder"]), order["burst"], order["name"], most)


if __name__ == "__main__":
    main()
