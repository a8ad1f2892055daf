"""A pool of machines that reconstruct for rigs."""
