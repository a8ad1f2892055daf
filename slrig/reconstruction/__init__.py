"""From frames to curves in millimetres: decoding, stripes, linking, triangulation."""
