"""Display outputs as projectors: what the drivers `screen` and `kms` share.

A driver provides a `PatternOutput` (`drivers.display.projector`); `DisplayProjector` makes a projector of it.
"""
