"""A batch killed at any moment and begun again ends with the rows of one that nothing disturbed."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from random import Random

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs

CAPTURES, KILLS = 12, 2
CHILD = """
import sys
from pathlib import Path
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs
options = MeasureOptions(instances="dataset", methods=("M1",))
measure_inputs([Path(sys.argv[1])], Path(sys.argv[2]), options, lambda step: print(flush=True))
"""


def write_captures(folder: Path) -> None:
    camera = Intrinsics(96, 64, 90.0, 90.0, 47.5, 31.5)
    for number in range(CAPTURES):
        mask = np.zeros((64, 96), bool)
        mask[10 : 30 + number, 40:52] = True
        depth_m = np.where(mask, 0.5 + 0.001 * number, 0.9).astype(np.float32)
        color = np.full((64, 96, 3), 60 + number, np.uint8)
        name = f"stop-{number:02d}"
        write_native(Capture(color, depth_m, camera, name, masks=(mask,)), folder / name)


def test_a_batch_killed_again_and_again_loses_and_doubles_nothing(tmp_path: Path) -> None:
    house, out, whole = tmp_path / "house", tmp_path / "out", tmp_path / "whole"
    write_captures(house)
    random, killed = Random(1), 0
    for _ in range(KILLS):
        words = [sys.executable, "-c", CHILD, str(house), str(out)]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            for _ in range(random.randint(1, 4)):
                child.stdout.readline()  # a capture is done
            time.sleep(random.uniform(0, 0.01))  # between two writes, or inside one
            child.kill()
        killed += child.returncode < 0
    assert killed
    options = MeasureOptions(instances="dataset", methods=("M1",))
    measure_inputs([house], out, options)
    measure_inputs([house], whole, options)
    for name in ("measurements.csv", "failures.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    for picture in (whole / "overlays").iterdir():
        assert (out / "overlays" / picture.name).read_bytes() == picture.read_bytes()
