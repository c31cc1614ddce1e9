"""Fills the tables of docs/results/*.md and docs/scanner.md from recorded runs: python docs/make_results.py [--check]

A table is between ``<!-- table: NAME -->`` and ``<!-- end of table -->``; the modules of page_tables name theirs. With
``--check`` nothing is written, and the exit status is 1 where a page differs from its data."""

import re
import sys

from page_tables import RESULTS, TABLES, models, moving, quality, scans  # noqa: F401, which fill TABLES

BLOCK = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end of table -->)", re.S)


def filled(text: str) -> str:
    """Returns a page with its tables made from the data."""
    return BLOCK.sub(lambda block: block[1] + TABLES[block[2]]() + block[3], text)


def main() -> None:
    differ = []
    for page in [*sorted(RESULTS.glob("*.md")), RESULTS.parent / "scanner.md"]:
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            differ.append(page.name)
            if "--check" not in sys.argv:
                page.write_text(after, encoding="utf-8")
    print("pages that differ from their data:" if "--check" in sys.argv else "pages written:", ", ".join(differ) or "none")
    sys.exit(bool(differ) and "--check" in sys.argv)


if __name__ == "__main__":
    main()
