"""The neural methods where PyTorch is not installed: known, checked, and refused with what to install."""

import pytest

from phyradgs_cl import neural
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.api import save_scan, simulate
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import plan_run, reconstruct


@pytest.mark.parametrize("method", ["naf", "sax-nerf"])
def test_a_run_says_in_one_line_what_to_install(rt, method, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(neural, "has_torch", lambda: False)
    scan = simulate("jaw", size=8, detector=12, views=3, device=rt)
    with pytest.raises(InputError, match=f"--method {method}: found no PyTorch"):
        reconstruct(scan, plan_run(method), rt)
    save_scan(tmp_path / "scan.h5", scan)
    command = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out.h5"), "--method", method]
    assert load_cli().run(command) == 2 and not (tmp_path / "out.h5").exists()
    (said,) = (line for line in capsys.readouterr().err.splitlines() if "PyTorch" in line)
    assert 'pip install "phyradgs-cl[neural]"' in said
