"""Build the service's container and measure with it.

    python benchmarks/container.py [--keep]

Needs `buildah` (a Debian package); it runs as root without a daemon. The image is built from what
git tracks, as `Containerfile` says, with the base image of the local store if there is one, else of
its registry. Its service must refuse to start without a token, run as a user who is not root, and
measure the bundled captures as this installation does.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import subprocess
import tempfile
import time
from pathlib import Path

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import bundled_captures
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.service.client import Client, ServiceError

ROOT = Path(__file__).parent.parent
IMAGE = "localhost/cucumbervision-benchmark"
TITLE = "org.opencontainers.image.title"
PORT = 8617


def buildah(*words: str) -> str:
    """Run buildah and return what it printed; end with what it said if it fails."""
    done = subprocess.run(["buildah", *words], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"buildah {' '.join(words)}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.stdout.strip()


def built() -> None:
    """Build the image from what git tracks."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        tracked = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True)
        subprocess.run(["tar", "-x", "-C", folder], input=tracked.stdout, check=True)
        file = str(Path(folder) / "Containerfile")
        buildah("bud", "--pull=missing", "--format", "docker", "-t", IMAGE, "-f", file, folder)
    told = json.loads(buildah("inspect", "--type", "image", IMAGE))["Docker"]["config"]
    print(f"built in {time.monotonic() - began:.0f} s; user {told['User']}, runs {told['Cmd']}")


def base_image() -> str:
    """Return the base image's name, its identifier here and its title, if it has one."""
    lines = (ROOT / "Containerfile").read_text(encoding="utf-8").splitlines()
    name = [line.split()[1] for line in lines if line.startswith("FROM")][-1]
    told = json.loads(buildah("inspect", "--type", "image", name))
    title = (told["Docker"]["config"].get("Labels") or {}).get(TITLE, "as its registry has it")
    return f"base image {name}, {told['FromImageID'][:12]}: {title}"


def answers(url: str, token: str, process: subprocess.Popen[str]) -> Client:
    """Wait for the service and return a client of it."""
    client = Client(url, token)
    while process.poll() is None:
        try:
            client.health()
        except ServiceError:
            time.sleep(0.5)
        else:
            return client
    raise SystemExit(f"the service ended: {process.stderr and process.stderr.read()}")


def same_lengths(client: Client) -> tuple[int, int]:
    """Return how many fruit have the lengths that this installation gives them, of how many."""
    own, same, fruit = Measurer(MeasureOptions()), 0, 0
    for reference in open_source(bundled_captures()):
        capture = reference.load()
        expected = [row["length_cm"] for row in own.measure(capture).rows()]
        (told,) = client.measure(capture)["captures"]
        found = [row["length_cm"] for row in told["fruit"]]
        same += sum(a == b for a, b in zip(found, expected, strict=True))
        fruit += len(expected)
    return same, fruit


def main() -> int:
    """Build, start, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", action="store_true", help="leave the image there")
    asked = parser.parse_args()
    os.environ.setdefault("BUILDAH_ISOLATION", "chroot")
    os.environ.setdefault("STORAGE_DRIVER", "vfs")
    built()
    print(base_image())
    container = buildah("from", "--pull-never", IMAGE)
    serve = ["--", "cucumbervision", "serve"]
    run = ["buildah", "run"]
    bare = subprocess.run([*run, container, *serve, "--address", "0.0.0.0"], capture_output=True)
    refused = bare.returncode == 2 and b"there is no token" in bare.stderr
    print(f"without a token it {'refuses to start' if refused else 'STARTS'}")
    print(f"user in it: {buildah('run', container, '--', 'id', '-u')}")
    token = secrets.token_hex(16)
    named = ["--env", f"CUCUMBERVISION_TOKEN={token}", container, *serve, "--port", str(PORT)]
    with subprocess.Popen([*run, *named], stderr=subprocess.PIPE, text=True) as process:
        try:
            client = answers(f"http://127.0.0.1:{PORT}", token, process)
            same, fruit = same_lengths(client)
        finally:
            process.terminate()
    print(f"{same} of {fruit} fruit have the lengths that this installation measures")
    buildah("rm", container)
    if not asked.keep:
        buildah("rmi", IMAGE)
    return 0 if refused and same == fruit > 0 else 1


if __name__ == "__main__":
    raise SystemExit(main())
