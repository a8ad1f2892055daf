"""A fake video device in a umockdev test bed, below the driver.

    umockdev-wrapper /usr/bin/python3 -m tests.contract.v4l2_server CONFIG.json

prints `ready ROOT` once the device is there, and ends with its standard input. Debian's Python has UMockdev's bindings.
"""

from __future__ import annotations

import errno
import importlib
import json
import mmap
import sys
import time
from pathlib import Path
from typing import Any

from tests.contract.v4l2_kernel import G_EXT_CTRLS, MOST_BUFFERS, SIZES, Device, Light, Refused


def serve(config: dict[str, Any]) -> None:
    importlib.import_module("gi").require_version("UMockdev", "1.0")
    GLib: Any = importlib.import_module("gi.repository.GLib")
    UMockdev: Any = importlib.import_module("gi.repository.UMockdev")
    bed = UMockdev.Testbed.new()
    bed.add_from_string(config["tree"])
    root = Path(bed.get_root_dir())
    bases = []
    for name, own in config["nodes"].items():
        device = Device({**config, **own}, Light(config["light"]))
        room = (root / "dev" / name).open("r+b")
        room.truncate(MOST_BUFFERS * own["most_bytes"])
        device.memory = mmap.mmap(room.fileno(), 0)

        def handle(_: Any, client: Any, device: Device = device) -> bool:
            request = client.get_request() & 0xFFFFFFFF
            argument = client.get_arg().resolve(0, SIZES.get(request, 4))
            if request == G_EXT_CTRLS:
                # One control, behind the pointer at the end of the list's head.
                argument = argument.resolve(24, 20)
            data = bytearray(argument.retrieve())

            def attempt(last: bool) -> bool:
                result, number = 0, 0
                try:
                    due_ns = device.answer(request, data, client)
                except Refused as refusal:
                    result, number = -1, refusal.number
                else:
                    if due_ns is not None and not last:
                        wait_ms = max((due_ns - time.monotonic_ns()) // 1_000_000 + 1, 1)
                        GLib.timeout_add(wait_ms, attempt, True)
                        return False
                    if due_ns is not None:
                        result, number = -1, errno.EAGAIN
                    else:
                        argument.update(0, list(data))
                client.complete(result, number)
                return False

            attempt(last=False)
            return True

        base = UMockdev.IoctlBase()
        base.connect("handle-ioctl", handle)
        bed.attach_ioctl(f"/dev/{name}", base)
        bases.append(base)
    loop = GLib.MainLoop()
    GLib.io_add_watch(sys.stdin.fileno(), GLib.PRIORITY_DEFAULT, GLib.IO_HUP | GLib.IO_IN, lambda *_: loop.quit())
    sys.stdout.write(f"ready {root}\n")
    sys.stdout.flush()
    loop.run()


if __name__ == "__main__":
    serve(json.loads(Path(sys.argv[1]).read_text()))
