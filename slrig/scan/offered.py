"""The files of a finished scan that can be fetched, by name. One list for the service and the command line.

Loads nothing: a command asks it before anything is shot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from slrig.plugins import formats

MEDIA_TYPES: Mapping[str, str] = {
    "mesh.ply": "application/octet-stream",
    "mesh.glb": "model/gltf-binary",
    "mesh.stl": "model/stl",
    "mesh.obj": "model/obj",
    "mesh.3mf": "model/3mf",
    "view.glb": "model/gltf-binary",
    "coarse.glb": "model/gltf-binary",
    "points.ply": "application/octet-stream",
    "report.json": "application/json",
    "preview.png": "image/png",
}
"""Those that every scan that succeeded has."""

BUNDLE_ZIP = "bundle.zip"
"""The recorded frames, of a scan that failed, too."""

CALIBRATION_USED = "calibration.json"
"""The calibration that the mesh was made with: that in the bundle."""


def rejected_picture(camera: str) -> str:
    """The picture of a camera's refused pixels, for people.

    >>> rejected_picture("left")
    'rejected-left.png'
    """
    return f"rejected-{camera}.png"


def causes_picture(camera: str) -> str:
    """The same for programs: grey, a camera pixel each, whose value is the place of its cause in the report's `causes`.

    >>> causes_picture("left")
    'causes-left.png'
    """
    return f"causes-{camera}.png"


def agreement_picture(camera: str) -> str:
    """The picture of how columns and rows agree, of a scan that played both.

    >>> agreement_picture("left")
    'agreement-left.png'
    """
    return f"agreement-{camera}.png"


CLOUDS: Mapping[str, str] = {
    "points-{camera}.npz": "application/octet-stream",
    "points-{camera}.pcd": "application/octet-stream",
    "depth-{camera}.tiff": "image/tiff",
}
"""The surface in the grid of a camera, made on request by `slrig.scan.cloud_files`: names and media types."""


def requested_forms() -> Mapping[str, str]:
    """All files that the worker makes on request, those of plug-ins too: names and media types. Raises ConfigError."""
    return {**CLOUDS, **{each.name: each.media_type for each in formats()}}


def camera_prefixes() -> tuple[str, ...]:
    """Beginnings of the names of a camera's files.

    >>> camera_prefixes()
    ('rejected-', 'causes-', 'agreement-', 'depth-', 'points-')
    """
    of_cameras = {form.partition("{")[0] for form in requested_forms() if "{camera}" in form}
    return "rejected-", "causes-", "agreement-", *sorted(of_cameras)


def camera_files(camera: str) -> tuple[str, ...]:
    """The names of a camera's files.

    >>> camera_files("left")[:3]
    ('rejected-left.png', 'causes-left.png', 'agreement-left.png')
    """
    clouds = (form.format(camera=camera) for form in requested_forms() if "{camera}" in form)
    return rejected_picture(camera), causes_picture(camera), agreement_picture(camera), *clouds


def missing_for(name: str) -> str | None:
    """The command that installs what a file of this name, or form, needs; None if nothing is missing."""
    return next((each.missing for each in formats() if each.matches(name)), None)


def installed_by(name: str) -> str | None:
    """The command that installs what a file of this name needs where it is made; None if it needs nothing.

    >>> installed_by("points-left.e57"), installed_by("points-left.npz")
    ("pip install 'slrig[e57]'", None)
    """
    return next((each.install for each in formats() if each.matches(name)), None)


def on_demand(name: str, cameras: Iterable[str]) -> tuple[str, str | None] | None:
    """The form of `requested_forms` that a name has, and its camera; None if it has none of them.

    >>> on_demand("points-left.npz", ["left", "right"]), on_demand("scan.mcap", ["left"])
    (('points-{camera}.npz', 'left'), ('scan.mcap', None))
    """
    forms = requested_forms()
    if name in forms:
        return name, None
    known = ((form, camera) for camera in cameras for form in forms)
    return next((each for each in known if each[0].format(camera=each[1]) == name), None)


def offered(cameras: Iterable[str]) -> tuple[str, ...]:
    """The names of a scan's files. cameras : of the rig.

    >>> offered(["left"])[-4:]
    ('points-left.e57', 'scan.mcap', 'calibration.json', 'bundle.zip')
    """
    of_cameras = (name for camera in cameras for name in camera_files(camera))
    of_all = (form for form in requested_forms() if "{camera}" not in form)
    return *MEDIA_TYPES, *of_cameras, *of_all, CALIBRATION_USED, BUNDLE_ZIP
