"""A PostgreSQL server of one's own, in a temporary folder, for tests.

It listens on a Unix socket alone, in a folder that nobody else may enter. PostgreSQL refuses to
run as root; where the caller is root, the server runs as the user `postgres` or `nobody`.
"""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

_TOOLS = ("initdb", "pg_ctl", "postgres")


def _folder_of_tools() -> Path | None:
    """Find PostgreSQL's programs: on the path, or where Debian keeps them."""
    on_path = shutil.which("initdb")
    places = [Path(on_path).resolve().parent] if on_path else []
    places += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((p for p in places if all((p / tool).exists() for tool in _TOOLS)), None)


def _user() -> pwd.struct_passwd | None:
    """Return the user that the server runs as, or None where root finds none."""
    if os.getuid() != 0:
        return pwd.getpwuid(os.getuid())
    known = {entry.pw_name: entry for entry in pwd.getpwall()}
    return known.get("postgres") or known.get("nobody")


def missing_reason() -> str:
    """Say why no server can be started here; empty where one can."""
    if _folder_of_tools() is None:
        return "PostgreSQL's initdb, pg_ctl and postgres are not installed"
    if _user() is None:
        return "PostgreSQL does not run as root, and there is no user postgres or nobody"
    return ""


class Cluster:
    """A running server.

    Parameters
    ----------
    folder : Path
        Its data and its socket.
    """

    def __init__(self, folder: Path) -> None:
        tools, user = _folder_of_tools(), _user()
        if tools is None or user is None:
            raise RuntimeError(missing_reason())
        self._tools, self._user, self._folder = tools, user, folder
        if os.getuid() == 0:
            os.chown(folder, user.pw_uid, user.pw_gid)
        said = ("-A", "trust", "-U", "tester", "-E", "UTF8", "--no-sync")
        self._run("initdb", "-D", str(self._data), *said)

    @property
    def _data(self) -> Path:
        return self._folder / "data"

    def _run(self, tool: str, *arguments: str) -> None:
        as_root = os.getuid() == 0
        with (self._folder / "said.txt").open("a") as said:
            done = subprocess.run(
                [str(self._tools / tool), *arguments],
                stdout=said,
                stderr=said,
                cwd=self._folder,
                env={"PATH": os.defpath, "LC_ALL": "C"},
                user=self._user.pw_uid if as_root else None,
                group=self._user.pw_gid if as_root else None,
                extra_groups=[] if as_root else None,
                check=False,
            )
        if done.returncode:
            raise RuntimeError(f"{tool}: {(self._folder / 'said.txt').read_text()[-500:]}")

    def start(self) -> None:
        """Start it and wait until it answers."""
        settings = f"-k {self._folder} -c listen_addresses= -c fsync=off -c max_connections=40"
        log = self._folder / "server.txt"
        self._run("pg_ctl", "-D", str(self._data), "-l", str(log), "-o", settings, "-w", "start")

    def stop(self, *, at_once: bool = False) -> None:
        """Stop it; `at_once` as if the power had failed: it recovers at the next start."""
        mode = "immediate" if at_once else "fast"
        self._run("pg_ctl", "-D", str(self._data), "-m", mode, "-w", "stop")

    def url(self, database: str = "postgres") -> str:
        """Return the address of one of its databases."""
        return f"postgresql://tester@/{database}?host={quote(str(self._folder), safe='')}"

    def say(self, command: str, database: str = "postgres") -> None:
        """Run one command of SQL."""
        import psycopg

        where = f"host={self._folder} user=tester dbname={database}"
        with psycopg.connect(where, autocommit=True) as connection:
            connection.execute(command.encode())

    def new_database(self) -> str:
        """Make an empty database and give its address."""
        name = f"db_{uuid.uuid4().hex[:12]}"
        self.say(f"CREATE DATABASE {name}")
        return self.url(name)


@contextmanager
def throwaway_cluster() -> Iterator[Cluster]:
    """Run a server for a while; its folder is removed afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="cv-pg-"))
    try:
        cluster = Cluster(folder)
        cluster.start()
        try:
            yield cluster
        finally:
            cluster.stop(at_once=True)
    finally:
        shutil.rmtree(folder)
