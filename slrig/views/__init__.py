"""Meshes of one object from several sides: where each belongs in one frame, and one model of them all."""
