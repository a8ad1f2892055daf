"""A rendered rig: ray-traced light transport, a camera and a projector on one world, and its truth."""
