"""NRRD: a text header in LPS, an empty line, then voxels, x fastest. https://teem.sourceforge.net/nrrd/format.html"""

from pathlib import Path

from phyradgs_cl.exporters.placed import Placed, write_whole


def write_nrrd(path: Path, volume: Placed) -> None:
    """One file, uncompressed."""
    write_whole(path, header(volume).encode("ascii"), volume.values)


def header(volume: Placed) -> str:
    """Up to the first voxel."""
    dx, dy, dz = (f"{step:.17g}" for step in volume.spacing_mm)
    x, y, z = (f"{place:.17g}" for place in volume.origin_mm)
    return (
        "NRRD0004\n"
        "# https://teem.sourceforge.net/nrrd/format.html\n"
        f"content: values in {volume.unit}\n"
        "type: float\n"
        "dimension: 3\n"
        "space: left-posterior-superior\n"
        f"sizes: {' '.join(str(n) for n in volume.shape_xyz)}\n"
        f"space directions: ({dx},0,0) (0,{dy},0) (0,0,{dz})\n"
        "kinds: domain domain domain\n"
        'space units: "mm" "mm" "mm"\n'
        "endian: little\n"
        "encoding: raw\n"
        f"space origin: ({x},{y},{z})\n"
        "\n"
    )
