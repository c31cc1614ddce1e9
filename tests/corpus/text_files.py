"""Scanner descriptions and configurations in TOML."""

import random
from collections.abc import Iterator

from corpus.case import Case, filled, replaced_text, truncated
from corpus.good import CONFIG, SCANNER

SIMULATE = ("simulate", "--scanner", "{file}", "--phantom", "jaw", "--views", "2", "-o", "{out}")
CONFIGURED = ("reconstruct", "{good}/fly.h5", "--config", "{file}", "-o", "{out}")
VALUES = {
    "a text": '"many"',
    "a truth value": "true",
    "a date": "2024-01-01",
    "NaN": "nan",
    "infinite": "inf",
    "minus infinite": "-inf",
    "extreme": "1e300",
    "minus extreme": "-1e300",
    "endless digits": "9" * 5000,
    "a table": "{a = 1}",
    "a list": "[1, 2, 3, 4, 5]",
    "nothing": "[]",
}
# what is not refused of these: any title, a text where a word belongs is refused as a word, an integer seed
HARMLESS = {("scanner.toml", "title"): tuple(VALUES)}
OPTIONAL = ("title", "offset_v_mm", "offset_u_mm", "lag", "offset_mm", "axis", "direction", "ratio")
WHOLE = {
    "empty": b"",
    "binary": b"\x00\xff\xfe" * 100,
    "no TOML": b"= = =\n",
    "a quotation without end": b'title = "',
    "tables too deep": b"a = " + b"[" * 50_000,
    "inline tables too deep": b"a = " + b"{a = " * 20_000,
    "a key twice": b"title = 1\ntitle = 2\n",
    "hexadecimal without end": b"iterations = 0x" + b"f" * 50_000,
    "HDF5": b"\x89HDF\r\n\x1a\n" + b"\0" * 100,
    "an unknown table": b"[nonsense]\na = 1\n",
    "an unknown key": b"nonsense = 1\n",
}


def cases(seed: int) -> Iterator[Case]:
    """Every key of both files with every wrong value, without it, and whole files that are wrong."""
    draw = random.Random(seed)
    for of, text, command in (("scanner.toml", SCANNER, SIMULATE), ("run.toml", CONFIG, CONFIGURED)):
        for line in [line for line in text.splitlines() if "=" in line]:
            yield from _line_cases(of, line, command)
        for name, data in WHOLE.items():
            refused = not (of == "run.toml" and name == "empty")
            yield Case(f"{of}: {name}", of, filled(data), command, refused)
        for _ in range(4):
            keep = draw.uniform(0.2, 0.9)
            cut = text.encode()[: int(len(text) * keep)]
            yield Case(f"{of}: cut off after {keep:.3f}", of, filled(cut + b"\xff"), command)
        yield Case(f"{of}: UTF-16", of, filled(text.encode("utf-16")), command)
        yield Case(f"{of}: cut in a quotation", of, truncated(5 / len(text)), command)


def _line_cases(of: str, line: str, command: tuple[str, ...]) -> Iterator[Case]:
    key = line.split(" = ")[0]
    for name, value in VALUES.items():
        refused = name not in HARMLESS.get((of, key), ())
        if of == "scanner.toml" and key == "title" and name == "endless digits":
            refused = True  # Python's limit of digits: no TOML
        yield Case(f"{of}: {key}: {name}", of, replaced_text(line, f"{key} = {value}"), command, refused)
    if key != "iterations":  # the preset's thousands would be run
        refused = of == "scanner.toml" and key not in OPTIONAL
        yield Case(f"{of}: without {key}", of, replaced_text(line, ""), command, refused)
    yield Case(f"{of}: {key} misspelt", of, replaced_text(line, f"x{line}"), command)
