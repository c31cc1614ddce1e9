"""Error bars on the command line: reconstruct, info, evaluate, export, report."""

import h5py
import numpy as np
import pytest


@pytest.mark.slow
def test_error_bars_go_with_their_volume_through_every_command(told, refused, scan, tmp_path, fast_pictures) -> None:
    volume, bars, page = (tmp_path / name for name in ("volume.h5", "bars.npy", "page.html"))
    line = f"reconstruct {scan} -o {volume}"
    assert "the 95 % bar is" in told(f"{line} --method sirt --iterations 3 --doubt")
    with h5py.File(volume) as file:
        sigma = file["/entry/reconstruction/doubt"]
        assert sigma.attrs["units"] == "1/mm" and sigma.shape == file["/entry/reconstruction/volume"].shape
        sigma = sigma[...]
    assert told(f"info {volume} --json")["doubt"]["multiple_95"] > 1
    facts = told(f"evaluate {volume} --reference {scan} --json")
    assert 0 < facts["within_doubt"] <= facts["within_doubt_95"] <= 1 and facts["doubt_over_error"] > 0
    assert (tmp_path / "volume.evaluated.doubt.png").is_file()
    for words in (f"-o {bars} --doubt", "--to npy", "--to npy --doubt"):
        told(f"export {volume} {words}")
    for name, is_doubt in {"bars": True, "volume.doubt": True, "volume": False}.items():
        assert np.array_equal(np.load(tmp_path / f"{name}.npy"), sigma) == is_doubt, name
    assert "error bars" in (tmp_path / "bars.json").read_text(encoding="utf-8")
    told(f"report {volume} -o {page} --views 0")
    assert "Error bars" in (text := page.read_text(encoding="utf-8")) and 'value="doubt"' in text
    refused(f"export {volume} -o {tmp_path}/scaled.h5 --hu --doubt".split())
    refused(f"{line} --method sirt --iterations 3 --doubt --rows 0:4".split())
    told(f"{line} --method fdk")
    refused(f"export {volume} -o {bars} --doubt".split(), "no error bars")
