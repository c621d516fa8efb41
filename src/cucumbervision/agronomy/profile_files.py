"""Crop profiles on disk: the shipped ones, and the user's own beside them."""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path

from cucumbervision.agronomy.profile import CropProfile
from cucumbervision.capture.files import parse_model
from cucumbervision.errors import ProfileError

__all__ = ["ProfileEntry", "load_profile", "profiles", "profiles_folder"]

_SHIPPED = Path(__file__).parent / "profiles"


@dataclass(frozen=True)
class ProfileEntry:
    """One profile that can be named.

    Parameters
    ----------
    name : str
        The file's name without `.toml`.
    path : Path
        The file.
    shipped : bool
        Whether it came with the package.
    profile : CropProfile, optional
        What it says; None where it cannot be read.
    fault : str
        Why not.
    """

    name: str
    path: Path
    shipped: bool
    profile: CropProfile | None
    fault: str = ""


def profiles_folder() -> Path:
    """Give the folder of the user's own: `CUCUMBERVISION_PROFILES`, or the user's settings."""
    if chosen := os.environ.get("CUCUMBERVISION_PROFILES"):
        return Path(chosen)
    import platformdirs

    return Path(platformdirs.user_config_dir("cucumbervision", appauthor=False)) / "profiles"


def profiles(folder: Path | None = None) -> tuple[ProfileEntry, ...]:
    """Give every profile, the user's own first; one of a shipped name takes its place.

    Parameters
    ----------
    folder : Path, optional
        Another folder of the user's own than `profiles_folder`.

    Returns
    -------
    tuple of ProfileEntry
        A file that cannot be read is listed with its fault, and hides no other.

    Examples
    --------
    >>> [entry.name for entry in profiles() if entry.shipped]
    ['aubergine', 'courgette', 'green-bean', 'long-cucumber', 'mini-cucumber']
    """
    own = [_entry(path, shipped=False) for path in sorted(_folder(folder).glob("*.toml"))]
    names = {entry.name for entry in own}
    shipped = [_entry(path, shipped=True) for path in sorted(_SHIPPED.glob("*.toml"))]
    return (*own, *(entry for entry in shipped if entry.name not in names))


def load_profile(name_or_path: str | Path, folder: Path | None = None) -> CropProfile:
    """Read a crop profile.

    Parameters
    ----------
    name_or_path : str or Path
        A profile's name, or a TOML file.
    folder : Path, optional
        Another folder of the user's own than `profiles_folder`.

    Raises
    ------
    ProfileError
        If no profile has that name, or the file's fault and remedy.

    Examples
    --------
    >>> profile = load_profile("long-cucumber")
    >>> [(c.name, c.min_cm, c.max_cm) for c in profile.classes]
    [('I', 25.0, 35.0), ('II', 20.0, 25.0)]
    >>> load_profile("gherkin")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.ProfileError: no crop profile is called 'gherkin'; take one of ...
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(".toml") or Path(text).name != text:
        return _read(Path(name_or_path))
    for place in (_folder(folder), _SHIPPED):
        path = place / f"{text}.toml"
        if path.is_file():
            return _read(path)
    known = ", ".join(entry.name for entry in profiles(folder))
    raise ProfileError(
        f"no crop profile is called {text!r}",
        remedy=f"take one of {known}, or put your own {text}.toml into {_folder(folder)}",
    )


def _folder(folder: Path | None) -> Path:
    return profiles_folder() if folder is None else folder


def _entry(path: Path, *, shipped: bool) -> ProfileEntry:
    try:
        return ProfileEntry(path.stem, path, shipped, _read(path))
    except ProfileError as error:
        return ProfileEntry(path.stem, path, shipped, None, str(error))


def _read(path: Path) -> CropProfile:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ProfileError(
            f"cannot be read ({error.strerror})", source=path, remedy="give a profile's file"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(
            f"is no TOML ({error})", source=path, remedy="correct that line"
        ) from None
    return parse_model(CropProfile, data, source=path, error=ProfileError)
