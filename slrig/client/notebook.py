"""A scan as a notebook shows it: a table, and its mesh in 3-D, in a frame that loads nothing from elsewhere."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

_VIEWER = Path(__file__).with_name("viewer.html")
_HEIGHT_PX = 420


def shown(scan: Mapping[str, Any], coarse: bytes | None) -> str:
    """HTML of a finished scan. coarse : coarse.glb, where it is at hand."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(value)}</td></tr>"
        for name, value in _facts(scan)
    )
    table = f"<table>{rows}</table>"
    if coarse is None:
        return table
    page = _VIEWER.read_text(encoding="utf-8").replace("@GLB@", b64encode(coarse).decode())
    style = f"width:100%;height:{_HEIGHT_PX}px;border:0"
    # An origin of its own, without the rights of the notebook's page.
    return f"{table}<iframe sandbox='allow-scripts' style='{style}' srcdoc='{escape(page)}'></iframe>"


def _facts(scan: Mapping[str, Any]) -> list[tuple[str, str]]:
    mesh = (scan["summary"] or {}).get("mesh") or {}
    figures, sigma, covers = mesh.get("figures"), mesh.get("sigma_mm"), mesh.get("covers_of_decoded")
    parts = [
        name.partition("-")[2].removesuffix(".png") for name in scan["links"]["files"] if name.startswith("causes-")
    ]
    facts = [("scan", f"{scan['label'] or ''} {scan['id']}".strip()), ("rig", f"{scan['rig']}: {', '.join(parts)}")]
    if figures:
        facts.append(("points", f"{figures['vertices']:,}"))
        facts.append(("triangles", f"{figures['triangles']:,} on {figures['area_mm2'] / 100:,.1f} cm²"))
    if sigma and sigma["p50"] is not None:
        facts.append(("standard deviation", f"{sigma['p50']:.4f} mm, of 5 in 100 points above {sigma['p95']:.4f} mm"))
        if mesh.get("sigma_holds"):
            facts.append(("it holds", mesh["sigma_holds"]))
    if covers is not None:
        facts.append(("of the decoded pixels", f"{covers:.1%} are on the mesh"))
    return [*facts, *(("note", note) for note in (scan["summary"] or {}).get("notes", ()))]
