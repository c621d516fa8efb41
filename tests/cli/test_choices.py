"""Options that commands share, as a user gives them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from cucumbervision.cli.choices import loop_options, measure_options, takes
from cucumbervision.crop.profiles import load_profile
from cucumbervision.methods.result import LengthDefinition, MethodName, Selector
from cucumbervision.run.options import MeasureOptions


class Asked:
    """A command that keeps what it is called with."""

    def __init__(self, *without: str) -> None:
        self.app = typer.Typer()
        self.name = ""
        self.burst = 0
        self.options = MeasureOptions()

        @self.app.command()
        @takes("options", measure_options, without)
        def command(
            name: str,
            burst: Annotated[int, typer.Option(help="Our own.")] = 0,
            *,
            options: MeasureOptions,
        ) -> None:
            self.name, self.burst, self.options = name, burst, options

    def __call__(self, *words: str) -> MeasureOptions:
        done = CliRunner().invoke(self.app, words)
        assert done.exit_code == 0, done.output
        return self.options


def test_nothing_given_is_what_python_measures_with() -> None:
    assert Asked()("a") == MeasureOptions().for_crop(load_profile("long-cucumber"))


def test_each_option_reaches_what_it_names(tmp_path: Path) -> None:
    options = Asked()(
        *("a", "--methods", "m3,m1", "--selector", "paper", "--length", "thread"),
        *("--depth-unit", "0.0001", "--depth-along", "ray", "--aligned-to", "color"),
        *("--instances", "dataset", "--classes", "unripe,ripe", "--segmenter", "none"),
        *("--confidence", "0.4", "--input-size", "640,896", "--camera-up", "left"),
        *("--intrinsics", str(tmp_path / "camera.json"), "--runtime", "onnxruntime"),
    )
    reading = options.reading
    assert set(options.methods) == {MethodName.M1, MethodName.M3}
    assert (options.selector, options.length) == (Selector.PAPER, LengthDefinition.THREAD)
    assert (reading.depth_unit_m, reading.depth_along, reading.aligned_to) == (1e-4, "ray", "color")
    assert reading.intrinsics == tmp_path / "camera.json"
    assert (options.instances, options.segmenter) == ("dataset", "none")
    assert set(options.classes) == {"unripe", "ripe"}
    assert (options.confidence, tuple(options.input_sizes)) == (0.4, (640, 896))
    assert (options.full_precision, options.camera_up) == (True, "left")
    assert options.runtime == "onnxruntime"


@pytest.mark.parametrize(
    ("words", "runtime", "full_precision"),
    [("auto", "auto", True), ("fast", "auto", False), ("cuda-fast", "cuda", False)],
)
def test_a_fast_runtime_computes_in_half_precision(
    words: str, runtime: str, full_precision: bool
) -> None:
    options = Asked()("a", "--runtime", words)
    assert (options.runtime, options.full_precision) == (runtime, full_precision)


def test_a_profile_sets_the_lengths_that_can_be() -> None:
    long, mini = (Asked()("a", "--profile", name) for name in ("long-cucumber", "mini-cucumber"))
    assert mini.accepted_m == MeasureOptions().for_crop(load_profile("mini-cucumber")).accepted_m
    assert mini.accepted_m != long.accepted_m


def test_an_option_of_the_command_itself_is_shared_with_the_measuring() -> None:
    asked = Asked()
    options = asked("row 3", "--burst", "7")
    assert (asked.name, asked.burst, options.reading.burst) == ("row 3", 7, 7)


def test_options_that_a_command_leaves_out_are_none_of_its_own() -> None:
    asked = Asked("depth", "runtime")
    refused = CliRunner().invoke(asked.app, ["a", "--runtime", "fast"])
    assert refused.exit_code == 2
    assert "No such option: --runtime" in refused.output
    assert asked("a").full_precision


def test_the_number_of_processes_chooses_the_engine() -> None:
    alone, many = loop_options(workers=1), loop_options(workers=3)
    assert type(alone.engine) is not type(many.engine)
    assert loop_options().engine == alone.engine
