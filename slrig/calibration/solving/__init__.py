"""The solve: from observations of a board to devices and their covariance."""
