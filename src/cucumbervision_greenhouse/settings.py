"""The settings of the greenhouse's pages, the file that keeps them, and units."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import ValidationError, from_json

from cucumbervision.capture.realsense import CameraSettings
from cucumbervision.capture.source import ReadOptions
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import wrap_os_errors
from cucumbervision.files import replacing
from cucumbervision.methods.result import LengthDefinition, Selector
from cucumbervision.networks import DEFAULT_CONFIDENCE
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.forecast.picking import Rates
from cucumbervision_greenhouse.language import number_words

STORE_VARIABLE = "CUCUMBERVISION_STORE"
REPLAY_VARIABLE = "CUCUMBERVISION_REPLAY"
LOGIN_VARIABLE = "CUCUMBERVISION_LOGIN"

_UNITS = {"cm": 100.0, "in": 1 / 0.0254}
_UNITS_ALONG = {"cm": ("m", 1.0), "in": ("ft", 1 / 0.3048)}  # of positions along a row


@dataclass(frozen=True)
class Units:
    """A unit of length for display.

    Parameters
    ----------
    name : {'cm', 'in'}
        Centimetres or inches.

    Examples
    --------
    >>> Units("cm").text(0.2532), Units("in").text(0.2532), Units("cm").text(None)
    ('25.3 cm', '9.97 in', '–')
    """

    name: Literal["cm", "in"] = "cm"

    def value(self, length_m: float | None) -> float | None:
        """Return metres in this unit.

        Examples
        --------
        >>> Units("in").value(0.254)
        10.0
        """
        return None if length_m is None else round(length_m * _UNITS[self.name], 3)

    def metres(self, value: float) -> float:
        """Return a value in this unit in metres.

        Examples
        --------
        >>> Units("cm").metres(25.0)
        0.25
        """
        return value / _UNITS[self.name]

    @property
    def digits(self) -> int:
        """Decimals to display."""
        return 1 if self.name == "cm" else 2

    @property
    def along(self) -> tuple[str, float]:
        """Unit of positions along a row, and how many of it a metre has.

        Examples
        --------
        >>> Units("cm").along
        ('m', 1.0)
        """
        return _UNITS_ALONG[self.name]

    def text(self, length_m: float | None) -> str:
        """Return a length with its unit."""
        value = self.value(length_m)
        return "–" if value is None else f"{number_words(value, self.digits)} {self.name}"


Share = Annotated[float, Field(ge=0.05, le=0.95)]
InputSize = Annotated[int, Field(ge=32, le=4096, multiple_of=32)]

Preset = Literal["", "default", "hand", "high-accuracy", "high-density", "medium-density"]
PRESETS: tuple[Preset, ...] = get_args(Preset)
EXPOSURE_US = 100.0, 200_000.0  # shortest and longest manual exposure


def _exposure_us(value: float) -> float:
    """Return an exposure limited to the allowed range; 0 is automatic."""
    shortest_us, longest_us = EXPOSURE_US
    return min(max(value, shortest_us), longest_us) if value else 0.0


class Settings(BaseModel):
    """Settings of the dashboard.

    Parameters
    ----------
    profile : str
        Name of the crop profile.
    unit : {'cm', 'in'}
        What lengths are shown in.
    language : {'', 'en', 'nl', 'es'}
        Language of the pages; empty for that of each browser.
    burst : int
        Frames fused to one capture.
    confidence : float
        Detections below it are left out.
    input_sizes : tuple of int
        Long sides that the networks see, as `MeasureOptions.input_sizes`; empty for their own.
    selector, length : Selector, LengthDefinition
        As in `MeasureOptions`.
    fruit_from : {'auto', 'models', 'dataset'}
        Where the fruit come from, as `MeasureOptions.instances`.
    full_precision : bool
        The same lengths on every machine, at the cost of speed.
    calibration : str
        Path of a site's calibration; empty for none.
    camera_preset : str
        The depth camera's preset, as `CameraSettings.preset`; empty for the camera's own.
    exposure_us : float, optional
        Of the colour camera: 0 is automatic, None as the camera has it.
    upload_limit_mb : int
        How much may be sent at once.
    fruit_per_hour, minutes_per_row, fruit_per_crate
        As in `agronomy.picking.Rates`.
    """

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False, frozen=True)

    profile: str = "long-cucumber"
    unit: Literal["cm", "in"] = "cm"
    language: Literal["", "en", "nl", "es"] = ""
    burst: Annotated[int, Field(ge=1, le=15)] = 5
    confidence: Share = DEFAULT_CONFIDENCE
    input_sizes: Annotated[tuple[InputSize, ...], Field(max_length=2)] = ()
    selector: Selector = Selector.BEST
    length: LengthDefinition = LengthDefinition.CENTRELINE
    fruit_from: Annotated[
        Literal["auto", "models", "dataset"],
        BeforeValidator(lambda x: "auto" if x == "automatic" else x),  # values in older files
    ] = "auto"
    full_precision: bool = True
    calibration: str = ""
    camera_preset: Preset = ""
    exposure_us: Annotated[float, AfterValidator(_exposure_us)] | None = None
    upload_limit_mb: Annotated[int, Field(ge=1, le=1_000_000)] = 4000
    fruit_per_hour: Annotated[float, Field(gt=0)] = 350.0
    minutes_per_row: Annotated[float, Field(ge=0)] = 2.0
    fruit_per_crate: Annotated[int, Field(ge=1)] = 12

    @property
    def units(self) -> Units:
        """The unit of length."""
        return Units(self.unit)

    @property
    def camera(self) -> CameraSettings:
        """Preset and exposure of the camera."""
        return CameraSettings(self.camera_preset or None, self.exposure_us)

    @property
    def rates(self) -> Rates:
        """Rates of picking, and fruit in a crate."""
        return Rates(self.fruit_per_hour, self.minutes_per_row, self.fruit_per_crate)

    @property
    def options(self) -> MeasureOptions:
        """The options of a measuring run, as the command `measure` has them.

        Examples
        --------
        >>> Settings(burst=5).options == MeasureOptions()
        True
        """
        return MeasureOptions(
            instances=self.fruit_from,
            selector=self.selector,
            length=self.length,
            confidence=self.confidence,
            input_sizes=self.input_sizes,
            full_precision=self.full_precision,
            reading=ReadOptions(burst=self.burst),
            calibration=Path(self.calibration) if self.calibration else None,
        ).for_crop(load_profile(self.profile))


def settings_file(store: str) -> Path:
    """Return the settings file of a store: beside an SQLite file, else the user's own.

    Examples
    --------
    >>> settings_file("house.db").name
    'house.settings.json'
    """
    if "://" not in store:
        return Path(store).with_suffix(".settings.json")
    import platformdirs

    return Path(platformdirs.user_config_dir("cucumbervision", appauthor=False)) / "dashboard.json"


def truth_folder(store: str) -> Path:
    """Return the folder of lengths by hand and calibrations: beside the store, or the user's own.

    Examples
    --------
    >>> truth_folder("house.db").name
    'house.truth'
    """
    if "://" not in store:
        return Path(store).with_suffix(".truth")
    import platformdirs

    return Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "truth"


def read_settings(path: Path) -> Settings:
    """Return settings from a file; defaults for what is missing or has no value of this version.

    Examples
    --------
    >>> read_settings(Path("nowhere.json")).profile
    'long-cucumber'
    """
    try:
        text = path.read_text(encoding="utf-8")
        return Settings.model_validate_json(text)
    except ValidationError as error:
        invalid = {fault["loc"][0] for fault in error.errors() if fault["loc"]}
        values = from_json(text) if invalid else {}
        return Settings(**{name: value for name, value in values.items() if name not in invalid})
    except (OSError, ValueError):
        return Settings()


def write_settings(settings: Settings, path: Path) -> None:
    """Write settings, replacing the file in one step.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_settings(Settings(unit="in"), Path(folder) / "a.json")
    ...     read_settings(Path(folder) / "a.json").unit
    'in'
    """
    replace_text(path, settings.model_dump_json(indent=2, exclude_defaults=True) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a text file in place of an older one, in one step; two writers do not disturb it.

    Raises
    ------
    CucumberVisionError
        If it cannot be written.
    """
    with wrap_os_errors("cannot be written", path, "check the folder and its permissions"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            part.write_text(text, encoding="utf-8")


def default_store() -> str:
    """Return the path of the user's own store.

    Examples
    --------
    >>> default_store().endswith("rounds.db")
    True
    """
    import platformdirs

    return str(Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "rounds.db")
