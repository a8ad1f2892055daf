"""A cloud in a camera's grid as E57 (ASTM E2807), the format of surveyors, written by pye57."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from slrig.disk import storage_errors
from slrig.errors import ExtraMissingError, NothingToReconstructError, StorageError
from slrig.plugins import FileFormat

if TYPE_CHECKING:
    from slrig.scan.clouds import OrganisedCloud

FORMAT = FileFormat(
    "points-{camera}.e57", "model/e57", "pye57", "pip install 'slrig[e57]'", "slrig.extras.e57:encode_e57"
)

_METRES_PER_MM = 0.001


def encode_e57(cloud: OrganisedCloud) -> bytes:
    """Encode the points that exist in metres, in the world's axes, with sRGB colours, row and column; without normals.
    Two files of one cloud differ in their GUIDs.

    Raises
    ------
    ExtraMissingError
        pye57 is not installed.
    NothingToReconstructError
        There are no points.
    StorageError
        The folder for temporary files cannot be written; the library writes files only.
    """
    try:
        from pye57 import E57
        from pye57.libe57 import E57Exception
    except ImportError as cause:
        message = f"points-{cloud.camera}.e57 is written by pye57, which is missing: {FORMAT.install}"
        raise ExtraMissingError(message) from cause
    rows, columns = np.nonzero(cloud.cause == 0)
    if not len(rows):
        message = f"camera '{cloud.camera}' sees nothing of the mesh, and E57 cannot hold a scan without points"
        raise NothingToReconstructError(message)
    points = cloud.points_mm[rows, columns] * np.float32(_METRES_PER_MM)
    colours = cloud.colour[rows, columns]
    table = {f"cartesian{axis}": np.ascontiguousarray(points[:, place]) for place, axis in enumerate("XYZ")}
    table |= {f"color{name}": colours[:, place] for place, name in enumerate(("Red", "Green", "Blue"))}
    table |= {"rowIndex": rows.astype(np.uint16), "columnIndex": columns.astype(np.uint16)}
    with TemporaryDirectory(prefix="slrig-") as folder:
        path = Path(folder, f"{cloud.camera}.e57")
        try:
            file = E57(str(path), mode="w")
            file.write_scan_raw(table, name=cloud.camera)
            file.close()
        except E57Exception as cause:
            message = f"{path}: the disk refused: {cause}; free some space there"
            raise StorageError(message) from cause
        with storage_errors(path):
            return path.read_bytes()
