"""Captures and calibrations of other programs: read into slrig's own, and calibrations written for them.

Only the command line reads them: what is refused here is told on a terminal, by its flags.
"""
