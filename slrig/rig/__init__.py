"""The rig as the service holds it."""
