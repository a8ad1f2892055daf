"""The reference trigger box: an RP2040 (Raspberry Pi Pico) with MicroPython that steps a light engine through patterns.

`wire.py`, `box.py` and `protocol.py` are the protocol without any hardware, `main.py` the pins and the engine's extent.
They are copied to the box as they are, with the `patterns.json` that the driver writes (option `export_folder`):

    mpremote cp wire.py box.py protocol.py main.py patterns.json :
    mpremote reset

`python -c "import drivers.serial_projector.device as box; print(*box.__path__)"` prints the folder they are in. For
another engine, write another `main.py`: what it must offer is `box.BoxHardware`.
"""
