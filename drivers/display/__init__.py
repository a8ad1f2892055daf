"""What the drivers of display outputs share: options, the projector above a stage, its thread, its guard, its times.

A driver gives a `drivers.display.stage.Stage`, which puts pictures on an output and says when; no driver itself.
"""
