"""What TI's pattern controllers have in common: light and dark of all of them (`light`, `options`, `planes`, `timing`),
and reports and commands of those with a USB port.

The DLPC350 and the DLPC900 frame their commands alike, and share the numbers of those in `engine`. Their tables of
patterns differ, and where patterns come from: `drivers.dlpc350`, `drivers.dlpc900`.
The DLPC347x is on another bus, with other commands: `drivers.dlpc347x`.
"""
