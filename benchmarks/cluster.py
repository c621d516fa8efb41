"""Measure on a Ray cluster of two nodes, one of which is killed meanwhile; needs extra 'cluster'.

    python benchmarks/cluster.py [--captures 60] [--seed 1]

Both nodes are Ray's own on this machine, each with one CPU and a worker of its own, joined over
loopback as two machines would be. The bundled captures, again and again, are measured with
`measure --engine ray --address …`; once the seed's share of them is done, signal 9 ends one node
with all that runs there. The tables must be those of one process without a cluster, bit by bit.
"""

from __future__ import annotations

import argparse
import atexit
import os
import random
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from speed import copies

from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.run import measure_inputs

PORT = 6399
ADDRESS = f"127.0.0.1:{PORT}"
TABLES = ("measurements.csv", "failures.csv")
ENVIRONMENT = {
    **os.environ,
    "RAY_USAGE_STATS_ENABLED": "0",
    # Whatever an earlier cluster of this user has left behind.
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
}
BIN = Path(sys.executable).parent


def processes() -> dict[int, tuple[int, str]]:
    """Return parent and command of every process."""
    lines = subprocess.run(["ps", "-eo", "pid=,ppid=,args="], capture_output=True, text=True)
    found = (line.split(None, 2) for line in lines.stdout.splitlines())
    return {int(pid): (int(parent), words) for pid, parent, *rest in found for words in [rest[0]]}


def nodes() -> list[int]:
    """Return the process of each node, the head's first."""
    return sorted(p for p, (_, words) in processes().items() if "/raylet/raylet " in words)


def start_node(*words: str) -> None:
    """Start a node with one CPU."""
    own = ["--num-cpus", "1", "--node-ip-address", "127.0.0.1", *words]
    command = [str(BIN / "ray"), "start", *own]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"a node does not start:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")


def stop_nodes() -> None:
    """End all that Ray runs on this machine."""
    subprocess.run([BIN / "ray", "stop", "--force"], capture_output=True)


def measuring(node: int) -> int:
    """Return how many actors measure on a node."""
    return sum(
        parent == node and words.startswith("ray::") and "_Measuring" in words
        for parent, words in processes().values()
    )


def kill_node(node: int) -> None:
    """End a node and all that runs on it at once, as a machine that loses its power."""
    mine = [pid for pid, (parent, _) in processes().items() if parent == node]
    for pid in (node, *mine):
        os.kill(pid, signal.SIGKILL)


def main() -> int:
    """Start the nodes, measure, kill one, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    share = random.Random(asked.seed).uniform(0.2, 0.6)
    atexit.register(stop_nodes)
    with tempfile.TemporaryDirectory() as folder:
        house, out, alone = (Path(folder) / name for name in ("house", "out", "alone"))
        copies(house, asked.captures)
        stop_nodes()
        start_node("--head", "--port", str(PORT), "--include-dashboard=false")
        start_node("--address", ADDRESS)
        _, second = nodes()
        command = [str(BIN / "cucumbervision"), "measure", str(house), "--out", str(out)]
        ran = [*command, "--engine", "ray", "--address", ADDRESS, "--workers", "2"]
        most, done = [0, 0], 0
        with subprocess.Popen(ran, env=ENVIRONMENT, stdout=subprocess.DEVNULL) as process:
            while process.poll() is None and done < share * asked.captures:
                most = [max(a, measuring(b)) for a, b in zip(most, nodes(), strict=True)]
                done = sum(len(one.read_bytes().splitlines()) for one in out.glob("journal/*"))
                time.sleep(0.1)
            kill_node(second)
            code = process.wait()
        stop_nodes()
        measure_inputs([house], alone, MeasureOptions())
        same = [name for name in TABLES if (out / name).read_bytes() == (alone / name).read_bytes()]
        rows = len((out / TABLES[0]).read_text(encoding="utf-8").splitlines()) - 1
    print(f"actors that measured: {most[0]} on the first node, {most[1]} on the second")
    print(f"the second was killed after {done} of {asked.captures} captures; exit code {code}")
    print(f"{rows} rows; as without a cluster, bit by bit: {', '.join(same) or 'none'}")
    kept = code == 0 and min(most) > 0 and done < asked.captures and len(same) == len(TABLES)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
