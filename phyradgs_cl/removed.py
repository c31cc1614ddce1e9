"""Words that have left the program, and what to write now."""

from phyradgs_cl.errors import InputError

REMOVED = {
    "phyradgs splat": "start Gaussians from a volume with 'phyradgs reconstruct SCAN --method phyradgs --initial VOLUME'",
    "phyradgs watch": "run examples/watch_folder.py of the source, which calls 'phyradgs reconstruct' for each scan",
}


def refuse_removed(word: str) -> None:
    """Raises InputError with the replacement if ``word`` has left: ``phyradgs NAME`` for a command."""
    if word in REMOVED:
        raise InputError(word, "a word of an earlier version", "", REMOVED[word])
