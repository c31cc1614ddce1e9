"""Options and values that have left: one line says what to write instead."""

import pytest

from phyradgs_cl.removed import REMOVED

RUN = ["reconstruct", "scan.h5", "-o", "volume.h5"]
WORDS = {
    "--method fused": [*RUN, "--method", "Fused"],
    "--prior curves": [*RUN, "--prior", "curves"],
    "pixel_footprint": [*RUN, "--method", "r2", "--set", "pixel_footprint=true"],
}
"""Words of the command line, by the removed one."""


@pytest.mark.parametrize("word", WORDS)
def test_a_word_that_left_names_its_replacement(cli, capsys, word) -> None:
    assert cli.run(WORDS[word]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "earlier version" in error and error.endswith(f"{REMOVED[word]}\n")


def test_every_word_is_tried() -> None:
    assert {word for word in REMOVED if not word.startswith("phyradgs ")} == set(WORDS)
