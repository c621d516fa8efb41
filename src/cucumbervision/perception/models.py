"""What the registry says of a network: its files, its source, its licence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["FileCheck", "Model", "ModelFile", "ModelSource"]


@dataclass(frozen=True)
class ModelFile:
    """One file that a runtime loads.

    Parameters
    ----------
    role : str
        What it is to its network: 'encoder', 'decoder', 'network'.
    file : str
        Its name.
    sha256 : str
        Empty if it is exported on the user's machine.
    size_bytes : int
        Zero if not known.
    """

    role: str
    file: str
    sha256: str = ""
    size_bytes: int = 0


@dataclass(frozen=True)
class ModelSource:
    """The publisher's own file.

    Parameters
    ----------
    file : str
        Its name.
    sha256 : str
        Its SHA-256 in hexadecimal.
    size_bytes : int
        Its size.
    url : str
        Where the publisher offers it; 'pip:NAME==VERSION' for a Python distribution.
    member : str
        Its path inside the archive that `url` names; empty if it stands alone.
    """

    file: str
    sha256: str
    size_bytes: int
    url: str
    member: str = ""


@dataclass(frozen=True)
class Model:
    """One entry of the registry.

    Parameters
    ----------
    name : str
        What commands call it.
    task : str
        'prompted-mask', 'segment' or 'pose'.
    licence : str
        SPDX identifier of the weights' licence.
    title : str
        What it is, in a line.
    origin : str
        Who published it.
    files : tuple of ModelFile
        What the runtimes load.
    source : ModelSource, optional
        What the files were exported from.
    architecture : str
        The name that the exporter knows it by.
    embedded : bool
        True if it lies in the package.
    card : str
        The page that tells its training data; for networks trained by this project.
    """

    name: str
    task: str
    licence: str
    title: str
    origin: str
    files: tuple[ModelFile, ...]
    source: ModelSource | None = None
    architecture: str = ""
    embedded: bool = False
    card: str = ""


@dataclass(frozen=True)
class FileCheck:
    """What became of one file's verification.

    Parameters
    ----------
    model, file : str
        Their names.
    path : Path
        Where it should lie.
    state : str
        'ok', 'damaged' or 'missing'.
    """

    model: str
    file: str
    path: Path
    state: str
