"""What TI's pattern controllers with a USB port have in common: reports, commands of LEDs and mirrors, dark and light.

The DLPC350 and the DLPC900 frame their commands alike, and share the numbers of those in `engine`. Their tables of
patterns differ, and where patterns come from: `drivers.dlpc350`, `drivers.dlpc900`.
"""
