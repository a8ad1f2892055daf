"""Captures and calibrations of other programs, converted from and to slrig's own.

Only the command line reads them: what is refused here is told on a terminal, by its flags.
"""
