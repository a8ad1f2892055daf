"""Drivers, one module per interface, found through entry points."""
