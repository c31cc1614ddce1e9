"""The corpus as files: python -m tests.corpus FOLDER [--seed N]; one line per file says what must become of it."""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from corpus.everything import all_cases  # noqa: E402
from corpus.good import write_good  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="a new folder")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    good = write_good(asked.folder / "good", asked.seed)
    with open(asked.folder / "cases.jsonl", "w") as manifest:
        for number, case in enumerate(all_cases(good, asked.seed)):
            file = case.make(good, asked.folder / f"{number:04d}")
            words = case.arguments(Path("good"), file.relative_to(asked.folder), Path("existing"))
            line = {"name": case.name, "command": words, "refused": case.refused}
            manifest.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()
