"""Pattern sequences: each encoding with its inverse."""
