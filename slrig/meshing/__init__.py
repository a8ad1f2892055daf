"""From curves to a triangle mesh: strips, flips, boundary, quality."""
