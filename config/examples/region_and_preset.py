"""Store scan options under a name, then scan a part of the scene with them, and compare with a whole scan.

SLRIG_API_KEY=... python config/examples/region_and_preset.py -30 -30 -60 30 30 60
"""

import sys

from slrig.client import Client

PRESET = {
    "format": "slrig-preset",
    "version": 1,
    "scan": {"sequence": "robust", "exposure_factors": [0.5, 1.0]},
}


def main(box_mm: list[list[float]]) -> None:
    """box_mm : the least and the greatest corner of the part, in the axes of the mesh."""
    with Client() as client:
        client.presets.put("two-exposures", PRESET)
        whole = client.scan(preset="two-exposures", label="whole")
        part = client.scan(
            preset="two-exposures",
            label="part",
            reconstruction={"region": {"box_mm": box_mm, "max_sigma_mm": 0.05}},
        )
        for result in (whole, part):
            low, high = result.mesh.bounds
            label, count = result.scan["label"], len(result.mesh.faces)
            print(f"{label:<6} {count:>8,} triangles from {low.round(1)} to {high.round(1)} mm")
        client.presets.delete("two-exposures")


if __name__ == "__main__":
    numbers = [float(word) for word in sys.argv[1:7]]
    main([numbers[:3], numbers[3:]])
