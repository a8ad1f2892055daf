"""Tests of the rendered rig against arithmetic done by hand, OpenCV and plain numpy."""
