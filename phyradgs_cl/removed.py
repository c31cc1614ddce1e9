"""Words that have left the program, and what to write now."""

from phyradgs_cl.errors import InputError

REMOVED = {
    "phyradgs bench": "run 'make demo', or python benchmarks/tables, in the source (docs: benchmarks.md)",
    "phyradgs splat": "start Gaussians from a volume with 'phyradgs reconstruct SCAN --method phyradgs --initial VOLUME'",
    "phyradgs watch": "run examples/watch_folder.py of the source, which calls 'phyradgs reconstruct' for each scan",
    "--scheduler": "write --workers ADDRESS",
    "--what lag": "state the panel's lag in the TOML of 'phyradgs import' (docs: formats.md)",
    "--what drift": "correct the frames by 'phyradgs prepare --steps air'",
    "--what start": "leave it out: another start only turns the object about the axis",
}


def removed(word: str) -> InputError | None:
    """Returns the error that names the replacement of ``word``, a command as ``phyradgs NAME`` or an option; else None."""
    return InputError(word, "a word of an earlier version", "", REMOVED[word]) if word in REMOVED else None
