"""The guest's first file system: a static busybox, kernel modules, and the script that turns into the command."""

from __future__ import annotations

import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tests.contract.guest.kernel import Kernel, read_module

HOST_TAG = "host"
SHARE_TAG = "share"
SHARE = "/run/guest"
"""Where the guest sees the folder that it shares with the host."""
FAULT = "guest fault:"
"""Begins the line that the guest writes to its console when it cannot come up."""

_TRANSPORT = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "virtio_rng")

# The host's root lies below a file system in memory: the guest sees the same programs, and writes to nothing but SHARE.
_INIT = f"""#!/bin/busybox sh
/bin/busybox --install -s /bin
fault() {{ echo "{FAULT} $*"; poweroff -f; }}
mount -t proc proc /proc && mount -t sysfs sys /sys && mount -t devtmpfs dev /dev || fault "no /proc, /sys, /dev"
while read -r file parameters; do
  insmod "/modules/$file" $parameters || fault "module $file $parameters could not be loaded"
done < /modules/list
mkdir -p /lower /memory /root
mount -t 9p -o trans=virtio,version=9p2000.L,ro,msize=512000,cache=loose {HOST_TAG} /lower || fault "no host files"
mount -t tmpfs memory /memory && mkdir /memory/upper /memory/work
mount -t overlay -o lowerdir=/lower,upperdir=/memory/upper,workdir=/memory/work root /root || fault "no overlay"
for folder in proc sys dev; do mkdir -p "/root/$folder"; mount --move "/$folder" "/root/$folder"; done
mkdir -p /root/dev/pts /root/dev/shm /root/run
mount -t devpts pts /root/dev/pts; mount -t tmpfs shm /root/dev/shm; mount -t tmpfs run /root/run
ifconfig lo 127.0.0.1 up
mkdir -p /root{SHARE}
mount -t 9p -o trans=virtio,version=9p2000.L,rw,msize=512000 {SHARE_TAG} /root{SHARE} || fault "no shared folder"
chroot /root /bin/sh {SHARE}/command > /root{SHARE}/output 2>&1
echo $? > /root{SHARE}/exit_code
sync
poweroff -f
"""


@dataclass(frozen=True, slots=True)
class Module:
    """A kernel module to load in the guest, and its parameters (`n_devs=2 node_types=0x1,0x1`)."""

    name: str
    parameters: str = ""


def initrd(kernel: Kernel, modules: Sequence[Module]) -> bytes:
    """The archive to boot with: loads the modules in order, mounts the host, runs SHARE/command, powers off.
    Raises LookupError: the kernel has no such module.
    """
    parameters = {module.name.replace("-", "_"): module.parameters for module in modules}
    files = kernel.module_files([*_TRANSPORT, *(module.name for module in modules)])
    lines: list[str] = []
    folder = (stat.S_IFDIR | 0o755, b"")
    entries = dict.fromkeys(("bin", "dev", "modules", "proc", "sys"), folder)
    for path in files:
        name = path.name.split(".", 1)[0]
        lines.append(f"{name}.ko {parameters.get(name.replace('-', '_'), '')}".strip())
        entries[f"modules/{name}.ko"] = (stat.S_IFREG | 0o644, read_module(path))
    entries["modules/list"] = (stat.S_IFREG | 0o644, "".join(f"{line}\n" for line in lines).encode())
    entries["bin/busybox"] = (stat.S_IFREG | 0o755, kernel.busybox.read_bytes())
    entries["init"] = (stat.S_IFREG | 0o755, _INIT.encode())
    return archive(entries)


def archive(entries: Mapping[str, tuple[int, bytes]]) -> bytes:
    """A cpio archive in the kernel's format "newc" (kernel documentation, "initramfs buffer format").
    entries : mode (type and permissions) and content by path, folders before what lies in them.
    """
    parts: list[bytes] = []
    for number, (name, (mode, content)) in enumerate([*entries.items(), ("TRAILER!!!", (0, b""))], start=1):
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
        header = b"070701" + b"".join(b"%08X" % value for value in fields)
        parts += [_padded(header + name.encode() + b"\0"), _padded(content)]
    return b"".join(parts)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
