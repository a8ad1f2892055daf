"""The rendered world between real drivers: a projector's pixels go in, a camera's frames come out."""
