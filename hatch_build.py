"""Compile M6's kernel when the package is installed; without a C compiler NumPy computes instead.

`CUCUMBERVISION_KERNEL=compiled` makes a missing compiler an error, `numpy` leaves the kernel out.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

KERNEL = Path("src/cucumbervision/tube/kernel")
# No processor beyond the architecture's baseline, no fused or reordered sums: every machine gives
# the same lengths. Symbols are the library's own, whatever another one calls so.
FLAGS = (
    *("-std=c11", "-O3", "-fPIC", "-shared", "-fvisibility=protected"),
    *("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
)


class KernelHook(BuildHookInterface):
    """Adds the library to the wheel, or to the source tree of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name the platform in the wheel's tag; py3-none, as no Python is called."""
        choice = os.environ.get("CUCUMBERVISION_KERNEL", "").strip().lower()
        folder = Path(self.root) / KERNEL
        library = folder / "kernel.so"
        if version != "editable":
            self._scratch = tempfile.TemporaryDirectory()
            library = Path(self._scratch.name) / library.name
        said = library.with_suffix(".sha256")
        library.unlink(missing_ok=True)
        said.unlink(missing_ok=True)
        if choice == "numpy":
            return
        try:
            self._compile(sorted(folder.glob("*.[ch]")), library)
        except (OSError, subprocess.CalledProcessError) as error:
            if choice == "compiled":
                raise
            self.app.display_warning(f"M6's kernel is not compiled, NumPy computes: {error}")
            return
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
        if version != "editable":
            inside = KERNEL.relative_to("src")
            for file in (library, said):
                build_data["force_include"][str(file)] = str(inside / file.name)

    def _compile(self, sources: list[Path], library: Path) -> None:
        compiler = shlex.split(os.environ.get("CC", "cc"))
        files = [str(path) for path in sources if path.suffix == ".c"]
        command = [*compiler, *FLAGS, *files, "-lm", "-o", str(library)]
        subprocess.run(command, check=True)
        # What tube_kernel.py compares before it loads the library: loading a damaged one may crash.
        content = b"".join(path.read_bytes() for path in (library, *sources))
        library.with_suffix(".sha256").write_text(hashlib.sha256(content).hexdigest())
