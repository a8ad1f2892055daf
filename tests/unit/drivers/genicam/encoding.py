"""Images as a camera sends them, bit by bit, after the standards' own drawings (PFNC 2.4; GigE Vision 1.2, 27)."""

from __future__ import annotations

import numpy as np

from slrig.model import Pixels


def encoded(image: Pixels, name: str) -> bytes:
    """The bytes of an (H, W) image in a PFNC format."""
    samples = [int(sample) for sample in image.ravel()]
    if name.endswith("Packed"):
        depth = 10 if "10" in name else 12
        low_bits = depth - 8
        if len(samples) % 2:
            samples.append(0)
        pairs = zip(samples[::2], samples[1::2], strict=True)
        mask = (1 << low_bits) - 1
        packed = b"".join(
            bytes([one >> low_bits, (one & mask) | (other & mask) << 4, other >> low_bits]) for one, other in pairs
        )
        return packed[: -(-12 * image.size // 8)]
    if name.endswith("p"):
        depth = 10 if "10" in name else 12
        stream = sum(sample << depth * index for index, sample in enumerate(samples))
        return stream.to_bytes(-(-depth * len(samples) // 8), "little")
    if name.endswith("8"):
        return image.astype(np.uint8).tobytes()
    return image.astype("<u2").tobytes()
