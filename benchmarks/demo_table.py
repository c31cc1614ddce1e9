"""The table that `make demo` ends with: python benchmarks/demo_table.py LABEL=EVALUATION.json ..."""

import json
import sys
from pathlib import Path


def main() -> None:
    rows = []
    for argument in sys.argv[1:]:
        label, _, path = argument.partition("=")
        facts = json.loads(Path(path).read_text())
        rows.append((label, facts["psnr_db"], facts["ssim"], facts.get("seconds", float("nan"))))
    width = max(len(label) for label, *_ in rows)
    print(f"\n{'method':{width}s}  PSNR (dB)    SSIM  seconds")
    for label, psnr_db, ssim, seconds in rows:
        print(f"{label:{width}s}  {psnr_db:9.2f}  {ssim:6.4f}  {seconds:7.1f}")


if __name__ == "__main__":
    main()
