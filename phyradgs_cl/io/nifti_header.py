"""The header of NIfTI-1, as written and read here: https://nifti.nimh.nih.gov/nifti-1 (nifti1.h)."""

import numpy as np

VOXELS_AT = 352  # the header and four bytes that say: no extension
HEADER = np.dtype([
    ("sizeof_hdr", "<i4"), ("unused_1", "V35"), ("dim_info", "u1"), ("dim", "<i2", 8), ("intent_p", "<f4", 3),
    ("intent_code", "<i2"), ("datatype", "<i2"), ("bitpix", "<i2"), ("slice_start", "<i2"), ("pixdim", "<f4", 8),
    ("vox_offset", "<f4"), ("scl_slope", "<f4"), ("scl_inter", "<f4"), ("slice_end", "<i2"), ("slice_code", "u1"),
    ("xyzt_units", "u1"), ("cal_max", "<f4"), ("cal_min", "<f4"), ("slice_duration", "<f4"), ("toffset", "<f4"),
    ("unused_2", "V8"), ("descrip", "S80"), ("aux_file", "S24"), ("qform_code", "<i2"), ("sform_code", "<i2"),
    ("quatern", "<f4", 3), ("qoffset", "<f4", 3), ("srow", "<f4", (3, 4)), ("intent_name", "S16"), ("magic", "S4"),
])  # fmt: skip
