"""Fails on skipped tests: python .ci/no_skips.py JUNIT.xml

A kernel that no device has run is a kernel that nobody has tested. A test may be skipped only for one of the
reasons below, which have nothing to do with kernels.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ElementTree

ALLOWED = (
    "volumes",  # the folder of real volumes is not part of the repository
    "POSIX",
    "superuser",
)


def main() -> int:
    cases = list(ElementTree.parse(sys.argv[1]).iter("testcase"))
    wrong = []
    for case in cases:
        skipped = case.find("skipped")
        if skipped is None or skipped.get("type") == "pytest.xfail":
            continue
        reason = f"{skipped.get('message', '')} {skipped.text or ''}"
        if not any(word in skipped.get("message", "") for word in ALLOWED):
            wrong.append(f"{case.get('classname')}::{case.get('name')}: {reason.strip()}")
    if not cases:
        wrong.append("no test has run")
    for line in wrong:
        sys.stderr.write(f"skipped, and must not be: {' '.join(line.split())}\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
