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
from slrig.patterns.sequence import (
    SEQUENCES,
    SequenceOptions,
    encode,
    merge_sequences,
    phase_patterns,
    scan_patterns,
    with_cross_lines,
)
from slrig.patterns.sine_positions import (
    SinePosition,
    level_lines,
    require_numbered,
    sine_periods_px,
    sine_position_px,
    sine_turns,
)

__all__ = [
    "MIN_BORDER_DISTANCE_PX",
    "SEQUENCES",
    "SequenceOptions",
    "SinePosition",
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
    "phase_patterns",
    "require_numbered",
    "scan_patterns",
    "sine_periods_px",
    "sine_position_px",
    "sine_turns",
    "with_cross_lines",
]
