"""The names of LEAP's parameters in files, and those of its versions before 2024."""

OLD_NAMES = {
    "numX": "img_dimx", "numY": "img_dimy", "numZ": "img_dimz", "voxelWidth": "img_pwidth", "voxelHeight": "img_pheight",
    "offsetX": "img_offsetx", "offsetY": "img_offsety", "offsetZ": "img_offsetz", "geometry": "proj_geometry",
    "numAngles": "proj_nangles", "numRows": "proj_nrows", "numCols": "proj_ncols", "pixelHeight": "proj_pheight",
    "pixelWidth": "proj_pwidth", "centerRow": "proj_crow", "centerCol": "proj_ccol", "angularRange": "proj_arange",
    "phis": "proj_phis", "sod": "proj_sod", "sdd": "proj_sdd", "tau": "proj_tau", "helicalPitch": "proj_helicalpitch",
    "tiltAngle": "proj_tiltAngle", "sourcePositions": "proj_srcpos", "moduleCenters": "proj_modcenter",
    "rowVectors": "proj_rowvec", "colVectors": "proj_colvec", "detectorType": "proj_detectortype",
}  # fmt: skip
