"""A trigger box on the wire of a camera."""

from tests.unit.drivers.serial_projector.conftest import make_bench

__all__ = ["make_bench"]
