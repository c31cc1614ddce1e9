"""Error bars on the command line: reconstruct, info, evaluate, export, report."""

import json

import h5py
import numpy as np
import pytest

WORDS = ["--method", "sirt", "--iterations", "3", "--doubt"]


@pytest.mark.slow
def test_error_bars_go_with_their_volume_through_every_command(cli, scan, tmp_path, capsys, fast_pictures) -> None:
    volume, bars, page = (str(tmp_path / name) for name in ("volume.h5", "bars.npy", "page.html"))
    assert cli.run(["reconstruct", str(scan), "-o", volume, *WORDS]) == 0 and "the 95 % bar is" in capsys.readouterr().out
    with h5py.File(volume) as file:
        sigma = file["/entry/reconstruction/doubt"]
        assert sigma.attrs["units"] == "1/mm" and sigma.shape == file["/entry/reconstruction/volume"].shape
        sigma = sigma[...]
    assert cli.run(["info", volume, "--json"]) == 0 and json.loads(capsys.readouterr().out)["doubt"]["multiple_95"] > 1
    assert cli.run(["evaluate", volume, "--reference", str(scan), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert 0 < facts["within_doubt"] <= facts["within_doubt_95"] <= 1 and facts["doubt_over_error"] > 0
    assert (tmp_path / "volume.evaluated.doubt.png").is_file()
    assert cli.run(["export", volume, "-o", bars, "--doubt"]) == 0
    np.testing.assert_array_equal(np.load(bars), sigma)
    assert "error bars" in (tmp_path / "bars.json").read_text(encoding="utf-8")
    assert cli.run(["export", volume, "--to", "npy"]) == cli.run(["export", volume, "--to", "npy", "--doubt"]) == 0
    np.testing.assert_array_equal(np.load(tmp_path / "volume.doubt.npy"), sigma)
    assert not np.array_equal(np.load(tmp_path / "volume.npy"), sigma)
    assert cli.run(["report", volume, "-o", page, "--views", "0"]) == 0
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Error bars" in text and 'value="doubt"' in text
    assert cli.run(["export", volume, "-o", str(tmp_path / "scaled.h5"), "--hu", "--doubt"]) == 2
    assert cli.run(["reconstruct", str(scan), "-o", volume, *WORDS, "--rows", "0:4"]) == 2
    assert cli.run(["reconstruct", str(scan), "-o", volume, "--method", "fdk"]) == 0
    assert cli.run(["export", volume, "-o", bars, "--doubt"]) == 2 and "no error bars" in capsys.readouterr().err
