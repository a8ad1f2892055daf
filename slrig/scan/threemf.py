"""A mesh as 3MF, which states its unit and its colours (3MF Consortium: Core Specification 1.3, Materials and
Properties Extension 1.2). Written here for the reasons that `slrig.scan.mesh_formats` gives.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator

import numpy as np

from slrig.model import Mesh
from slrig.scan.mesh_formats import rounded, table_lines

_MODEL = "3D/3dmodel.model"
_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_MATERIALS = "http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_XML = '<?xml version="1.0" encoding="UTF-8"?>\n'
_CONTENT_TYPES = (
    f'{_XML}<Types xmlns="{_PACKAGE}/content-types">'
    f'<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    f'<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_RELATIONS = (
    f'{_XML}<Relationships xmlns="{_PACKAGE}/relationships">'
    f'<Relationship Id="model" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel" Target="/{_MODEL}"/>'
    f"</Relationships>"
)
_POSITION_DECIMALS = 5


def encode_mesh_3mf(mesh: Mesh) -> bytes:
    """3MF in mm, with the sRGB colour of each corner of a triangle; positions have five decimals (10 nm).

    The object is called a model though its surface is open: programs that print or measure leave out what is not.
    """
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, text in (("[Content_Types].xml", _CONTENT_TYPES), ("_rels/.rels", _RELATIONS)):
            archive.writestr(_entry(name), text)
        # A piece at a time: the whole is ten times as long as the file.
        with archive.open(_entry(_MODEL), "w", force_zip64=True) as member:
            for piece in _model(mesh):
                member.write(piece.encode("ascii"))
    return out.getvalue()


def _entry(name: str) -> zipfile.ZipInfo:
    """Without a time, so that the same mesh gives the same bytes."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def _model(mesh: Mesh) -> Iterator[str]:
    packed = mesh.colour.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    palette, colour = np.unique(packed, return_inverse=True)
    yield f'{_XML}<model unit="millimeter" xml:lang="en-US" xmlns="{_CORE}" xmlns:m="{_MATERIALS}">\n<resources>\n'
    coloured = len(palette) > 0
    if coloured:
        yield '<m:colorgroup id="1">\n'
        yield from table_lines('<m:color color="#%06X"/>', palette[:, None])
        yield "</m:colorgroup>\n"
    shade = ' pid="1" pindex="0"' if coloured else ""
    yield f'<object id="2" type="model" name="scan"{shade}>\n<mesh>\n<vertices>\n'
    number = f"%.{_POSITION_DECIMALS}f"
    yield from table_lines(
        f'<vertex x="{number}" y="{number}" z="{number}"/>', rounded(mesh.vertices_mm, _POSITION_DECIMALS)
    )
    yield "</vertices>\n<triangles>\n"
    yield from table_lines(
        '<triangle v1="%d" v2="%d" v3="%d" pid="1" p1="%d" p2="%d" p3="%d"/>',
        np.hstack([mesh.faces, colour.reshape(-1)[mesh.faces]]),
    )
    yield '</triangles>\n</mesh>\n</object>\n</resources>\n<build><item objectid="2"/></build>\n</model>\n'
