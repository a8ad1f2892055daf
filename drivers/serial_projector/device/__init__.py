"""The reference trigger box: an RP2040 (Raspberry Pi Pico) with MicroPython that steps a light engine through patterns.

`wire.py`, `box.py` and `protocol.py` are the protocol without any hardware, `main.py` the pins and the engine's size.
Copy them unchanged to the box, with the `patterns.json` that the driver writes (option `export_folder`):

    mpremote cp wire.py box.py protocol.py main.py patterns.json :
    mpremote reset

`python -c "import drivers.serial_projector.device as box; print(*box.__path__)"` prints their folder. For another
engine, write another `main.py` that implements `box.BoxHardware`.

The folder arduino is the same box in C for an Arduino Uno or Nano (ATmega328P at 16 MHz): protocol.c is the protocol,
main.c the pins. "make flash" compiles them with the patterns.h that the driver writes, and puts them onto the board.
"""
