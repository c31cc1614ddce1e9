"""What is said of a gantry's turn without the time from frame to frame: refused, the same way in every format."""

from dataclasses import replace

import pytest
import writers_of_importers as w

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan

CONE = ImportOptions(source_to_axis_mm=500.0, source_to_detector_mm=800.0)
SAID = {
    "exposure_s": {"exposure_s": 0.4}, "readout_s": {"readout_s": 0.3}, "angle_at": {"angle_at": "middle"},
    "readout_axis": {"readout_axis": "rows"}, "readout_direction": {"readout_direction": -1},
    "first": {"first": "left"}, "readout_ms": {"readout_ms": 300.0},
}  # fmt: skip


@pytest.mark.parametrize("form", ["r2", "naf", "rtk", "data-exchange", "nxtomo", "tiff"])
def test_a_turn_without_a_frame_time_is_refused(tmp_path, make_truth, form) -> None:
    path, options = w.write(form, tmp_path, make_truth), CONE if form == "data-exchange" else ImportOptions()
    for name, said in SAID.items():
        with pytest.raises(InputError, match=f"^{name}: .*time from frame to frame.*say .*frame_time_s or .*fps"):
            import_scan(path, replace(options, **said), form)
        timed = replace(options, frame_time_s=1.25, **{"exposure_s": 0.4, **said})
        assert import_scan(path, timed, form).is_fly
    assert not import_scan(path, options, form).is_fly
