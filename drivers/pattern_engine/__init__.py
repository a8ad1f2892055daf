"""Common parts of TI's pattern controllers: light and dark of all of them (`projector`, `options`, `patterns`), and the
USB link and commands of those with a USB port (`usb`).

The DLPC350 and the DLPC900 frame their commands alike and share the command numbers in `usb`. Their pattern tables and
the sources of their patterns differ: `drivers.dlpc350`, `drivers.dlpc900`. The DLPC347x is on another bus, with other
commands: `drivers.dlpc347x`.
"""
