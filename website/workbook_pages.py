"""Make pictures of a workbook's printed pages, to be looked at.

    python website/workbook_pages.py ROUND.xlsx OUT

LibreOffice lays the pages out and Poppler draws them (Debian: libreoffice-calc, poppler-utils).
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path


def main() -> None:
    """Write OUT/page-1.png and so on."""
    parser = argparse.ArgumentParser(description="Pictures of a workbook's printed pages.")
    parser.add_argument("workbook", type=Path)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    pages = given.out / f"{given.workbook.stem}.pdf"
    made = ["soffice", "--headless", "--convert-to", "pdf", "--outdir", given.out, given.workbook]
    subprocess.run(made, check=True, timeout=300)
    subprocess.run(["pdftoppm", "-r", "80", "-png", pages, given.out / "page"], check=True)


if __name__ == "__main__":
    main()
