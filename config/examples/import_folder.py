"""Reconstruct Gray-code images that another program took, with its OpenCV calibration; no service is needed.

    python config/examples/import_folder.py images/ 1024x768 calibration.yml mesh/ cam0

`images/` holds images of one camera, which tell by themselves what they show; `slrig import --help` lists options for
those that do not.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path


def main(images: str, projector: str, calibration: str, output: str, camera: str = "cam0") -> None:
    """Write mesh.ply and report.json into `output`, print figures. camera : its name in the calibration."""
    with tempfile.TemporaryDirectory() as scratch:
        bundle = str(Path(scratch) / "bundle")
        slrig = [sys.executable, "-m", "slrig.cli"]
        subprocess.run(
            [
                *slrig,
                "import",
                images,
                "--projector",
                projector,
                "--calibration",
                calibration,
                "--camera",
                camera,
                "--output",
                bundle,
            ],
            check=True,
        )
        subprocess.run([*slrig, "reconstruct", bundle, "--output", output], check=True)
    report = json.loads((Path(output) / "report.json").read_text())
    figures = report["mesh"]["figures"]
    print(f"{figures['vertices']:,} vertices, {figures['area_mm2'] / 100:.1f} cm²")
    for camera, found in report["cameras"].items():
        print(f"camera {camera}: {found['decoded_pixels']:,} pixels decoded")
    for note in report["notes"]:
        print(f"note: {note}")


if __name__ == "__main__":
    main(*sys.argv[1:6])
