"""A fixture of another room that benches use."""

from tests.e2e.conftest import start

__all__ = ["start"]
