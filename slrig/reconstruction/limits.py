"""What a camera's reconstruction is told beside its frames: what the patterns mean, and its thresholds."""

from __future__ import annotations

from dataclasses import dataclass, field

from slrig.model import FloatArray, IntArray
from slrig.reconstruction.decoding import DecodingLimits
from slrig.reconstruction.edges import EdgeLimits
from slrig.reconstruction.stripes import StripeLimits


@dataclass(frozen=True, slots=True)
class CodeTables:
    """What the patterns mean. index_of_word : (2^bits,) int32; cell_position : (cells,) float64, px;
    position_of : (frames, cells) float64, px, of lines or of code edges; edges_of : (bits, cells) float64, px, of the
    code edges that stand for lines where those are not resolved, None where nothing does.
    """

    index_of_word: IntArray
    cell_position: FloatArray
    position_of: FloatArray
    edges_of: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """All thresholds of a camera's reconstruction.

    largest_disagreement_px : where the stripes of one frame lie further than this from where all frames together put
    them, the light changed from frame to frame, and each stripe stands as its own frame shows it.
    camera_blur_px : its own, where neither lines nor a print tell it: a lens in focus, 0.58 px, and its pixel, 1/12 px²
    """

    decoding: DecodingLimits = field(default_factory=DecodingLimits)
    stripes: StripeLimits = field(default_factory=StripeLimits)
    edges: EdgeLimits = field(default_factory=EdgeLimits)
    largest_disagreement_px: float = 0.03
    camera_blur_px: float = 0.65
