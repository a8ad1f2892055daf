"""From curves to a triangle mesh, and what the mesh is worth."""
