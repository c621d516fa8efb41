"""A store on the network that goes while the program reads from it and writes to it."""

from __future__ import annotations

import logging
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError
from cucumbervision_lab.robustness.trial import MASKS, Outcome, begin, captures, command, ended
from cucumbervision_lab.robustness.trial import rows_in as rows_in_folder

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_KEYS = {"AWS_ACCESS_KEY_ID": "house", "AWS_SECRET_ACCESS_KEY": "cucumber"}


def s3_gone(folder: Path, gone_s: float = 60.0) -> Outcome:
    """Stop an S3 server on loopback in the middle of `measure`, and start it again.

    Parameters
    ----------
    folder : Path
        Empty.
    gone_s : float
        Seconds without a server.
    """
    with _server() as server:
        url = "http://{}:{}".format(*server.get_host_and_port())
        env = {"AWS_ENDPOINT_URL": url, "AWS_DEFAULT_REGION": "us-east-1", **_KEYS}
        store = _store(url)
        store.mkdir("house")
        store.put(str(captures(folder / "in", 6)), "house/captures", recursive=True)
        words = ("measure", "s3://house/captures", *MASKS)
        command(*words, "--out", folder / "whole", env=env)
        process = begin(*words, "--out", "s3://house/out", env=env)
        while process.poll() is None and not store.glob("house/out/overlays/*.png"):
            time.sleep(0.05)
        server.stop()
        time.sleep(gone_s)
        met = process.poll() is None
        server.start()
        ran = ended(process)
        store = _store(url)
        (folder / "out").mkdir()
        store.get("house/out/measurements.csv", str(folder / "out" / "measurements.csv"))
    whole, rows = rows_in_folder(folder / "whole"), rows_in_folder(folder / "out")
    kept = f"{len(rows)} of {len(whole)} rows; the run waited and went on"
    seen = ran.line("does not answer").replace(url, "the server")
    lost = not met or ran.code != 0 or rows != whole
    return Outcome(f"S3 is gone for {gone_s:.0f} s", seen, kept, lost)


@contextmanager
def _server() -> Iterator[Any]:
    """Run an S3 server; what it holds outlives its stops."""
    try:
        from moto.server import ThreadedMotoServer
    except ImportError:
        raise CucumberVisionError(
            "moto is not installed", remedy="pip install moto[s3,server]"
        ) from None
    from urllib.request import Request, urlopen

    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # else it prints each request
    server = ThreadedMotoServer("127.0.0.1", _free_port(), verbose=False)
    server.start()
    # What an earlier server of this process held is still there.
    reset = "http://{}:{}/moto-api/reset".format(*server.get_host_and_port())
    urlopen(Request(reset, method="POST")).close()
    try:
        yield server
    finally:
        server.stop()


def _free_port() -> int:
    """Return a port that the server gets again when it is started anew."""
    import socket

    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def _store(url: str) -> Any:
    from importlib import import_module

    # It has no types.
    return import_module("s3fs").S3FileSystem(
        endpoint_url=url,
        key=_KEYS["AWS_ACCESS_KEY_ID"],
        secret=_KEYS["AWS_SECRET_ACCESS_KEY"],
        use_listings_cache=False,
        skip_instance_cache=True,
    )
