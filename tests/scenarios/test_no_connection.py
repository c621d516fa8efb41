"""Nothing opens a connection to another machine: watched by the system, not by our own code."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cucumbervision.capture.source import example_captures

_ADDRESS = re.compile(r'sin6?_addr=inet_(?:addr\("|pton\(AF_INET6, ")([^"]+)"')


def test_measuring_with_the_networks_connects_to_nobody(tmp_path: Path) -> None:
    strace = shutil.which("strace")
    if strace is None:
        pytest.skip("strace is not installed")
    log = tmp_path / "calls.txt"
    watched = [strace, "-f", "-qq", "-e", "trace=connect,sendto,sendmsg", "-o", str(log)]
    if subprocess.run([*watched, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets no process be watched")
    code = "from cucumbervision.cli.app import main; main()"
    source = example_captures() / "simulated-row-b"
    words = ["measure", str(source), "--out", str(tmp_path / "out"), "--instances", "models"]
    done = subprocess.run(
        [*watched, sys.executable, "-c", code, *words, "--methods", "M1"],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    reached = set(_ADDRESS.findall(log.read_text()))
    assert reached <= {"127.0.0.1", "::1"}


def test_the_watch_sees_a_connection(tmp_path: Path) -> None:
    strace = shutil.which("strace")
    if strace is None:
        pytest.skip("strace is not installed")
    log = tmp_path / "calls.txt"
    # An address that is reserved for documentation (RFC 5737): nobody answers.
    code = "import socket; s = socket.socket(); s.settimeout(0.1); s.connect_ex(('192.0.2.1', 9))"
    watch = [strace, "-f", "-qq", "-e", "trace=connect", "-o", str(log)]
    if subprocess.run([*watch, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets no process be watched")
    subprocess.run([*watch, sys.executable, "-c", code], check=True)
    assert _ADDRESS.findall(log.read_text()) == ["192.0.2.1"]
