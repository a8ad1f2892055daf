"""Pattern sequences: each encoding with its inverse."""

from slrig.patterns.codes import (
    LEAST_FROM_BORDER_PX,
    cell_centre_px,
    cell_positions,
    edge_indices,
    edge_positions,
    gray_bits,
    index_of_word,
    line_positions,
)
from slrig.patterns.sequence import (
    SEQUENCES,
    SequenceOptions,
    encode,
    scan_patterns,
    united,
)

__all__ = [
    "LEAST_FROM_BORDER_PX",
    "SEQUENCES",
    "SequenceOptions",
    "cell_centre_px",
    "cell_positions",
    "edge_indices",
    "edge_positions",
    "encode",
    "gray_bits",
    "index_of_word",
    "line_positions",
    "scan_patterns",
    "united",
]
