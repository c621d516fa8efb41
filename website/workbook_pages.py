"""Render the printed pages of a workbook for inspection.

    python website/workbook_pages.py ROUND.xlsx OUT

LibreOffice lays the pages out and Poppler draws them (Debian: libreoffice-calc, poppler-utils).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PROGRAMS = {"soffice": "libreoffice-calc", "pdftoppm": "poppler-utils"}


def missing() -> list[str]:
    """Return the Debian packages of missing programs."""
    return [package for program, package in PROGRAMS.items() if shutil.which(program) is None]


def draw_pages(workbook: Path, out: Path) -> list[Path]:
    """Write OUT/page-1.png and so on, and return them in the pages' order."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        # A separate profile: a running LibreOffice would take the job without waiting.
        profile = f"-env:UserInstallation={(Path(folder) / 'profile').as_uri()}"
        made = ["soffice", profile, "--headless", "--convert-to", "pdf"]
        made += ["--outdir", folder, str(workbook)]
        subprocess.run(made, check=True, timeout=300, stdout=subprocess.DEVNULL)
        pages = Path(folder) / f"{workbook.stem}.pdf"
        subprocess.run(["pdftoppm", "-r", "80", "-png", pages, out / "page"], check=True)
    return sorted(out.glob("page-*.png"))


def main() -> None:
    """Draw them."""
    parser = argparse.ArgumentParser(description="Pictures of a workbook's printed pages.")
    parser.add_argument("workbook", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    if packages := missing():
        sys.exit(f"a program is missing: apt install {' '.join(packages)}")
    print(f"{len(draw_pages(arguments.workbook, arguments.out))} pages in {arguments.out}")


if __name__ == "__main__":
    main()
