"""Licence, source address and library versions of the program."""

from __future__ import annotations

import hashlib
import os
from functools import cache
from importlib.metadata import PackageNotFoundError, metadata, version
from pathlib import Path

from cucumbervision._version import __version__
from cucumbervision.errors import Message

LICENCE = "AGPL-3.0-only"
_CODE = frozenset({".py", ".c", ".csv", ".json", ".toml"})
_NO_LENGTH = frozenset({"cli", "service", "stream"})  # rooms that decide none
_VERSIONS_OF = (
    "numpy",
    "scipy",
    "opencv-python-headless",
    "onnxruntime",
    "openvino",
    "pyrealsense2",
)


def source_offer() -> str:
    """Return the address of the program's source, or a sentence if there is none.

    The AGPL-3.0, section 13, requires this offer. The address is `Source` of the installed
    package in `[project.urls]` of `pyproject.toml`: distributors of a changed program change it.
    The environment variable `CUCUMBERVISION_SOURCE` overrides it.

    Examples
    --------
    >>> isinstance(source_offer(), str)
    True
    """
    if chosen := os.environ.get("CUCUMBERVISION_SOURCE", "").strip():
        return chosen
    for line in metadata("cucumbervision").get_all("Project-URL") or []:
        label, _, address = line.partition(", ")
        if label.lower() == "source":
            return str(address)
    return Message(
        "this installation names no address of its source (Source in [project.urls]); "
        "whoever runs it owes you the source (AGPL-3.0, section 13)"
    )


def software() -> dict[str, str]:
    """Return the description of the program that every output file contains.

    Examples
    --------
    >>> list(software())
    ['software', 'licence', 'source']
    """
    return {
        "software": f"cucumbervision {__version__}",
        "licence": LICENCE,
        "source": source_offer(),
    }


def installed_versions() -> dict[str, str]:
    """Return the versions of the libraries that a length depends on.

    Examples
    --------
    >>> "numpy" in installed_versions()
    True
    """
    versions = {}
    for name in _VERSIONS_OF:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


@cache
def code_sha256() -> str:
    """Return the hash of the code and the tables of this package that decide a length.

    Examples
    --------
    >>> len(code_sha256())
    64
    """
    root, digest = Path(__file__).parent, hashlib.sha256()
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root)
        if path.suffix in _CODE and name.parts[0] not in _NO_LENGTH:
            digest.update(name.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
