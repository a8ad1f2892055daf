"""slrig: drives structured-light rigs, captures, and reconstructs triangle meshes in millimetres."""
