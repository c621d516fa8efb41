"""What the program is: licence, where its source is, and what it runs on."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, metadata, version

__all__ = ["LICENCE", "installed_versions", "source_offer"]

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
    """Say where the program's source is (AGPL-3.0, section 13).

    The address is the installed package's own `Source` URL, so that who passes on a changed
    program changes it in one place, `pyproject.toml`.

    Examples
    --------
    >>> isinstance(source_offer(), str)
    True
    """
    for line in metadata("cucumbervision").get_all("Project-URL") or []:
        label, _, address = line.partition(", ")
        if label.lower() == "source":
            return str(address)
    return "with whoever gave you this program, who owes it to you (AGPL-3.0, section 13)"


def installed_versions() -> dict[str, str]:
    """Give the versions of the libraries that a length depends on.

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
