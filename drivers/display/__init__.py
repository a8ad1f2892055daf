"""Display outputs as projectors: the part common to the drivers `screen` and `kms`.

A driver provides a `PatternOutput` (`drivers.display.projector`); `DisplayProjector` makes a projector of it.
"""
