"""Pattern sequences and their encodings."""

from slrig.patterns.codes import (
    MIN_BORDER_DISTANCE_PX,
    cell_centre_px,
    cell_positions,
    edge_indices,
    edge_positions,
    gray_bits,
    index_of_word,
    line_positions,
)
from slrig.patterns.sequence import SEQUENCES, SequenceOptions, encode, merge_sequences, scan_patterns
from slrig.patterns.sinusoids import level_lines, require_numbered

__all__ = [
    "MIN_BORDER_DISTANCE_PX",
    "SEQUENCES",
    "SequenceOptions",
    "cell_centre_px",
    "cell_positions",
    "edge_indices",
    "edge_positions",
    "encode",
    "gray_bits",
    "index_of_word",
    "level_lines",
    "line_positions",
    "merge_sequences",
    "require_numbered",
    "scan_patterns",
]
