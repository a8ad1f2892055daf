"""slrig: drives structured-light rigs, captures, and reconstructs triangle meshes in millimetres."""

KEY_VARIABLE = "SLRIG_API_KEY"
"""Where a client keeps its key, and where a service may be given one instead of making its own."""
