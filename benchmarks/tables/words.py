"""Lists on the command line, and results as lines for people."""

from phyradgs_cl.errors import InputError
from phyradgs_cl.estimate import duration
from tables.job import BenchProgress


def listed(option: str, text: str | None) -> list[str] | None:
    """Returns the parts of "a,b" without blanks around them; None for None. InputError: an empty part."""
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if not all(parts):
        raise InputError(option, repr(text), "names with commas between them", "write for example a,b")
    return parts


def listed_seeds(option: str, text: str) -> list[int]:
    """Returns the whole numbers of "0,1,2"."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() for part in parts):
        raise InputError(option, repr(text), "whole numbers of at least 0", "write for example 0,1,2")
    return [int(part) for part in parts]


def result_text(progress: BenchProgress) -> str:
    """Returns the result of a finished run, and how long the others will take."""
    line = progress.line or {}
    numbers = line.get("metrics")
    if numbers is None:
        found = f"failed: {line.get('error')}"
    else:
        psnr = numbers.get("psnr_db")
        found = f"PSNR {'inf' if psnr is None else format(psnr, '.2f')} dB, SSIM {numbers['ssim']:.3f}"
        if "psnr_db_pseudo" in numbers:
            found += " to the truth"
        found += f", {line['seconds']:.1f} s"
    left = f"; about {duration(progress.left_s)} left" if progress.left_s else ""
    return f"{progress.number}/{progress.runs} {progress.title}: {found}{left}"
