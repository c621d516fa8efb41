"""What the program is: licence, where its source is, and what it runs on."""

from __future__ import annotations

import os
from importlib.metadata import PackageNotFoundError, metadata, version

from cucumbervision._version import __version__

LICENCE = "AGPL-3.0-only"
_VERSIONS_OF = (
    "numpy",
    "scipy",
    "opencv-python-headless",
    "onnxruntime",
    "openvino",
    "pyrealsense2",
)


def source_offer() -> str:
    """Return the address of the program's source, or a sentence that none is given.

    The AGPL-3.0, section 13, asks for the offer. The address is the installed package's `Source` in
    `[project.urls]` of `pyproject.toml`: distributors of a changed program change it there.
    Operators set it by the environment's `CUCUMBERVISION_SOURCE`, which comes first.

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
    return (
        "this installation names no address of its source (Source in [project.urls]); "
        "whoever runs it owes you the source (AGPL-3.0, section 13)"
    )


def software() -> dict[str, str]:
    """Return what every file that the program writes says of the program.

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
    found = {}
    for name in _VERSIONS_OF:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
