"""MetaImage (.mha): a text header, whose frame is LPS, then voxels with x running fastest."""

from pathlib import Path

from phyradgs_cl.exporters.placed import Placed, write_whole


def write_meta_image(path: Path, volume: Placed) -> None:
    """One file, uncompressed."""
    write_whole(path, header(volume).encode("ascii"), volume.values)


def header(volume: Placed) -> str:
    """Up to the first voxel. MetaIO's RAI names where the axes come from: right, anterior, inferior."""
    return (
        "ObjectType = Image\n"
        "NDims = 3\n"
        "BinaryData = True\n"
        "BinaryDataByteOrderMSB = False\n"
        "CompressedData = False\n"
        "TransformMatrix = 1 0 0 0 1 0 0 0 1\n"
        f"Offset = {spaced(volume.origin_mm)}\n"
        "CenterOfRotation = 0 0 0\n"
        "AnatomicalOrientation = RAI\n"
        f"ElementSpacing = {spaced(volume.spacing_mm)}\n"
        f"DimSize = {spaced(volume.shape_xyz)}\n"
        f"Comment = values in {volume.unit}\n"
        "ElementType = MET_FLOAT\n"
        "ElementDataFile = LOCAL\n"
    )


def spaced(numbers: tuple[float, ...] | tuple[int, ...]) -> str:
    """Numbers in full, with spaces between them."""
    return " ".join(f"{number:.17g}" for number in numbers)
