"""Parallel scans from file to file: a report without a source, an estimate, laminography by the iterative methods."""

import numpy as np
import pytest
from parallel_kit import BODIES, laminography_scan, parallel_scan

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import write_scan
from phyradgs_cl.reconstructors import plan_run, reconstruct
from phyradgs_cl.report import write_report
from phyradgs_cl.workflow import run_reconstruction

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("make", [lambda: parallel_scan(10, shutter=Shutter(0.1, 0.5)), lambda: laminography_scan(10)])
def test_a_report_has_no_source(rt, tmp_path, make) -> None:
    scan, volume, page = (tmp_path / name for name in ("scan.h5", "volume.h5", "page.html"))
    write_scan(scan, make())
    run_reconstruction(plan_run("sart", {"iterations": 2}), scan, volume, lambda: rt)
    write_report(volume, page, lambda: rt)
    text = page.read_text(encoding="utf-8")
    assert "10 directions of parallel rays" in text and "the parallel rays of the first frame" in text
    assert not any(word in text for word in ("source to axis", "source to detector", "source positions", "the source"))


@pytest.mark.parametrize("method", ["fista", "phyradgs"])
def test_laminography_is_reconstructed(rt, method: str) -> None:
    with pytest.raises(InputError, match="laminography"):
        reconstruct(laminography_scan(8), plan_run("fbp", {}), rt)
    scan, iterations = laminography_scan(), {"fista": 6, "phyradgs": 300}[method]
    result, truth = reconstruct(scan, plan_run(method, {"iterations": iterations}), rt), BODIES.voxelise(scan.grid, 2)
    assert np.linalg.norm(result.volume - truth) < 0.4 * np.linalg.norm(truth)
