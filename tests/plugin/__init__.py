"""Packages of other people's drivers, and what slrig makes of them once they are installed."""
