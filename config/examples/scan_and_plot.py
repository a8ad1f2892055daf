"""Scan, print how good the scan is, and write its depth as a picture.

slrig serve demo                 # in another terminal; prints the key
SLRIG_API_KEY=... python config/examples/scan_and_plot.py depth.png
"""

import sys

import cv2
import numpy as np

from slrig.client import Client


def main(output: str) -> None:
    """Scan, and write the depth to `output`: near is bright, and black has no point."""
    with Client() as client:
        result = client.scan(label="depth map", progress=lambda stage, done, _: print(f"{done:4.0%} {stage}"))
        depth_mm, sigma_mm = result.points_mm[..., 2], result.sigma_mm
        measured = np.isfinite(depth_mm)
        near_mm, far_mm = np.percentile(depth_mm[measured], [1, 99])
        brightness = 55 + 200 * (far_mm - depth_mm) / max(far_mm - near_mm, 1e-6)
        cv2.imwrite(output, np.where(measured, brightness, 0).clip(0, 255).astype(np.uint8))
        print(f"{measured.sum():,} points from {near_mm:.1f} to {far_mm:.1f} mm")
        print(f"median standard deviation {np.nanmedian(sigma_mm):.4f} mm")
        print(f"{len(result.mesh.faces):,} triangles; the mesh: {result.save('mesh.ply', '.')}")


if __name__ == "__main__":
    main(sys.argv[1])
