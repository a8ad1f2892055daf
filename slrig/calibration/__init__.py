"""The mathematics of calibration: boards, poses, the solve, its accuracy, drift."""
