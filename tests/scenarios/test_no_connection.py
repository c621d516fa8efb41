"""Nothing opens a connection to another machine: watched by the system, not by our own code."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cucumbervision.capture.source import example_captures

_ADDRESS = re.compile(r'sin6?_addr=inet_(?:addr\("|pton\(AF_INET6, ")([^"]+)"')


@pytest.fixture
def reached(tmp_path: Path) -> Callable[..., set[str]]:
    """Run Python under strace, and return the addresses that it connected to."""
    strace, log = shutil.which("strace"), tmp_path / "calls.txt"
    if strace is None:
        pytest.skip("strace is not installed")
    watch = [strace, "-f", "-qq", "-e", "trace=connect,sendto,sendmsg", "-o", str(log)]
    if subprocess.run([*watch, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets no process be watched")

    def run(*words: str) -> set[str]:
        subprocess.run([*watch, sys.executable, *words], check=True, capture_output=True)
        return set(_ADDRESS.findall(log.read_text()))

    return run


def test_measuring_with_the_networks_connects_to_nobody(
    reached: Callable[..., set[str]], tmp_path: Path
) -> None:
    code = "from cucumbervision.cli.app import main; main()"
    source = example_captures() / "simulated-row-b"
    words = ["measure", str(source), "--out", str(tmp_path / "out"), "--instances", "models"]
    assert reached("-c", code, *words, "--methods", "M1") <= {"127.0.0.1", "::1"}


def test_the_watch_sees_a_connection(reached: Callable[..., set[str]]) -> None:
    # An address that is reserved for documentation (RFC 5737): nobody answers.
    code = "import socket; s = socket.socket(); s.settimeout(0.1); s.connect_ex(('192.0.2.1', 9))"
    assert reached("-c", code) == {"192.0.2.1"}
